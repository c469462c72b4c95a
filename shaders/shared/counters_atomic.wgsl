struct Counters {
    candidates_needed: atomic<u32>,
    candidates: atomic<u32>,
    visible: atomic<u32>,
    entries_needed: atomic<u32>,
    pairs_needed: atomic<u32>,
    pairs: atomic<u32>,
    masked_pixels: atomic<u32>,
    spare: u32,
}
