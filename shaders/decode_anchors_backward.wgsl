// From gradients of the candidates' numbers to those of the decoder that learns and of the camera's place, summed over one
// piece of the candidates per workgroup, and the Adam step of the features. The hidden layer is computed once more instead
// of being kept.
@group(0) @binding(5) var<storage, read_write> features: array<f32>;
@group(0) @binding(6) var<storage, read> decoders: array<f32>;
@group(0) @binding(7) var<storage, read> effective: array<f32>;
@group(0) @binding(8) var<storage, read_write> feature_moments: array<f32>;
@group(0) @binding(9) var<storage, read_write> decoder_sums: array<f32>;

// Of the hidden units before the rectifier.
var<workgroup> hidden_grads: array<f32, BATCH * HIDDEN>;
// Adam steps of each anchor's feature, this one included; 0 where nothing of the anchor was seen.
var<workgroup> steps: array<f32, BATCH>;

// Numbers that are kept of a feature: both running means, then the steps.
const MOMENTS_LEN: u32 = 2u * FEATURE_LEN + 1u;
const FEATURE_TILES: u32 = FEATURE_LEN / TILE_COLUMNS;
// Rows of a tile of weights, which has as many columns as others.
const TILE_ROWS: u32 = 4u;

// Gradients that can be learned from: neither what is not a number, nor what is not drawn.
fn usable(grads: vec4<f32>, is_drawn: vec4<bool>) -> vec4<f32> {
    return select(vec4<f32>(), grads, is_drawn & (abs(grads) < vec4<f32>(MAX_GRADIENT)));
}

// Gradients of a number of four anchors.
fn output_grads_of(a: u32, at: vec4<u32>, i: u32) -> vec4<f32> {
    let own = at + effective_offset(i);
    let grads = vec4<f32>(effective[own.x], effective[own.y], effective[own.z], effective[own.w]);
    let n = vec4<u32>(n_numbers[a], n_numbers[a + 1u], n_numbers[a + 2u], n_numbers[a + 3u]);
    return usable(grads, vec4<u32>(i) < n);
}

fn hidden_grads_of(a: u32, i: u32) -> vec4<f32> {
    let at = a * HIDDEN + i;
    return vec4<f32>(
        hidden_grads[at], hidden_grads[at + HIDDEN], hidden_grads[at + 2u * HIDDEN], hidden_grads[at + 3u * HIDDEN],
    );
}

fn store_hidden_grads(a: u32, unit: u32, low: vec4<f32>, high: vec4<f32>) {
    for (var i = 0u; i < 4u; i++) {
        let at = a * HIDDEN_ROW + unit + i;
        hidden_grads[a * HIDDEN + unit + i] = select(0.0, low[i], hidden[at] > 0.0);
        hidden_grads[a * HIDDEN + unit + 4u + i] = select(0.0, high[i], hidden[at + 4u] > 0.0);
    }
}

fn count_step(a: u32, done: u32, is_seen: bool) {
    var n = 0.0;
    if is_seen {
        n = feature_moments[slot_of(firsts[done + a]) * MOMENTS_LEN + 2u * FEATURE_LEN] + 1.0;
    }
    steps[a] = min(n, f32(ADAM_MAX_STEPS));
}

