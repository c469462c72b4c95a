//! Developer commands: `cargo xtask test`, `cargo xtask bench`, `cargo xtask sequences`.
fn main() {}
