// Adds what each chunk's decoder makes of its anchors to the numbers of their candidates: W2 relu(W1 x + b1) + b2.
@group(0) @binding(5) var<storage, read> features: array<f32>;
@group(0) @binding(6) var<storage, read> decoders: array<f32>;
@group(0) @binding(7) var<storage, read_write> effective: array<f32>;

fn add_residual(seen: Seen) {
    let n = n_outputs();
    let rows = seen.weights + FIRST_LAYER_LEN;
    for (var i = seen.quad; i < seen.n_numbers; i += QUADS) {
        var residual = decoders[rows + HIDDEN * n + i];
        for (var unit = 0u; unit < HIDDEN; unit++) {
            residual += decoders[rows + unit * n + i] * hidden[seen.a * HIDDEN_ROW + unit];
        }
        effective[effective_index(seen.first, i)] += residual;
    }
}

@compute @workgroup_size(GROUP)
fn main(@builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3<u32>) {
    list_firsts(lane, group.x);
    let n = workgroupUniformLoad(&n_firsts);
    for (var done = 0u; done < n; done += BATCH) {
        let seen = seen_anchor(lane, done);
        find_hidden(seen);
        add_residual(seen);
        workgroupBarrier();
    }
}