// Fills `hidden_grads` and `steps`.
fn find_hidden_grads(lane: u32, done: u32) {
    let n = n_outputs();
    let a = lane / UNIT_TILES * TILE_ANCHORS;
    let unit = lane % UNIT_TILES * TILE_COLUMNS;
    var remaining = 0u;
    if a < BATCH {
        remaining = bits_to_decode(a);
        if unit == 0u {
            for (var i = 0u; i < TILE_ANCHORS; i++) {
                steps[a + i] = 0.0;
            }
        }
    }
    while remaining != 0u {
        let row = rows[a + firstTrailingBit(remaining)];
        let same = bits_of_row(a, row);
        let units = consecutive(unit);
        let begin = row * decoder_len() + FIRST_LAYER_LEN;
        let columns = Columns(begin + n * units.low, begin + n * units.high);
        let last = n_firsts - 1u;
        let at = vec4<u32>(
            firsts[min(done + a, last)], firsts[min(done + a + 1u, last)], firsts[min(done + a + 2u, last)],
            firsts[min(done + a + 3u, last)],
        );
        var tile = Tile();
        var is_seen = vec4<bool>();
        for (var i = 0u; i < n; i++) {
            let grads = output_grads_of(a, at, i);
            is_seen = is_seen | (grads != vec4<f32>());
            tile = add_row(tile, grads, i, columns);
        }
        if (same & 1u) != 0u {
            store_hidden_grads(a, unit, tile.low[0], tile.high[0]);
        }
        if (same & 2u) != 0u {
            store_hidden_grads(a + 1u, unit, tile.low[1], tile.high[1]);
        }
        if (same & 4u) != 0u {
            store_hidden_grads(a + 2u, unit, tile.low[2], tile.high[2]);
        }
        if (same & 8u) != 0u {
            store_hidden_grads(a + 3u, unit, tile.low[3], tile.high[3]);
        }
        if unit == 0u {
            for (var i = 0u; i < TILE_ANCHORS; i++) {
                if (same >> i & 1u) != 0u {
                    count_step(a + i, done, is_seen[i]);
                }
            }
        }
        remaining &= ~same;
    }
}

// One Adam step of eight numbers of an anchor's feature.
fn step_numbers(a: u32, done: u32, begin: u32, low: vec4<f32>, high: vec4<f32>) {
    if steps[a] > 0.0 {
        let slot = slot_of(firsts[done + a]);
        let moments = slot * MOMENTS_LEN;
        let correction = bias_correction(steps[a]);
        for (var i = 0u; i < TILE_COLUMNS; i++) {
            let grad = select(high[i % 4u], low[i % 4u], i < 4u);
            let at = slot * FEATURE_LEN + begin + i;
            let first = moments + begin + i;
            let before = AdamNumber(features[at], feature_moments[first], feature_moments[first + FEATURE_LEN]);
            let after = adam(before, grad, view.feature_rate, correction);
            features[at] = after.value;
            feature_moments[first] = after.first;
            feature_moments[first + FEATURE_LEN] = after.second;
        }
        if begin == 0u {
            feature_moments[moments + 2u * FEATURE_LEN] = steps[a];
        }
    }
}

// One Adam step of the features.
fn step_features(lane: u32, done: u32) {
    let a = lane / FEATURE_TILES * TILE_ANCHORS;
    let begin = lane % FEATURE_TILES * TILE_COLUMNS;
    var remaining = 0u;
    if a < BATCH && view.feature_rate > 0.0 {
        remaining = bits_to_decode(a);
    }
    while remaining != 0u {
        let row = rows[a + firstTrailingBit(remaining)];
        let same = bits_of_row(a, row);
        let numbers = consecutive(begin);
        let weights = row * decoder_len();
        let columns = Columns(weights + HIDDEN * numbers.low, weights + HIDDEN * numbers.high);
        var tile = Tile();
        for (var unit = 0u; unit < HIDDEN; unit++) {
            tile = add_row(tile, hidden_grads_of(a, unit), unit, columns);
        }
        if (same & 1u) != 0u {
            step_numbers(a, done, begin, tile.low[0], tile.high[0]);
        }
        if (same & 2u) != 0u {
            step_numbers(a + 1u, done, begin, tile.low[1], tile.high[1]);
        }
        if (same & 4u) != 0u {
            step_numbers(a + 2u, done, begin, tile.low[2], tile.high[2]);
        }
        if (same & 8u) != 0u {
            step_numbers(a + 3u, done, begin, tile.low[3], tile.high[3]);
        }
        remaining &= ~same;
    }
}

