// Splats that meet each row of tiles, by depth. One workgroup per row, one invocation per piece of the depth order.
@group(0) @binding(1) var<storage, read> counters: Counters;
@group(0) @binding(2) var<storage, read> order: array<u32>;
@group(0) @binding(3) var<storage, read> splats: array<Splat>;
@group(0) @binding(4) var<storage, read> entry_offsets: array<u32>;
@group(0) @binding(5) var<storage, read> entry_starts: array<u32>;
@group(0) @binding(6) var<storage, read_write> entries: array<Entry>;

fn meets_row(rows_px: u32, top: u32) -> bool {
    return (rows_px >> 16u) >= top && (rows_px & 0xffffu) < top + TILE_PX;
}

@compute @workgroup_size(GROUP)
fn main(@builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let top = group.x * TILE_PX;
    let n = counters.visible;
    let len = (n + GROUP - 1u) / GROUP;
    let end = min((lane + 1u) * len, n);
    var at = entry_starts[group.x] + entry_offsets[group.x * GROUP + lane];
    var i = lane * len;
    while at < view.entry_capacity {
        // The next splat that meets this row: cheap, so that the rest, which is not, keeps all invocations busy.
        while i < end && !meets_row(splats[order[i]].rows_px, top) {
            i++;
        }
        if i >= end {
            break;
        }
        let splat = order[i];
        i++;
        let rows = splats[splat].rows_px;
        let columns =
            columns_in(ellipse_of(splats[splat]), max(top, rows & 0xffffu), min(rows >> 16u, top + TILE_PX - 1u));
        // An empty interval is stored as tiles 1..=0.
        var tiles = 1u;
        if columns.x <= columns.y {
            tiles = (u32(columns.x) / TILE_PX) | ((u32(columns.y) / TILE_PX) << 16u);
        }
        entries[at] = Entry(splat, tiles);
        at++;
    }
}
