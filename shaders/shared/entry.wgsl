// A splat that meets a row of tiles.
struct Entry {
    splat: u32,
    // First and last column of tiles that it may touch in this row, 16 bits each; the last is less than the first when
    // there is none.
    tiles: u32,
}

fn first_tile(e: Entry) -> u32 {
    return e.tiles & 0xffffu;
}

fn last_tile(e: Entry) -> u32 {
    return e.tiles >> 16u;
}

fn meets_tile(e: Entry, column: u32) -> bool {
    return first_tile(e) <= column && column <= last_tile(e);
}