// Gradient with respect to the moving of the camera's pose, through what the decoder is told of an anchor's place.
fn camera_gradient(a: u32, done: u32) -> vec3<f32> {
    var grad = vec4<f32>();
    for (var i = 0u; i < INPUTS - FEATURE_LEN; i++) {
        let row = rows[a] * decoder_len() + (FEATURE_LEN + i) * HIDDEN;
        for (var unit = 0u; unit < HIDDEN; unit++) {
            grad[i] += decoders[row + unit] * hidden_grads[a * HIDDEN + unit];
        }
    }
    let anchor = anchors[slot_of(firsts[done + a])];
    let placement = keyframes[anchor.keyframe_row];
    let from_camera = from_camera_of(anchor, placement);
    let length_m = length(from_camera);
    let distance_m = max(length_m, MIN_DISTANCE_M);
    let unit = from_camera / distance_m;
    // Below the smallest distance nothing is divided by the length.
    let along = select(0.0, dot(grad.xyz, unit) - grad.w * LOG2_E / LOG2_DISTANCE_UNIT, length_m > MIN_DISTANCE_M);
    let by_place = (grad.xyz - unit * along) / distance_m;
    let by_shift = vec3<f32>(
        dot(placement.row_x.xyz, by_place), dot(placement.row_y.xyz, by_place), dot(placement.row_z.xyz, by_place),
    );
    let out = by_shift / dot(placement.row_x.xyz, placement.row_x.xyz);
    // Not a number fails this comparison.
    return select(vec3<f32>(), out, all(abs(out) < vec3<f32>(MAX_GRADIENT)));
}

// Adds up one number of all invocations behind the sums of all pieces.
fn add_up(lane: u32, piece: u32, which: u32, part: f32) {
    // The inputs are not needed any more.
    inputs[lane] = part;
    workgroupBarrier();
    for (var half = GROUP / 2u; half > 0u; half = half / 2u) {
        if lane < half {
            inputs[lane] += inputs[lane + half];
        }
        workgroupBarrier();
    }
    if lane == 0u {
        decoder_sums[DECODER_PIECES * decoder_len() + piece * 3u + which] = inputs[0];
    }
}

// Adds a tile to the sums: four rows of eight weights, of which a layer has `n_rows` and `n_columns`.
fn store_sums(begin: u32, row: u32, n_rows: u32, column: u32, n_columns: u32, sums: Tile) {
    var tile = sums;
    for (var r = 0u; r < TILE_ROWS && row + r < n_rows; r++) {
        let at = begin + (row + r) * n_columns + column;
        for (var i = 0u; i < 4u; i++) {
            if column + i < n_columns {
                decoder_sums[at + i] += tile.low[r][i];
            }
            if column + 4u + i < n_columns {
                decoder_sums[at + 4u + i] += tile.high[r][i];
            }
        }
    }
}

// Gradients of a tile of W1 and b1 from all anchors at hand that the decoder learns from.
fn sum_first_layer(sums: u32, tile_idx: u32, n_anchors: u32) {
    let row = tile_idx / UNIT_TILES * TILE_ROWS;
    let unit = tile_idx % UNIT_TILES * TILE_COLUMNS;
    let own = min(row + vec4<u32>(0u, 1u, 2u, 3u), vec4<u32>(INPUTS));
    var tile = Tile();
    for (var a = 0u; a < n_anchors; a++) {
        if rows[a] == view.decoder_row {
            let at = a * INPUT_ROW + own;
            let x = vec4<f32>(inputs[at.x], inputs[at.y], inputs[at.z], inputs[at.w]);
            let g = a * HIDDEN + unit;
            let low = vec4<f32>(hidden_grads[g], hidden_grads[g + 1u], hidden_grads[g + 2u], hidden_grads[g + 3u]);
            let high =
                vec4<f32>(hidden_grads[g + 4u], hidden_grads[g + 5u], hidden_grads[g + 6u], hidden_grads[g + 7u]);
            tile = Tile(tile.low + outer(x, low), tile.high + outer(x, high));
        }
    }
    store_sums(sums, row, INPUT_ROW, unit, HIDDEN, tile);
}

