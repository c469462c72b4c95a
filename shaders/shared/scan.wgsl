var<workgroup> scan_sums: array<u32, SCAN_GROUP>;

// Exclusive sum over the workgroup's invocations; `scan_sums[SCAN_GROUP - 1]` holds the sum of all until the next call.
fn exclusive_sum(lane: u32, value: u32) -> u32 {
    workgroupBarrier();
    scan_sums[lane] = value;
    workgroupBarrier();
    for (var distance = 1u; distance < SCAN_GROUP; distance = distance * 2u) {
        var before = 0u;
        if lane >= distance {
            before = scan_sums[lane - distance];
        }
        workgroupBarrier();
        scan_sums[lane] += before;
        workgroupBarrier();
    }
    return scan_sums[lane] - value;
}
