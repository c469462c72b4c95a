var<workgroup> scan_sums: array<u32, GROUP>;

// Exclusive sum over the workgroup's invocations; `scan_sums[GROUP - 1]` holds the sum of all until the next call.
fn exclusive_sum(lane: u32, value: u32) -> u32 {
    workgroupBarrier();
    scan_sums[lane] = value;
    workgroupBarrier();
    for (var step = 1u; step < GROUP; step = step * 2u) {
        var before = 0u;
        if lane >= step {
            before = scan_sums[lane - step];
        }
        workgroupBarrier();
        scan_sums[lane] += before;
        workgroupBarrier();
    }
    return scan_sums[lane] - value;
}
