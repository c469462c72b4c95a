//! `kilogs-camera`: the capture process.
fn main() {}
