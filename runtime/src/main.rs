//! `kilogs`: the command line.
fn main() {}
