//! A static binary of `kilogs-core` without std.
fn main() {}
