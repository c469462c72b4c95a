// Sums of the pieces' sums, always added in the same order. One workgroup.
@group(0) @binding(1) var<storage, read> counters: Counters;
@group(0) @binding(2) var<storage, read> loss_sums: array<f32>;
@group(0) @binding(3) var<storage, read> anisotropy_sums: array<f32>;
@group(0) @binding(4) var<storage, read_write> loss_report: LossReport;

struct LossReport {
    sums: array<f32, N_LOSS_SUMS>,
}

var<workgroup> parts: array<f32, N_LOSS_SUMS * GROUP>;

@compute @workgroup_size(GROUP)
fn main(@builtin(local_invocation_index) lane: u32) {
    for (var i = 0u; i < SUM_ANISOTROPY; i++) {
        var total = 0.0;
        for (var piece = lane; piece < LOSS_PIECES; piece += GROUP) {
            total += loss_sums[i * LOSS_PIECES + piece];
        }
        parts[i * GROUP + lane] = total;
    }
    var anisotropy = 0.0;
    for (var group = lane; group < (counters.candidates + GROUP - 1u) / GROUP; group += GROUP) {
        anisotropy += anisotropy_sums[group];
    }
    parts[SUM_ANISOTROPY * GROUP + lane] = anisotropy;
    workgroupBarrier();
    if lane < N_LOSS_SUMS {
        var total = 0.0;
        for (var i = 0u; i < GROUP; i++) {
            total += parts[lane * GROUP + i];
        }
        loss_report.sums[lane] = total;
    }
}
