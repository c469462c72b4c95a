// Largest magnitudes of the loss gradient, as the bits of floats (their order is that of the floats).
struct Bounds {
    // Of red, green and blue.
    color: u32,
    depth: u32,
    // Of what a splat can gain or lose at one pixel.
    value: u32,
    spare: u32,
}
