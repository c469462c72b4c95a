// Which Gaussians of each slot may be in view: a test that is cheap and never wrong in the negative.
// One invocation per slot; each workgroup also counts what it found.
@group(0) @binding(1) var<storage, read> anchors: array<DeviceAnchor>;
@group(0) @binding(2) var<storage, read> params: array<f32>;
@group(0) @binding(3) var<storage, read> keyframes: array<KeyframeBlock>;
@group(0) @binding(4) var<storage, read_write> visible_bits: array<u32>;
@group(0) @binding(5) var<storage, read_write> group_totals: array<u32>;

// Whether the splat of a Gaussian with standard deviations of at most `max_sigma_m` may meet the picture.
fn may_see(p: vec3<f32>, max_sigma_m: f32) -> bool {
    // Not a number fails this comparison.
    if !(p.z >= NEAR_PLANE_M && abs(p.x) + abs(p.y) + p.z < 1e30) {
        return false;
    }
    let pixel = view.focal_px * p.xy / p.z + view.center_px;
    let size_px = vec2<f32>(f32(view.width), f32(view.height));
    let beyond = max(-pixel, pixel - size_px);
    let along = view.stretch_px * (max_sigma_m / p.z);
    let sigma_px = sqrt(along * along + SCREEN_DILATION_PX2);
    return all(beyond <= MAX_SIGMAS * sigma_px + 1.0) || all(beyond < vec2<f32>());
}

// Whether anything within `radius_m` of a point may meet the picture.
fn may_reach(p: vec3<f32>, radius_m: f32) -> bool {
    // Not a number fails this comparison.
    if !(abs(p.x) + abs(p.y) + abs(p.z) < 1e30) {
        return false;
    }
    let pixel = view.focal_px * p.xy / p.z + view.center_px;
    let beyond = max(-pixel, pixel - vec2<f32>(f32(view.width), f32(view.height)));
    let along = view.stretch_px * (radius_m / p.z) + MAX_SIGMAS * sqrt(SCREEN_DILATION_PX2) + 1.0;
    let is_near = p.z <= radius_m && p.z + radius_m >= NEAR_PLANE_M;
    let is_inside = p.z >= NEAR_PLANE_M && all(beyond < vec2<f32>());
    return is_inside || is_near || (p.z > radius_m && all(beyond <= along));
}

fn slot_bits(slot: u32) -> u32 {
    let anchor = anchors[slot];
    let n_gaussians = n_gaussians_of(anchor);
    if n_gaussians == 0u {
        return 0u;
    }
    let placement = keyframes[anchor.keyframe_row];
    let position = position_of(anchor);
    let extent = extent_of(anchor);
    if visibility_of(anchor, placement) <= 0.0 {
        return 0u;
    }
    let reach_m = length(placement.row_x.xyz) * max(extent.x, max(extent.y, extent.z));
    var bits = 0u;
    // How far the Gaussians reach when a learned decoder has added to their numbers, in extents.
    var reach = 0.0;
    for (var i = 0u; i < n_gaussians; i++) {
        let at = (slot * view.k + i) * N_PARAMS;
        let offset = vec3<f32>(params[at], params[at + 1u], params[at + 2u]);
        let log_scale = max(params[at + 3u], max(params[at + 4u], params[at + 5u]));
        if may_see(in_camera(placement, position + offset * extent), reach_m * exp(log_scale)) {
            bits |= 1u << i;
        }
        reach = max(reach, length(offset) + MOST_SHIFT + MAX_SIGMAS * MOST_GROWTH * exp(log_scale));
    }
    if view.decoder_rows > 0u {
        // All of an anchor's Gaussians are decoded together.
        let all_bits = 0xffffffffu >> (32u - n_gaussians);
        bits = select(0u, all_bits, may_reach(in_camera(placement, position), reach_m * reach));
    }
    return bits;
}

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(local_invocation_index) lane: u32,
        @builtin(workgroup_id) group: vec3<u32>) {
    var bits = 0u;
    if id.x < view.n_slots {
        bits = slot_bits(id.x);
        visible_bits[id.x] = bits;
    }
    exclusive_sum(lane, countOneBits(bits));
    if lane == 0u {
        group_totals[group.x] = scan_sums[SCAN_GROUP - 1u];
    }
}
