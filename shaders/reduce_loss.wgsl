// Sums of the pieces' sums, always added in the same order. One workgroup per sum.
@group(0) @binding(1) var<storage, read> counters: Counters;
@group(0) @binding(2) var<storage, read> loss_sums: array<f32>;
@group(0) @binding(3) var<storage, read> candidate_sums: array<f32>;
@group(0) @binding(4) var<storage, read_write> loss_report: LossReport;

struct LossReport {
    sums: array<f32, N_LOSS_SUMS>,
}

var<workgroup> parts: array<f32, GROUP>;

@compute @workgroup_size(GROUP)
fn main(@builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let which = group.x;
    var part = 0.0;
    if which < SUM_ANISOTROPY {
        for (var piece = lane; piece < LOSS_PIECES; piece += GROUP) {
            part += loss_sums[which * LOSS_PIECES + piece];
        }
    } else {
        for (var piece = lane; piece < (counters.candidates + GROUP - 1u) / GROUP; piece += GROUP) {
            part += candidate_sums[piece * N_CANDIDATE_SUMS + which - SUM_ANISOTROPY];
        }
    }
    parts[lane] = part;
    workgroupBarrier();
    if lane == 0u {
        var total = 0.0;
        for (var i = 0u; i < GROUP; i++) {
            total += parts[i];
        }
        loss_report.sums[which] = total;
    }
}
