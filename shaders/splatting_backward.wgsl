// From sums over pixels to gradients with respect to the numbers that were decoded, which they replace; and the
// anisotropy of the visible Gaussians and their gradients with respect to the camera's pose, added up per workgroup. One
// invocation per candidate.
@group(0) @binding(4) var<storage, read> counters: Counters;
@group(0) @binding(5) var<storage, read> splats: array<Splat>;
@group(0) @binding(6) var<storage, read> bounds: Bounds;
@group(0) @binding(7) var<storage, read_write> splat_sums: array<i32>;
@group(0) @binding(8) var<storage, read_write> effective: array<f32>;
@group(0) @binding(9) var<storage, read_write> candidate_sums: array<f32>;

var<workgroup> partial: array<f32, GROUP>;

// Takes a sum, and leaves 0 for the next view.
fn take(c: u32, which: u32) -> f32 {
    let at = (c * N_SPLAT_GRADS + which) * 2u;
    let value = f32(splat_sums[at]) + f32(splat_sums[at + 1u]) / FIXED_FRACTION;
    splat_sums[at] = 0;
    splat_sums[at + 1u] = 0;
    return value;
}

// Gradients of a splat from the moments of dL/dq over its pixels. With d = pixel - mean and u = L d, L^T L = conic:
// dq/dmean = -conic d, so dL/dmean = -L^T sum(dL/dq u); dL/dcov = -L^T sum(dL/dq u u^T) L / 2, of which the root of the
// covariance gets twice its product with the root; and dL/dopacity = -(sum dL/dq) / opacity because
// alpha = opacity exp(-q).
fn splat_gradient(c: u32, splat: Splat, opacity: f32, p: Projected) -> SplatGradient {
    let scales = fixed_scales(splat, bounds);
    let back = select(vec3<f32>(), 1.0 / scales, scales > vec3<f32>());
    let circle = circle_of(splat);
    // u is this times the position in the unit circle.
    let radius2 = TWO_LN_2 * (splat.log2_opacity - LOG2_MIN_ALPHA);
    let radius = sqrt(max(radius2, 0.0));
    let l_ss = radius * circle.per_half;
    let l_tt = radius * circle.per_height;
    let total = take(c, 0u) * back.x;
    let by_s = take(c, 1u) * back.x * radius;
    let by_t = take(c, 2u) * back.x * radius;
    let by_ss = take(c, 3u) * back.x * radius2;
    let by_st = take(c, 4u) * back.x * radius2;
    let by_tt = take(c, 5u) * back.x * radius2;
    let root_s = l_ss * (p.root_px_x - circle.slope * p.root_px_y);
    let root_t = l_tt * p.root_px_y;
    let grad_s = -l_ss * (by_ss * root_s + by_st * root_t);
    let grad_t = -l_tt * (by_st * root_s + by_tt * root_t);
    return SplatGradient(
        -vec2<f32>(l_ss * by_s, l_tt * by_t - circle.slope * l_ss * by_s),
        grad_s,
        grad_t - circle.slope * grad_s,
        -total / opacity,
        vec3<f32>(take(c, 6u), take(c, 7u), take(c, 8u)) * back.y,
        take(c, 9u) * back.z,
    );
}

fn store(c: u32, n: Numbers) {
    let cap = view.candidate_capacity;
    effective[c] = n.offset.x;
    effective[cap + c] = n.offset.y;
    effective[2u * cap + c] = n.offset.z;
    effective[3u * cap + c] = n.log_scale.x;
    effective[4u * cap + c] = n.log_scale.y;
    effective[5u * cap + c] = n.log_scale.z;
    effective[6u * cap + c] = n.rotation.x;
    effective[7u * cap + c] = n.rotation.y;
    effective[8u * cap + c] = n.rotation.z;
    effective[9u * cap + c] = n.rotation.w;
    effective[10u * cap + c] = n.opacity;
    effective[11u * cap + c] = n.color.x;
    effective[12u * cap + c] = n.color.y;
    effective[13u * cap + c] = n.color.z;
}

// What a candidate adds to the sums over all of them, in their order.
struct Parts {
    // |s - mean(s)|_1, with the scales in units of the anchor's extent.
    anisotropy: f32,
    // With respect to the camera's pose.
    turn: vec3<f32>,
    shift: vec3<f32>,
}

