struct Counters {
    candidates_needed: u32,
    candidates: u32,
    visible: u32,
    entries_needed: u32,
    pairs_needed: u32,
    pairs: u32,
    masked_pixels: u32,
    spare: u32,
}
