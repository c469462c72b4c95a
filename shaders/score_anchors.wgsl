// Contributions of every anchor, those of them where the picture is wrong, and the pixels where it is: one more walk
// front to back. One invocation per block of 4x4 px; integers add up to the same in any order.
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> tile_starts: array<u32>;
@group(0) @binding(3) var<storage, read> pairs: array<Pair>;
@group(0) @binding(4) var<storage, read> candidates: array<u32>;
@group(0) @binding(5) var<storage, read> exposed_planes: array<f32>;
@group(0) @binding(6) var<storage, read> target_planes: array<f32>;
@group(0) @binding(7) var<storage, read_write> counters: Counters;
@group(0) @binding(8) var<storage, read_write> anchor_scores: array<atomic<u32>>;

// One row of a block. A pixel that has ended keeps its transmittance with a minus sign.
struct Row {
    transmittance: vec4<f32>,
    is_wrong: vec4<bool>,
}

// Pixels, per column of the block.
struct Counts {
    covered: vec4<u32>,
    masked: vec4<u32>,
}

fn load_row(b: Block, y: u32) -> Row {
    let n = view.width * view.height;
    var r = Row(vec4<f32>(-1.0), vec4<bool>());
    for (var x = 0u; x < BLOCK_PX; x++) {
        // A pixel outside the picture has ended from the start.
        if b.left + x < view.width && b.top + y < view.height {
            let at = (b.top + y) * view.width + b.left + x;
            let error = abs(exposed_planes[at] - target_planes[at])
                + abs(exposed_planes[n + at] - target_planes[n + at])
                + abs(exposed_planes[2u * n + at] - target_planes[2u * n + at]);
            r.transmittance[x] = 1.0;
            r.is_wrong[x] = error > 3.0 * view.error_threshold;
        }
    }
    return r;
}

fn ones(which: vec4<bool>) -> vec4<u32> {
    return select(vec4<u32>(), vec4<u32>(1u), which);
}

fn total(values: vec4<u32>) -> u32 {
    return (values.x + values.y) + (values.z + values.w);
}

fn walk_row(splat: Splat, dx: vec4<f32>, dy: f32, r: ptr<function, Row>, counts: ptr<function, Counts>) {
    let hit = hit_row(splat, dx, dy);
    let before = (*r).transmittance;
    let weight = hit.alpha * before;
    let after = before - weight;
    let goes_on = after > vec4<f32>(MIN_TRANSMITTANCE);
    let contributes = hit.seen & goes_on & (weight >= vec4<f32>(MIN_CONTRIBUTION));
    (*counts).covered += ones(contributes);
    (*counts).masked += ones(contributes & (*r).is_wrong);
    (*r).transmittance = select(before, select(-abs(before), after, goes_on), hit.seen);
}

fn score_block(b: Block) {
    var row0 = load_row(b, 0u);
    var row1 = load_row(b, 1u);
    var row2 = load_row(b, 2u);
    var row3 = load_row(b, 3u);
    let n_wrong = ones(row0.is_wrong) + ones(row1.is_wrong) + ones(row2.is_wrong) + ones(row3.is_wrong);
    if any(n_wrong > vec4<u32>()) {
        atomicAdd(&counters.masked_pixels, total(n_wrong));
    }
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
        var counts = Counts();
        walk_row(splat, dx, dy, &row0, &counts);
        walk_row(splat, dx, dy + 1.0, &row1, &counts);
        walk_row(splat, dx, dy + 2.0, &row2, &counts);
        walk_row(splat, dx, dy + 3.0, &row3, &counts);
        if any(counts.covered > vec4<u32>()) {
            let slot = candidates[at] / view.k;
            atomicAdd(&anchor_scores[SCORE_WORDS * slot], total(counts.covered));
            if any(counts.masked > vec4<u32>()) {
                atomicAdd(&anchor_scores[SCORE_WORDS * slot + 1u], total(counts.masked));
            }
        }
        // What is behind less than the least contribution contributes nothing.
        let clearest = max(max(row0.transmittance, row1.transmittance), max(row2.transmittance, row3.transmittance));
        if all(clearest < vec4<f32>(MIN_CONTRIBUTION)) {
            break;
        }
    }
}

@compute @workgroup_size(BLEND_GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let b = block_of(id.x);
    if b.tile < view.tile_columns * view.tile_rows {
        score_block(b);
    }
}
