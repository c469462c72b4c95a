// Splat and sort key of every candidate, and how many meet the picture.
@group(0) @binding(4) var<storage, read> effective: array<f32>;
@group(0) @binding(5) var<storage, read_write> counters: Counters;
@group(0) @binding(6) var<storage, read_write> splats: array<Splat>;
@group(0) @binding(7) var<storage, read_write> keys: array<u32>;
@group(0) @binding(8) var<storage, read_write> order: array<u32>;

// Not a number is no ordinary one.
fn is_ordinary(v: f32) -> bool {
    return abs(v) < 1e30;
}

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let c = id.x;
    if c >= atomicLoad(&counters.candidates) {
        return;
    }
    let anchor = anchors[candidates[c] / view.k];
    let placement = keyframes[anchor.keyframe_row];
    let position = position_of(anchor);
    let g = decode(position, extent_of(anchor), effective_numbers(c));
    let p = project(placement, g);
    let log2_opacity = binary_logarithm(max(g.opacity * visibility_of(anchor, placement), 1e-30));
    let reach = log2_opacity - LOG2_MIN_ALPHA;
    let conic = vec3<f32>(-0.5, -1.0, -0.5) * LOG2_E * p.conic;
    // q <= ln(255 opacity) reaches sqrt(2 q variance) from the mean.
    let extent = sqrt(max(TWO_LN_2 * reach * p.covariance_px2.xz, vec2<f32>()));
    let depth_m = p.mean_in_camera.z;
    let finite = is_ordinary(p.mean_px.x) && is_ordinary(p.mean_px.y) && is_ordinary(conic.x) && is_ordinary(conic.y)
        && is_ordinary(conic.z) && is_ordinary(extent.x) && is_ordinary(extent.y) && is_ordinary(depth_m);
    var key = NOT_VISIBLE;
    if finite && depth_m >= NEAR_PLANE_M && reach >= 0.0 && conic.x < 0.0 && conic.z < 0.0 {
        let columns = pixels_within(p.mean_px.x, -extent.x, extent.x, view.width);
        let rows = pixels_within(p.mean_px.y, -extent.y, extent.y, view.height);
        if columns.x <= columns.y && rows.x <= rows.y {
            key = bitcast<u32>(depth_m);
            splats[c] = Splat(
                p.mean_px.x, p.mean_px.y, log2_opacity, depth_m, conic.x, conic.y, conic.z,
                u32(rows.x) | (u32(rows.y) << 16u), g.color.x, g.color.y, g.color.z,
                u32(columns.x) | (u32(columns.y) << 16u), extent.x, extent.y,
                p.covariance_px2.y / p.covariance_px2.z, sqrt(max(-reach / conic.x, 0.0)),
            );
            atomicAdd(&counters.visible, 1u);
        }
    }
    if key == NOT_VISIBLE {
        splats[c].columns_px = NO_COLUMNS;
    }
    keys[c] = key;
    order[c] = c;
}
