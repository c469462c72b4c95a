struct Bounds {
    color: atomic<u32>,
    depth: atomic<u32>,
    value: atomic<u32>,
    spare: u32,
}
