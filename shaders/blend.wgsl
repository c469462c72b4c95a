// Front-to-back blending over nothing: red, green, blue, depth, transmittance. One invocation per block of 4x4 px, so
// that no two invocations share a pixel and none waits for another.
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> tile_starts: array<u32>;
@group(0) @binding(3) var<storage, read> pairs: array<Pair>;
@group(0) @binding(4) var<storage, read_write> planes: array<f32>;

// One row of a block. A pixel that has ended keeps its transmittance with a minus sign.
struct Row {
    transmittance: vec4<f32>,
    red: vec4<f32>,
    green: vec4<f32>,
    blue: vec4<f32>,
    depth: vec4<f32>,
}

fn blend_row(splat: Splat, dx: vec4<f32>, dy: f32, r: Row) -> Row {
    let hit = hit_row(splat, dx, dy);
    let before = r.transmittance;
    let after = before - hit.alpha * before;
    let goes_on = after > vec4<f32>(MIN_TRANSMITTANCE);
    let weight = select(vec4<f32>(), hit.alpha * before, hit.seen & goes_on);
    return Row(
        select(before, select(-abs(before), after, goes_on), hit.seen),
        r.red + weight * splat.red,
        r.green + weight * splat.green,
        r.blue + weight * splat.blue,
        r.depth + weight * splat.depth_m,
    );
}

fn store_row(b: Block, y: u32, r: Row) {
    let n = view.width * view.height;
    for (var x = 0u; x < BLOCK_PX; x++) {
        if b.left + x < view.width && b.top + y < view.height {
            let at = (b.top + y) * view.width + b.left + x;
            planes[at] = r.red[x];
            planes[n + at] = r.green[x];
            planes[2u * n + at] = r.blue[x];
            planes[3u * n + at] = r.depth[x];
            planes[4u * n + at] = abs(r.transmittance[x]);
        }
    }
}

fn empty_row() -> Row {
    return Row(vec4<f32>(1.0), vec4<f32>(), vec4<f32>(), vec4<f32>(), vec4<f32>());
}

@compute @workgroup_size(BLEND_GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let b = block_of(id.x);
    if b.tile >= view.tile_columns * view.tile_rows {
        return;
    }
    var row0 = empty_row();
    var row1 = empty_row();
    var row2 = empty_row();
    var row3 = empty_row();
    let x = vec4<f32>(0.5, 1.5, 2.5, 3.5) + f32(b.left);
    let y = f32(b.top) + 0.5;
    let end = tile_starts[b.tile + 1u];
    var i = tile_starts[b.tile];
    while true {
        // The next pair that touches this block: cheap, so that blending, which is not, keeps all invocations busy.
        while i < end && (pairs[i].blocks & b.bit) == 0u {
            i++;
        }
        if i >= end {
            break;
        }
        let splat = splats[pairs[i].splat];
        i++;
        let dx = x - splat.mean_x;
        let dy = y - splat.mean_y;
        row0 = blend_row(splat, dx, dy, row0);
        row1 = blend_row(splat, dx, dy + 1.0, row1);
        row2 = blend_row(splat, dx, dy + 2.0, row2);
        row3 = blend_row(splat, dx, dy + 3.0, row3);
        let alive = max(max(row0.transmittance, row1.transmittance), max(row2.transmittance, row3.transmittance));
        if all(alive <= vec4<f32>()) {
            break;
        }
    }
    store_row(b, 0u, row0);
    store_row(b, 1u, row1);
    store_row(b, 2u, row2);
    store_row(b, 3u, row3);
}
