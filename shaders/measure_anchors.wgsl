// Largest radius of each anchor's splats on the picture, as the bits of a float (their order is that of the floats). One
// invocation per candidate.
@group(0) @binding(1) var<storage, read> counters: Counters;
@group(0) @binding(2) var<storage, read> candidates: array<u32>;
@group(0) @binding(3) var<storage, read> splats: array<Splat>;
@group(0) @binding(4) var<storage, read_write> anchor_scores: array<atomic<u32>>;

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x < counters.candidates && is_visible(splats[id.x]) {
        let radius_px = max(splats[id.x].extent_x, splats[id.x].extent_y);
        atomicMax(&anchor_scores[SCORE_WORDS * (candidates[id.x] / view.k) + 2u], bitcast<u32>(radius_px));
    }
}
