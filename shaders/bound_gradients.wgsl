// Largest magnitudes of the loss gradient: what the fixed point of the sums over pixels is scaled by. One invocation
// per pixel.
@group(0) @binding(1) var<storage, read> planes: array<f32>;
@group(0) @binding(2) var<storage, read> upstream: array<f32>;
@group(0) @binding(3) var<storage, read_write> bounds: Bounds;

var<workgroup> largest_color: atomic<u32>;
var<workgroup> largest_depth: atomic<u32>;
var<workgroup> largest_value: atomic<u32>;

// A splat behind this one is rarely deeper than this many times the pixel's mean depth; beyond it sums saturate.
const DEPTH_HEADROOM: f32 = 4.0;

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    if lane == 0u {
        atomicStore(&largest_color, 0u);
        atomicStore(&largest_depth, 0u);
        atomicStore(&largest_value, 0u);
    }
    workgroupBarrier();
    let n = view.width * view.height;
    if id.x < n {
        let color = abs(vec3<f32>(upstream[id.x], upstream[n + id.x], upstream[2u * n + id.x]));
        let depth = abs(upstream[3u * n + id.x]);
        let mean_depth_m = planes[3u * n + id.x] / max(1.0 - planes[4u * n + id.x], 0.01);
        let value =
            color.x + color.y + color.z + depth * mean_depth_m * DEPTH_HEADROOM + abs(upstream[4u * n + id.x]);
        atomicMax(&largest_color, bitcast<u32>(max(color.x, max(color.y, color.z))));
        atomicMax(&largest_depth, bitcast<u32>(depth));
        atomicMax(&largest_value, bitcast<u32>(value));
    }
    workgroupBarrier();
    if lane == 0u {
        atomicMax(&bounds.color, atomicLoad(&largest_color));
        atomicMax(&bounds.depth, atomicLoad(&largest_depth));
        atomicMax(&bounds.value, atomicLoad(&largest_value));
    }
}
