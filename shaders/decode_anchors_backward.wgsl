// From gradients of the candidates' numbers to those of the decoder that learns and of the camera's place, summed over one
// piece of the candidates per workgroup, and the Adam step of the features. The hidden layer is computed once more instead of being kept.
@group(0) @binding(5) var<storage, read_write> features: array<f32>;
@group(0) @binding(6) var<storage, read> decoders: array<f32>;
@group(0) @binding(7) var<storage, read> effective: array<f32>;
@group(0) @binding(8) var<storage, read_write> feature_moments: array<f32>;
@group(0) @binding(9) var<storage, read_write> decoder_sums: array<f32>;

// Of the hidden units before the rectifier.
var<workgroup> hidden_grads: array<f32, BATCH * HIDDEN>;
// Numbers of each anchor that the decoder learns from.
var<workgroup> n_learnt: array<u32, BATCH>;

// Numbers that are kept of a feature: both running means, then the steps.
const MOMENTS_LEN: u32 = 2u * FEATURE_LEN + 1u;

fn output_grad(first: u32, i: u32) -> f32 {
    let grad = effective[effective_index(first, i)];
    // Not a number fails this comparison.
    return select(0.0, grad, abs(grad) < MAX_GRADIENT);
}

// Fills a quad of `hidden_grads`; whether anything of the anchor was seen.
fn find_hidden_grads(seen: Seen) -> bool {
    let n = n_outputs();
    let own = seen.quad * QUAD;
    let rows = seen.weights + FIRST_LAYER_LEN + own * n;
    var sum = vec4<f32>();
    var any_grad = false;
    for (var i = 0u; i < seen.n_numbers; i++) {
        let grad = output_grad(seen.first, i);
        any_grad = any_grad || grad != 0.0;
        let at = rows + i;
        sum += grad * vec4<f32>(decoders[at], decoders[at + n], decoders[at + 2u * n], decoders[at + 3u * n]);
    }
    for (var i = 0u; i < QUAD; i++) {
        let is_awake = seen.n_numbers > 0u && hidden[seen.a * HIDDEN_ROW + own + i] > 0.0;
        hidden_grads[seen.a * HIDDEN + own + i] = select(0.0, sum[i], is_awake);
    }
    if seen.quad == 0u {
        n_learnt[seen.a] = select(0u, seen.n_numbers, seen.chunk_row == view.decoder_row);
    }
    return any_grad;
}

// One Adam step of a quad of the anchor's feature.
fn step_feature(seen: Seen, steps: f32) {
    let own = seen.quad * QUAD;
    let moments = seen.slot * MOMENTS_LEN;
    let correction = bias_correction(steps);
    for (var i = own; i < own + QUAD; i++) {
        var grad = 0.0;
        for (var unit = 0u; unit < HIDDEN; unit++) {
            grad += decoders[seen.weights + i * HIDDEN + unit] * hidden_grads[seen.a * HIDDEN + unit];
        }
        let at = seen.slot * FEATURE_LEN + i;
        let before = AdamNumber(features[at], feature_moments[moments + i], feature_moments[moments + FEATURE_LEN + i]);
        let after = adam(before, grad, view.feature_rate, correction);
        features[at] = after.value;
        feature_moments[moments + i] = after.first;
        feature_moments[moments + FEATURE_LEN + i] = after.second;
    }
    if seen.quad == 0u {
        feature_moments[moments + 2u * FEATURE_LEN] = steps;
    }
}

// Gradient with respect to the moving of the camera's pose, through what the decoder is told of an anchor's place.
fn camera_gradient(seen: Seen) -> vec3<f32> {
    var grad = vec4<f32>();
    for (var i = 0u; i < INPUTS - FEATURE_LEN; i++) {
        let row = seen.weights + (FEATURE_LEN + i) * HIDDEN;
        for (var unit = 0u; unit < HIDDEN; unit++) {
            grad[i] += decoders[row + unit] * hidden_grads[seen.a * HIDDEN + unit];
        }
    }
    let anchor = anchors[seen.slot];
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

// Adds the gradients of a weight from all anchors at hand: what its layer reads times the gradient of what it makes.
fn grad_of_weight(w: u32, done: u32) -> f32 {
    var sum = 0.0;
    let n_anchors = min(n_firsts - done, BATCH);
    if w < FIRST_LAYER_LEN {
        for (var a = 0u; a < n_anchors; a++) {
            if n_learnt[a] > 0u {
                sum += inputs[a * INPUT_ROW + w / HIDDEN] * hidden_grads[a * HIDDEN + w % HIDDEN];
            }
        }
    } else {
        let unit = (w - FIRST_LAYER_LEN) / n_outputs();
        let output = (w - FIRST_LAYER_LEN) % n_outputs();
        for (var a = 0u; a < n_anchors; a++) {
            if output < n_learnt[a] {
                sum += hidden[a * HIDDEN_ROW + unit] * output_grad(firsts[done + a], output);
            }
        }
    }
    return sum;
}

@compute @workgroup_size(GROUP)
fn main(@builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let sums = group.x * decoder_len();
    let n_learning = select(0u, decoder_len(), view.decoder_row < view.decoder_rows);
    for (var w = lane; w < n_learning; w += GROUP) {
        decoder_sums[sums + w] = 0.0;
    }
    var shift = vec3<f32>();
    let n_blocks = (counters.candidates + GROUP - 1u) / GROUP;
    for (var block = group.x; block < n_blocks; block += DECODER_PIECES) {
        list_firsts(lane, block);
        let n = workgroupUniformLoad(&n_firsts);
        for (var done = 0u; done < n; done += BATCH) {
            let seen = seen_anchor(lane, done);
            find_hidden(seen);
            let is_seen = find_hidden_grads(seen);
            // All invocations of an anchor read its steps before one of them counts.
            var steps = 0.0;
            if is_seen {
                steps = min(feature_moments[seen.slot * MOMENTS_LEN + 2u * FEATURE_LEN] + 1.0, f32(ADAM_MAX_STEPS));
            }
            workgroupBarrier();
            if is_seen && view.feature_rate > 0.0 {
                step_feature(seen, steps);
            }
            if view.finds_pose != 0u && seen.quad == 0u && seen.n_numbers > 0u {
                shift += camera_gradient(seen);
            }
            for (var w = lane; w < n_learning; w += GROUP) {
                decoder_sums[sums + w] += grad_of_weight(w, done);
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
