// The anchors of a workgroup's candidates on their way into their chunks' decoders, BATCH at a time. Products of matrices
// are found in tiles of four anchors and eight columns, one invocation each, so that a number that is read serves several
// products.
@group(0) @binding(1) var<storage, read> anchors: array<DeviceAnchor>;
@group(0) @binding(2) var<storage, read> keyframes: array<KeyframeBlock>;
@group(0) @binding(3) var<storage, read> candidates: array<u32>;
@group(0) @binding(4) var<storage, read> counters: Counters;

// Anchors at a time.
const BATCH: u32 = 32u;
// Anchors and columns of a tile.
const TILE_ANCHORS: u32 = 4u;
const TILE_COLUMNS: u32 = 8u;
// Tiles of the hidden layer.
const UNIT_TILES: u32 = HIDDEN / TILE_COLUMNS;
// Inputs of a layer, the last of which is 1 and carries the bias.
const INPUT_ROW: u32 = INPUTS + 1u;
const HIDDEN_ROW: u32 = HIDDEN + 1u;
// Where the second layer begins in a decoder (see core/src/map/decoder.rs).
const FIRST_LAYER_LEN: u32 = INPUT_ROW * HIDDEN;

// First candidates of the workgroup's anchors, ascending.
var<workgroup> firsts: array<u32, GROUP>;
var<workgroup> n_firsts: u32;
// Chunk row of each anchor at hand; NO_ROW where there is no anchor or no decoder.
var<workgroup> rows: array<u32, BATCH>;
// Numbers that are drawn of each.
var<workgroup> n_numbers: array<u32, BATCH>;
var<workgroup> inputs: array<f32, BATCH * INPUT_ROW>;
var<workgroup> hidden: array<f32, BATCH * HIDDEN_ROW>;

fn n_outputs() -> u32 {
    return view.k * N_PARAMS;
}

fn decoder_len() -> u32 {
    return FIRST_LAYER_LEN + HIDDEN_ROW * n_outputs();
}

// Fills `firsts` from the candidates of a block of GROUP; they are ascending, so an anchor's follow each other.
fn list_firsts(lane: u32, block: u32) {
    let c = block * GROUP + lane;
    var is_first = c < counters.candidates;
    if is_first && c > 0u {
        is_first = candidates[c] / view.k != candidates[c - 1u] / view.k;
    }
    let at = exclusive_sum(lane, u32(is_first));
    if is_first {
        firsts[at] = c;
    }
    if lane == 0u {
        n_firsts = scan_sums[SCAN_GROUP - 1u];
    }
}

fn slot_of(first: u32) -> u32 {
    return candidates[first] / view.k;
}

// An anchor's place from the camera, in the axes and units of its keyframe.
fn from_camera_of(anchor: DeviceAnchor, placement: KeyframeBlock) -> vec3<f32> {
    let p = in_camera(placement, position_of(anchor));
    let rotated = placement.row_x.xyz * p.x + placement.row_y.xyz * p.y + placement.row_z.xyz * p.z;
    // The rows are those of a rotation times the keyframe's scale.
    return rotated / dot(placement.row_x.xyz, placement.row_x.xyz);
}

// Direction from the camera to an anchor in the axes of its keyframe, and the logarithm of the distance.
fn view_input(anchor: DeviceAnchor) -> vec4<f32> {
    let from_camera = from_camera_of(anchor, keyframes[anchor.keyframe_row]);
    let distance_m = max(length(from_camera), MIN_DISTANCE_M);
    let log_distance = (binary_logarithm(distance_m) - LOG2_MIDDLE_DISTANCE) / LOG2_DISTANCE_UNIT;
    return vec4<f32>(from_camera / distance_m, log_distance);
}

// Fills `rows`, `n_numbers` and `inputs` with the anchors from `done` on, each by GROUP / BATCH invocations.
fn gather_inputs(lane: u32, done: u32) {
    let per_anchor = GROUP / BATCH;
    let a = lane / per_anchor;
    let part = lane % per_anchor;
    var row = NO_ROW;
    var n = 0u;
    if done + a < n_firsts {
        let first = firsts[done + a];
        let slot = slot_of(first);
        let anchor = anchors[slot];
        if chunk_row_of(anchor) < view.decoder_rows {
            row = chunk_row_of(anchor);
            // All used Gaussians of an anchor are candidates, except for those that did not fit.
            n = min(n_gaussians_of(anchor), counters.candidates - first) * N_PARAMS;
            for (var i = part; i < FEATURE_LEN; i += per_anchor) {
                inputs[a * INPUT_ROW + i] = features[slot * FEATURE_LEN + i];
            }
            if part == 0u {
                let seen_from = view_input(anchor);
                for (var i = 0u; i < INPUTS - FEATURE_LEN; i++) {
                    inputs[a * INPUT_ROW + FEATURE_LEN + i] = seen_from[i];
                }
            }
        }
    }
    if part == 0u {
        rows[a] = row;
        n_numbers[a] = n;
        inputs[a * INPUT_ROW + INPUTS] = 1.0;
        hidden[a * HIDDEN_ROW + HIDDEN] = 1.0;
    }
}

