// Gradients of blending. The pixels are walked front to back once more: the same conditions give the same
// transmittances, and what lies behind a splat is what is left of the pixel's total. One invocation per block of
// 4x4 px, which adds each splat's sums over the block to the splat's.
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> tile_starts: array<u32>;
@group(0) @binding(3) var<storage, read> pairs: array<Pair>;
@group(0) @binding(4) var<storage, read> planes: array<f32>;
@group(0) @binding(5) var<storage, read> upstream: array<f32>;
@group(0) @binding(6) var<storage, read> bounds: Bounds;
@group(0) @binding(7) var<storage, read_write> splat_sums: array<atomic<i32>>;

// One row of a block. A pixel that has ended keeps its transmittance with a minus sign.
struct Row {
    transmittance: vec4<f32>,
    // Loss gradient times what lies from here to the back.
    remaining: vec4<f32>,
    // Gradients with respect to what was drawn.
    red: vec4<f32>,
    green: vec4<f32>,
    blue: vec4<f32>,
    depth: vec4<f32>,
}

// Sums of one splat: of dL/dq, of dL/dq times the position in the ellipse and its squares, of color and depth.
struct Sums {
    total: vec4<f32>,
    by_s: vec4<f32>,
    by_t: vec4<f32>,
    by_ss: vec4<f32>,
    by_st: vec4<f32>,
    by_tt: vec4<f32>,
    red: vec4<f32>,
    green: vec4<f32>,
    blue: vec4<f32>,
    depth: vec4<f32>,
}

fn load_row(b: Block, y: u32) -> Row {
    let n = view.width * view.height;
    var r = Row(vec4<f32>(-1.0), vec4<f32>(), vec4<f32>(), vec4<f32>(), vec4<f32>(), vec4<f32>());
    for (var x = 0u; x < BLOCK_PX; x++) {
        // A pixel outside the picture has ended from the start.
        if b.left + x < view.width && b.top + y < view.height {
            let at = (b.top + y) * view.width + b.left + x;
            r.transmittance[x] = 1.0;
            r.red[x] = upstream[at];
            r.green[x] = upstream[n + at];
            r.blue[x] = upstream[2u * n + at];
            r.depth[x] = upstream[3u * n + at];
            r.remaining[x] = planes[at] * r.red[x] + planes[n + at] * r.green[x] + planes[2u * n + at] * r.blue[x]
                + planes[3u * n + at] * r.depth[x] + planes[4u * n + at] * upstream[4u * n + at];
        }
    }
    return r;
}

// dL/dalpha = T v - behind / (1 - alpha), v = color . dL/dcolor + depth dL/ddepth (Kerbl et al. 2023, app. C, with what
// lies behind as the total minus what lies in front).
fn walk_row(
    splat: Splat, circle: Circle, dx: vec4<f32>, dy: f32, r: ptr<function, Row>, sums: ptr<function, Sums>,
) {
    let hit = hit_row(splat, dx, dy);
    let before = (*r).transmittance;
    let after = before - hit.alpha * before;
    let goes_on = after > vec4<f32>(MIN_TRANSMITTANCE);
    let blended = hit.seen & goes_on;
    let weight = select(vec4<f32>(), hit.alpha * before, blended);
    let value =
        splat.red * (*r).red + splat.green * (*r).green + splat.blue * (*r).blue + splat.depth_m * (*r).depth;
    (*sums).red += weight * (*r).red;
    (*sums).green += weight * (*r).green;
    (*sums).blue += weight * (*r).blue;
    (*sums).depth += weight * (*r).depth;
    let behind = (*r).remaining - weight * value;
    (*r).remaining = behind;
    let grad_alpha = before * value - behind / (1.0 - hit.alpha);
    let uncapped = blended & (hit.uncapped < vec4<f32>(MAX_ALPHA));
    let grad_q = select(vec4<f32>(), -grad_alpha * hit.alpha, uncapped);
    let s = (dx - circle.slope * dy) * circle.per_half;
    let t = dy * circle.per_height;
    let by_s = grad_q * s;
    let by_t = grad_q * t;
    (*sums).total += grad_q;
    (*sums).by_s += by_s;
    (*sums).by_t += by_t;
    (*sums).by_ss += by_s * s;
    (*sums).by_st += by_s * t;
    (*sums).by_tt += by_t * t;
    (*r).transmittance = select(before, select(-abs(before), after, goes_on), hit.seen);
}

fn add(splat: u32, which: u32, values: vec4<f32>, scale: f32, limits: Limits) {
    let sum = (values.x + values.y) + (values.z + values.w);
    let value = clamp(sum * scale, -limits.largest, limits.largest);
    let whole = select(round(value), floor(value), limits.has_fraction);
    let at = (splat * N_SPLAT_GRADS + which) * 2u;
    if whole != 0.0 {
        atomicAdd(&splat_sums[at], i32(whole));
    }
    if limits.has_fraction {
        atomicAdd(&splat_sums[at + 1u], i32((value - whole) * FIXED_FRACTION));
    }
}

@compute @workgroup_size(BLEND_GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let b = block_of(id.x);
    if b.tile >= view.tile_columns * view.tile_rows {
        return;
    }
    var row0 = load_row(b, 0u);
    var row1 = load_row(b, 1u);
    var row2 = load_row(b, 2u);
    var row3 = load_row(b, 3u);
    let x = vec4<f32>(0.5, 1.5, 2.5, 3.5) + f32(b.left);
    let y = f32(b.top) + 0.5;
    let end = tile_starts[b.tile + 1u];
    var i = tile_starts[b.tile];
    while true {
        while i < end && (pairs[i].blocks & b.bit) == 0u {
            i++;
        }
        if i >= end {
            break;
        }
        let at = pairs[i].splat;
        let splat = splats[at];
        i++;
        let dx = x - splat.mean_x;
        let dy = y - splat.mean_y;
        var sums = Sums();
        let circle = circle_of(splat);
        walk_row(splat, circle, dx, dy, &row0, &sums);
        walk_row(splat, circle, dx, dy + 1.0, &row1, &sums);
        walk_row(splat, circle, dx, dy + 2.0, &row2, &sums);
        walk_row(splat, circle, dx, dy + 3.0, &row3, &sums);
        let scales = fixed_scales(splat, bounds);
        let limits = limits_of(splat);
        add(at, 0u, sums.total, scales.x, limits);
        add(at, 1u, sums.by_s, scales.x, limits);
        add(at, 2u, sums.by_t, scales.x, limits);
        add(at, 3u, sums.by_ss, scales.x, limits);
        add(at, 4u, sums.by_st, scales.x, limits);
        add(at, 5u, sums.by_tt, scales.x, limits);
        add(at, 6u, sums.red, scales.y, limits);
        add(at, 7u, sums.green, scales.y, limits);
        add(at, 8u, sums.blue, scales.y, limits);
        add(at, 9u, sums.depth, scales.z, limits);
        let alive = max(max(row0.transmittance, row1.transmittance), max(row2.transmittance, row3.transmittance));
        if all(alive <= vec4<f32>()) {
            break;
        }
    }
}
