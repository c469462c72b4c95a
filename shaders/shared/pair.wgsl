// A splat that meets a tile.
struct Pair {
    splat: u32,
    // Blocks of the tile that it touches, one bit each.
    blocks: u32,
}