// Sums of products: what each of four anchors contributes to eight columns, one column of a matrix per anchor.
struct Tile {
    low: mat4x4<f32>,
    high: mat4x4<f32>,
}

// Where the eight columns stand in each row of a matrix.
struct Columns {
    low: vec4<u32>,
    high: vec4<u32>,
}

fn consecutive(first: u32) -> Columns {
    let low = first + vec4<u32>(0u, 1u, 2u, 3u);
    return Columns(low, low + 4u);
}

fn outer(x: vec4<f32>, w: vec4<f32>) -> mat4x4<f32> {
    return mat4x4<f32>(x.x * w, x.y * w, x.z * w, x.w * w);
}

fn weights_at(at: vec4<u32>) -> vec4<f32> {
    return vec4<f32>(decoders[at.x], decoders[at.y], decoders[at.z], decoders[at.w]);
}

// Adds the products of a number of each anchor with a row of weights.
fn add_row(tile: Tile, x: vec4<f32>, row: u32, columns: Columns) -> Tile {
    return Tile(
        tile.low + outer(x, weights_at(row + columns.low)),
        tile.high + outer(x, weights_at(row + columns.high)),
    );
}

// Anchors of a tile that have a chunk row, one bit each.
fn bits_of_row(a: u32, row: u32) -> u32 {
    return u32(rows[a] == row) | (u32(rows[a + 1u] == row) << 1u) | (u32(rows[a + 2u] == row) << 2u)
        | (u32(rows[a + 3u] == row) << 3u);
}

// Anchors of a tile that are to be decoded, one bit each. A tile is found once for every chunk row in it.
fn bits_to_decode(a: u32) -> u32 {
    return 15u ^ bits_of_row(a, NO_ROW);
}

fn inputs_of(a: u32, i: u32) -> vec4<f32> {
    let at = a * INPUT_ROW + i;
    return vec4<f32>(inputs[at], inputs[at + INPUT_ROW], inputs[at + 2u * INPUT_ROW], inputs[at + 3u * INPUT_ROW]);
}

fn hidden_of(a: u32, i: u32) -> vec4<f32> {
    let at = a * HIDDEN_ROW + i;
    return vec4<f32>(hidden[at], hidden[at + HIDDEN_ROW], hidden[at + 2u * HIDDEN_ROW], hidden[at + 3u * HIDDEN_ROW]);
}

fn store_hidden(a: u32, unit: u32, low: vec4<f32>, high: vec4<f32>) {
    let at = a * HIDDEN_ROW + unit;
    for (var i = 0u; i < 4u; i++) {
        hidden[at + i] = max(low[i], 0.0);
        hidden[at + 4u + i] = max(high[i], 0.0);
    }
}

// Fills `hidden`: relu(W1 x + b1).
fn find_hidden(lane: u32) {
    let a = lane / UNIT_TILES * TILE_ANCHORS;
    let unit = lane % UNIT_TILES * TILE_COLUMNS;
    var remaining = 0u;
    if a < BATCH {
        remaining = bits_to_decode(a);
    }
    while remaining != 0u {
        let row = rows[a + firstTrailingBit(remaining)];
        let same = bits_of_row(a, row);
        let columns = consecutive(row * decoder_len() + unit);
        var tile = add_row(Tile(), vec4<f32>(1.0), INPUTS * HIDDEN, columns);
        for (var i = 0u; i < INPUTS; i++) {
            tile = add_row(tile, inputs_of(a, i), i * HIDDEN, columns);
        }
        if (same & 1u) != 0u {
            store_hidden(a, unit, tile.low[0], tile.high[0]);
        }
        if (same & 2u) != 0u {
            store_hidden(a + 1u, unit, tile.low[1], tile.high[1]);
        }
        if (same & 4u) != 0u {
            store_hidden(a + 2u, unit, tile.low[2], tile.high[2]);
        }
        if (same & 8u) != 0u {
            store_hidden(a + 3u, unit, tile.low[3], tile.high[3]);
        }
        remaining &= ~same;
    }
}

// Where number `i` of an anchor's Gaussians, one after the other, stands in `effective` after its first candidate.
fn effective_offset(i: u32) -> u32 {
    return (i % N_PARAMS) * view.candidate_capacity + i / N_PARAMS;
}
