//! The program `kilogs` itself, as built for these tests.

use std::path::PathBuf;
use std::process::Command;
use std::sync::OnceLock;

/// The program, built first where it is not up to date; the same profile as the running test.
pub fn kilogs() -> Command {
    static PROGRAM: OnceLock<PathBuf> = OnceLock::new();
    Command::new(PROGRAM.get_or_init(build))
}

fn build() -> PathBuf {
    let test = std::env::current_exe().expect("a test program has a path");
    // target/<profile>/deps/<test>
    let folder = test.ancestors().nth(2).expect("cargo puts tests two folders below the programs");
    let mut cargo = Command::new(env!("CARGO"));
    cargo.args(["build", "--quiet", "--package", "kilogs", "--bin", "kilogs"]);
    if folder.ends_with("release") {
        cargo.arg("--release");
    }
    let status = cargo.current_dir(env!("CARGO_MANIFEST_DIR")).status().expect("cargo");
    assert!(status.success(), "building kilogs failed: cargo build --bin kilogs");
    folder.join("kilogs")
}
