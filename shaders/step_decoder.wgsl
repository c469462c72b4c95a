// One Adam step of the decoder that learns; the pieces' sums are added in their order. One invocation per number.
@group(0) @binding(1) var<storage, read> decoder_sums: array<f32>;
@group(0) @binding(2) var<storage, read_write> decoders: array<f32>;
@group(0) @binding(3) var<storage, read_write> decoder_first: array<f32>;
@group(0) @binding(4) var<storage, read_write> decoder_second: array<f32>;

// Numbers of the first layer, biases included, which begin a decoder.
const FIRST_LAYER_LEN: u32 = (INPUTS + 1u) * HIDDEN;

fn rate_of(w: u32) -> f32 {
    if w < FIRST_LAYER_LEN {
        return view.hidden_rate;
    }
    let i = (w - FIRST_LAYER_LEN) % N_PARAMS;
    if i < FIRST_LOG_SCALE {
        return view.output_offset_rate;
    }
    if i < FIRST_ROTATION {
        return view.output_log_scale_rate;
    }
    if i < FIRST_OPACITY {
        return view.output_rotation_rate;
    }
    return select(view.output_color_rate, view.output_opacity_rate, i == FIRST_OPACITY);
}

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let w = id.x;
    let len = FIRST_LAYER_LEN + (HIDDEN + 1u) * view.k * N_PARAMS;
    let rate = rate_of(w);
    if w < len && view.decoder_row < view.decoder_rows && rate > 0.0 {
        var grad = 0.0;
        for (var piece = 0u; piece < DECODER_PIECES; piece++) {
            grad += decoder_sums[piece * len + w];
        }
        let at = view.decoder_row * len + w;
        let before = AdamNumber(decoders[at], decoder_first[at], decoder_second[at]);
        let after = adam(before, grad, rate, bias_correction(f32(view.decoder_step)));
        decoders[at] = after.value;
        decoder_first[at] = after.first;
        decoder_second[at] = after.second;
    }
}