// Gradient with respect to the anchor's place in the camera's frame, through the fading between levels and sides.
fn fading(anchor: DeviceAnchor, by_log_opacity: f32) -> vec3<f32> {
    let placement = keyframes[anchor.keyframe_row];
    let at = in_camera(placement, position_of(anchor));
    let distance_m = length(at);
    let ray = at / distance_m;
    let slope = band_opacity_slope(level_of(anchor), distance_m);
    let by_distance = slope / band_opacity(level_of(anchor), distance_m) * ray;
    let cosine = side_cosine(placement, at);
    let turn = side_opacity_slope(cosine);
    let seen = at - vec3<f32>(placement.row_x.w, placement.row_y.w, placement.row_z.w);
    let by_cosine = turn / side_opacity(cosine) * (normalize(seen) - cosine * ray) / distance_m;
    return by_log_opacity
        * (select(vec3<f32>(), by_distance, slope != 0.0) + select(vec3<f32>(), by_cosine, turn != 0.0));
}

// What is finished has no gradient.
fn is_finished(anchor: DeviceAnchor) -> bool {
    let row = chunk_row_of(anchor);
    return row < 32u && (view.finished_rows >> row & 1u) == 1u;
}

// Replaces the numbers of a visible candidate by gradients.
fn backward(c: u32) -> Parts {
    let anchor = anchors[candidates[c] / view.k];
    let placement = keyframes[anchor.keyframe_row];
    let extent = extent_of(anchor);
    let numbers = effective_numbers(c);
    let g = decode(position_of(anchor), extent, numbers);
    let p = project(placement, g);
    let grad_splat = splat_gradient(c, splats[c], g.opacity, p);
    let grad = project_backward(placement, g, p, grad_splat);
    var out = decode_backward(extent, numbers, g, grad.gaussian);
    let scale = exponential3(numbers.log_scale);
    let from_mean = scale - (scale.x + scale.y + scale.z) * (1.0 / 3.0);
    let side = sign(from_mean);
    let mean_side = (side.x + side.y + side.z) * (1.0 / 3.0);
    let weight = view.isotropy_weight / f32(max(counters.visible, 1u));
    out.log_scale += weight * (side - mean_side) * scale;
    if is_finished(anchor) {
        store(c, Numbers());
    } else {
        store(c, out);
    }
    let anisotropy = abs(from_mean.x) + abs(from_mean.y) + abs(from_mean.z);
    if view.finds_pose == 0u {
        return Parts(anisotropy, vec3<f32>(), vec3<f32>());
    }
    let turn = turn_of(p, grad);
    let shift = grad.mean_in_camera + fading(anchor, grad_splat.opacity * g.opacity);
    // Not a number fails this comparison.
    let limit = vec3<f32>(MAX_GRADIENT);
    let usable = all((abs(turn) < limit) & (abs(shift) < limit));
    return Parts(anisotropy, select(vec3<f32>(), turn, usable), select(vec3<f32>(), shift, usable));
}

// Adds up one number of all invocations.
fn add_up(lane: u32, group: u32, which: u32, part: f32) {
    partial[lane] = part;
    workgroupBarrier();
    for (var half = GROUP / 2u; half > 0u; half = half / 2u) {
        if lane < half {
            partial[lane] += partial[lane + half];
        }
        workgroupBarrier();
    }
    if lane == 0u {
        candidate_sums[group * N_CANDIDATE_SUMS + which] = partial[0];
    }
}

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(local_invocation_index) lane: u32,
        @builtin(workgroup_id) group: vec3<u32>) {
    var parts = Parts();
    if id.x < counters.candidates {
        if is_visible(splats[id.x]) {
            parts = backward(id.x);
        } else {
            store(id.x, Numbers());
        }
    }
    add_up(lane, group.x, 0u, parts.anisotropy);
    if view.finds_pose != 0u {
        for (var i = 0u; i < 3u; i++) {
            add_up(lane, group.x, SUM_POSE - SUM_ANISOTROPY + i, parts.turn[i]);
            add_up(lane, group.x, SUM_POSE - SUM_ANISOTROPY + 3u + i, parts.shift[i]);
        }
    }
}
