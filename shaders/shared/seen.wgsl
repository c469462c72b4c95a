// The anchors of a workgroup's candidates on their way into their chunks' decoders, some at a time: eight invocations
// to an anchor, each with four of its features and four of its hidden units.
@group(0) @binding(1) var<storage, read> anchors: array<DeviceAnchor>;
@group(0) @binding(2) var<storage, read> keyframes: array<KeyframeBlock>;
@group(0) @binding(3) var<storage, read> candidates: array<u32>;
@group(0) @binding(4) var<storage, read> counters: Counters;

// Numbers of an invocation.
const QUAD: u32 = 4u;
// Invocations to an anchor.
const QUADS: u32 = HIDDEN / QUAD;
// Anchors at a time.
const BATCH: u32 = GROUP / QUADS;
// Inputs of a layer, the last of which is 1 and carries the bias.
const INPUT_ROW: u32 = INPUTS + 1u;
const HIDDEN_ROW: u32 = HIDDEN + 1u;
// Where the second layer begins in a decoder (see core/src/map/decoder.rs).
const FIRST_LAYER_LEN: u32 = INPUT_ROW * HIDDEN;

// First candidates of the workgroup's anchors, ascending.
var<workgroup> firsts: array<u32, GROUP>;
var<workgroup> n_firsts: u32;
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

// An invocation's anchor.
struct Seen {
    // Place among the anchors at a time.
    a: u32,
    // Place among the invocations of the anchor.
    quad: u32,
    first: u32,
    slot: u32,
    // Numbers that are drawn of it; 0 where there is no anchor or no decoder.
    n_numbers: u32,
    chunk_row: u32,
    // Where its decoder begins.
    weights: u32,
}

fn seen_anchor(lane: u32, done: u32) -> Seen {
    let a = lane / QUADS;
    var seen = Seen(a, lane % QUADS, 0u, 0u, 0u, 0u, 0u);
    if done + a < n_firsts {
        seen.first = firsts[done + a];
        seen.slot = candidates[seen.first] / view.k;
        let anchor = anchors[seen.slot];
        seen.chunk_row = chunk_row_of(anchor);
        if seen.chunk_row < view.decoder_rows {
            // All used Gaussians of an anchor are candidates, except for those that did not fit.
            seen.n_numbers = min(n_gaussians_of(anchor), counters.candidates - seen.first) * N_PARAMS;
            seen.weights = seen.chunk_row * decoder_len();
        }
    }
    return seen;
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

// Fills the rows of `inputs` and `hidden`: relu(W1 x + b1). The whole workgroup calls it.
fn find_hidden(seen: Seen) {
    let own = seen.quad * QUAD;
    let row = seen.a * INPUT_ROW;
    if seen.n_numbers > 0u {
        for (var i = own; i < own + QUAD; i++) {
            inputs[row + i] = features[seen.slot * FEATURE_LEN + i];
        }
        if seen.quad == 0u {
            let seen_from = view_input(anchors[seen.slot]);
            for (var i = 0u; i < INPUTS - FEATURE_LEN; i++) {
                inputs[row + FEATURE_LEN + i] = seen_from[i];
            }
            inputs[row + INPUTS] = 1.0;
        }
    }
    workgroupBarrier();
    if seen.n_numbers > 0u {
        let units = seen.weights + own;
        var sum = weights_at(units + INPUTS * HIDDEN);
        for (var j = 0u; j < INPUTS; j++) {
            sum += weights_at(units + j * HIDDEN) * inputs[row + j];
        }
        for (var i = 0u; i < QUAD; i++) {
            hidden[seen.a * HIDDEN_ROW + own + i] = max(sum[i], 0.0);
        }
        if seen.quad == 0u {
            hidden[seen.a * HIDDEN_ROW + HIDDEN] = 1.0;
        }
    }
    workgroupBarrier();
}

fn weights_at(at: u32) -> vec4<f32> {
    return vec4<f32>(decoders[at], decoders[at + 1u], decoders[at + 2u], decoders[at + 3u]);
}

// Where number `i` of an anchor's Gaussians, one after the other, stands in `effective`.
fn effective_index(first: u32, i: u32) -> u32 {
    return (i % N_PARAMS) * view.candidate_capacity + first + i / N_PARAMS;
}