// The same of W2 and b2.
fn sum_second_layer(sums: u32, tile_idx: u32, n_anchors: u32, done: u32) {
    let n = n_outputs();
    let output_tiles = (n + TILE_COLUMNS - 1u) / TILE_COLUMNS;
    let row = tile_idx / output_tiles * TILE_ROWS;
    let output = tile_idx % output_tiles * TILE_COLUMNS;
    let own = min(row + vec4<u32>(0u, 1u, 2u, 3u), vec4<u32>(HIDDEN));
    let columns = consecutive(output);
    let low_at = effective_offsets(min(columns.low, vec4<u32>(n - 1u)));
    let high_at = effective_offsets(min(columns.high, vec4<u32>(n - 1u)));
    var tile = Tile();
    for (var a = 0u; a < n_anchors; a++) {
        if rows[a] == view.decoder_row {
            let at = a * HIDDEN_ROW + own;
            let x = vec4<f32>(hidden[at.x], hidden[at.y], hidden[at.z], hidden[at.w]);
            let first = firsts[done + a];
            let drawn = vec4<u32>(n_numbers[a]);
            let low = usable(effective_at(first + low_at), columns.low < drawn);
            let high = usable(effective_at(first + high_at), columns.high < drawn);
            tile = Tile(tile.low + outer(x, low), tile.high + outer(x, high));
        }
    }
    store_sums(sums + FIRST_LAYER_LEN, row, HIDDEN_ROW, output, n, tile);
}

fn effective_at(at: vec4<u32>) -> vec4<f32> {
    return vec4<f32>(effective[at.x], effective[at.y], effective[at.z], effective[at.w]);
}

fn effective_offsets(i: vec4<u32>) -> vec4<u32> {
    return (i % N_PARAMS) * view.candidate_capacity + i / N_PARAMS;
}

// Adds the gradients of all weights from the anchors at hand.
fn add_to_sums(lane: u32, sums: u32, done: u32) {
    let n_anchors = min(n_firsts - done, BATCH);
    let first_tiles = (INPUT_ROW + TILE_ROWS - 1u) / TILE_ROWS * UNIT_TILES;
    let output_tiles = (n_outputs() + TILE_COLUMNS - 1u) / TILE_COLUMNS;
    let n_tiles = first_tiles + (HIDDEN_ROW + TILE_ROWS - 1u) / TILE_ROWS * output_tiles;
    for (var tile = lane; tile < n_tiles; tile += GROUP) {
        if tile < first_tiles {
            sum_first_layer(sums, tile, n_anchors);
        } else {
            sum_second_layer(sums, tile - first_tiles, n_anchors, done);
        }
    }
}

@compute @workgroup_size(GROUP)
fn main(@builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let sums = group.x * decoder_len();
    let is_learning = view.decoder_row < view.decoder_rows;
    if is_learning {
        for (var w = lane; w < decoder_len(); w += GROUP) {
            decoder_sums[sums + w] = 0.0;
        }
    }
    // Other invocations add to these sums.
    storageBarrier();
    var shift = vec3<f32>();
    let n_blocks = (counters.candidates + GROUP - 1u) / GROUP;
    for (var block = group.x; block < n_blocks; block += DECODER_PIECES) {
        list_firsts(lane, block);
        let n = workgroupUniformLoad(&n_firsts);
        for (var done = 0u; done < n; done += BATCH) {
            gather_inputs(lane, done);
            workgroupBarrier();
            find_hidden(lane);
            workgroupBarrier();
            find_hidden_grads(lane, done);
            workgroupBarrier();
            step_features(lane, done);
            if view.finds_pose != 0u && lane < BATCH {
                if rows[lane] != NO_ROW {
                    shift += camera_gradient(lane, done);
                }
            }
            if is_learning {
                add_to_sums(lane, sums, done);
            }
            workgroupBarrier();
        }
    }
    if view.finds_pose != 0u {
        for (var i = 0u; i < 3u; i++) {
            add_up(lane, group.x, i, shift[i]);
        }
    }
}
