//! Proof that `kilogs-core` needs no std, no allocator and no libc: this program has none of them.
//!
//! `cargo xtask test` builds it alone with `--profile nostd` and runs it. It solves small tracking problems through
//! the same functions that the vehicle uses and exits with 0, or prints which one failed and exits with 1.
#![cfg_attr(panic = "abort", no_std, no_main)]

#[cfg(panic = "abort")]
mod bare;
#[cfg(panic = "abort")]
mod drive;
#[cfg(panic = "abort")]
mod problems;

#[cfg(not(panic = "abort"))]
fn main() {
    eprintln!("the proof is: cargo run -p kilogs-nostd-proof --profile nostd");
}
