// Splats that meet each row of tiles, by depth. One workgroup per row, one invocation per piece of the depth order.
@group(0) @binding(1) var<storage, read> counters: Counters;
@group(0) @binding(2) var<storage, read> order: array<u32>;
@group(0) @binding(3) var<storage, read> splats: array<Splat>;
@group(0) @binding(4) var<storage, read> entry_offsets: array<u32>;
@group(0) @binding(5) var<storage, read> entry_starts: array<u32>;
@group(0) @binding(6) var<storage, read_write> entries: array<Entry>;

@compute @workgroup_size(GROUP)
fn main(@builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let top = group.x * TILE_PX;
    let n = counters.visible;
    let len = (n + GROUP - 1u) / GROUP;
    let end = min((lane + 1u) * len, n);
    var at = entry_starts[group.x] + entry_offsets[group.x * GROUP + lane];
    for (var i = lane * len; i < end && at < view.entry_capacity; i++) {
        let splat = order[i];
        let rows = splats[splat].rows_px;
        let first_px = rows & 0xffffu;
        let last_px = rows >> 16u;
        if last_px < top || first_px >= top + TILE_PX {
            continue;
        }
        let columns =
            columns_in(ellipse_of(splats[splat]), max(top, first_px), min(last_px, top + TILE_PX - 1u));
        // An empty interval is stored as tiles 1..=0.
        var tiles = 1u;
        if columns.x <= columns.y {
            tiles = (u32(columns.x) / TILE_PX) | ((u32(columns.y) / TILE_PX) << 16u);
        }
        entries[at] = Entry(splat, tiles);
        at++;
    }
}
