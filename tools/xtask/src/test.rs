//! `cargo xtask test`: every check, cheapest first, the tests last so that the output ends with their summary.

use crate::step::{StepFailed, has_cargo_command, run as step};
use crate::{guards, setup};
use std::path::Path;

const PROOF: &str = "kilogs-nostd-proof";

/// Runs every check; stops at the first that fails.
pub(crate) fn run(root: &Path) -> Result<(), StepFailed> {
    let has_vulkan = setup::vulkan(root);
    step(root, "format", "cargo", &["fmt", "--all", "--check"], &[])?;
    guards(root)?;
    if has_cargo_command("deny") {
        step(root, "licences and sources", "cargo", &["deny", "check", "licenses", "bans", "sources"], &[])?;
    } else {
        eprintln!("\n== licences and sources: left out, cargo-deny is not installed (cargo install cargo-deny)");
    }
    let everything = ["--workspace", "--exclude", PROOF];
    let with = |first: &[&'static str], last: &[&'static str]| [first, &everything[..], last].concat();
    step(root, "lints", "cargo", &with(&["clippy"], &["--all-targets", "--", "-D", "warnings"]), &[])?;
    nostd_proof(root)?;
    // Tests that start the programs look for them beside their own executable.
    step(root, "programs", "cargo", &with(&["build"], &["--bins"]), &[])?;
    let doc_lints = [("RUSTDOCFLAGS", "-D warnings -A rustdoc::private_intra_doc_links")];
    step(root, "documentation", "cargo", &with(&["doc"], &["--no-deps", "--document-private-items"]), &doc_lints)?;
    let environment: &[(&str, &str)] = if has_vulkan { &[("KILOGS_REQUIRE_VULKAN", "1")] } else { &[] };
    if has_cargo_command("nextest") {
        step(root, "examples in the documentation", "cargo", &with(&["test"], &["--doc"]), environment)?;
        step(root, "tests", "cargo", &with(&["nextest", "run"], &["--no-fail-fast"]), environment)
    } else {
        step(root, "tests", "cargo", &with(&["test"], &["--no-fail-fast"]), environment)
    }
}

/// Builds and runs the program that has neither std nor an allocator nor libc. Alone, so that no other package's
/// features reach `kilogs-core`.
fn nostd_proof(root: &Path) -> Result<(), StepFailed> {
    step(root, "no-std proof", "cargo", &["run", "--quiet", "-p", PROOF, "--profile", "nostd"], &[])
}

/// Prints every broken rule.
pub(crate) fn guards(root: &Path) -> Result<(), StepFailed> {
    eprintln!("\n== guards: the rules of the workspace");
    let broken = guards::broken_rules(root);
    for rule in &broken {
        eprintln!("{rule}");
    }
    if broken.is_empty() { Ok(()) } else { Err(StepFailed::Broken(format!("{} broken rules", broken.len()))) }
}
