// Adds what each chunk's decoder makes of its anchors to the numbers of their candidates: W2 relu(W1 x + b1) + b2.
@group(0) @binding(5) var<storage, read> features: array<f32>;
@group(0) @binding(6) var<storage, read> decoders: array<f32>;
@group(0) @binding(7) var<storage, read_write> effective: array<f32>;

fn add_outputs(a: u32, first: u32, output: u32, low: vec4<f32>, high: vec4<f32>) {
    for (var i = 0u; i < 4u; i++) {
        if output + i < n_numbers[a] {
            effective[first + effective_offset(output + i)] += low[i];
        }
        if output + 4u + i < n_numbers[a] {
            effective[first + effective_offset(output + 4u + i)] += high[i];
        }
    }
}

// Eight outputs of four anchors, of which `done` come before the first of the batch.
fn add_tile(a: u32, done: u32, output: u32) {
    let n = n_outputs();
    var remaining = bits_to_decode(a);
    while remaining != 0u {
        let row = rows[a + firstTrailingBit(remaining)];
        let same = bits_of_row(a, row);
        var columns = consecutive(output);
        // Columns beyond the last one are found and not used.
        let begin = row * decoder_len() + FIRST_LAYER_LEN;
        columns = Columns(begin + min(columns.low, vec4<u32>(n - 1u)), begin + min(columns.high, vec4<u32>(n - 1u)));
        var tile = add_row(Tile(), vec4<f32>(1.0), HIDDEN * n, columns);
        for (var unit = 0u; unit < HIDDEN; unit++) {
            tile = add_row(tile, hidden_of(a, unit), unit * n, columns);
        }
        if (same & 1u) != 0u {
            add_outputs(a, firsts[done + a], output, tile.low[0], tile.high[0]);
        }
        if (same & 2u) != 0u {
            add_outputs(a + 1u, firsts[done + a + 1u], output, tile.low[1], tile.high[1]);
        }
        if (same & 4u) != 0u {
            add_outputs(a + 2u, firsts[done + a + 2u], output, tile.low[2], tile.high[2]);
        }
        if (same & 8u) != 0u {
            add_outputs(a + 3u, firsts[done + a + 3u], output, tile.low[3], tile.high[3]);
        }
        remaining &= ~same;
    }
}

@compute @workgroup_size(GROUP)
fn main(@builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3<u32>) {
    list_firsts(lane, group.x);
    let n = workgroupUniformLoad(&n_firsts);
    let output_tiles = (n_outputs() + TILE_COLUMNS - 1u) / TILE_COLUMNS;
    for (var done = 0u; done < n; done += BATCH) {
        gather_inputs(lane, done);
        workgroupBarrier();
        find_hidden(lane);
        workgroupBarrier();
        for (var tile = lane; tile < output_tiles * (BATCH / TILE_ANCHORS); tile += GROUP) {
            add_tile(tile / output_tiles * TILE_ANCHORS, done, tile % output_tiles * TILE_COLUMNS);
        }
        workgroupBarrier();
    }
}
