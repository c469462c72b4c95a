// From sums over pixels to gradients with respect to the numbers that were decoded, which they replace; and the
// anisotropy of the visible Gaussians, added up per workgroup. One invocation per candidate.
@group(0) @binding(4) var<storage, read> counters: Counters;
@group(0) @binding(5) var<storage, read> splats: array<Splat>;
@group(0) @binding(6) var<storage, read> bounds: Bounds;
@group(0) @binding(7) var<storage, read_write> splat_sums: array<i32>;
@group(0) @binding(8) var<storage, read_write> effective: array<f32>;
@group(0) @binding(9) var<storage, read_write> anisotropy_sums: array<f32>;

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

// Replaces the numbers of a visible candidate by gradients; returns its anisotropy |s - mean(s)|_1, with the scales in
// units of the anchor's extent.
fn backward(c: u32) -> f32 {
    let anchor = anchors[candidates[c] / view.k];
    let placement = keyframes[anchor.keyframe_row];
    let extent = extent_of(anchor);
    let numbers = effective_numbers(c);
    let g = decode(position_of(anchor), extent, numbers);
    let p = project(placement, g);
    let grad = project_backward(placement, g, p, splat_gradient(c, splats[c], g.opacity, p));
    var out = decode_backward(extent, numbers, g, grad);
    let scale = exponential3(numbers.log_scale);
    let from_mean = scale - (scale.x + scale.y + scale.z) * (1.0 / 3.0);
    let side = sign(from_mean);
    let mean_side = (side.x + side.y + side.z) * (1.0 / 3.0);
    let weight = view.isotropy_weight / f32(max(counters.visible, 1u));
    out.log_scale += weight * (side - mean_side) * scale;
    store(c, out);
    return abs(from_mean.x) + abs(from_mean.y) + abs(from_mean.z);
}

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(local_invocation_index) lane: u32,
        @builtin(workgroup_id) group: vec3<u32>) {
    var anisotropy = 0.0;
    if id.x < counters.candidates {
        if is_visible(splats[id.x]) {
            anisotropy = backward(id.x);
        } else {
            store(id.x, Numbers());
        }
    }
    partial[lane] = anisotropy;
    workgroupBarrier();
    for (var half = GROUP / 2u; half > 0u; half = half / 2u) {
        if lane < half {
            partial[lane] += partial[lane + half];
        }
        workgroupBarrier();
    }
    if lane == 0u {
        anisotropy_sums[group.x] = partial[0];
    }
}
