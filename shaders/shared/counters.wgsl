struct Counters {
    candidates_needed: u32,
    candidates: u32,
    visible: u32,
    entries_needed: u32,
    pairs_needed: u32,
    pairs: u32,
    spare_a: u32,
    spare_b: u32,
}
