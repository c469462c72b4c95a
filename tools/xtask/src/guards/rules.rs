//! The rules themselves, each a function from a file's text to what breaks it.

use super::BrokenRule;
use super::source_text::{code_of, has_word};
use std::path::Path;

const MAX_LINES: usize = 400;

/// Where `unsafe` may stand, and why.
const UNSAFE_PLACES: [(&str, &str); 5] = [
    ("runtime/src/splat/cpu/", "dispatch of SIMD instructions"),
    ("runtime/src/splat/vulkan/", "a C interface"),
    ("runtime/src/pool.rs", "jobs that borrow, without an allocation per job"),
    ("runtime/src/seal/allocator.rs", "a global allocator is an unsafe trait"),
    ("tools/nostd-proof/src/bare.rs", "a program without libc starts and exits by itself"),
];

/// Folders whose free public functions are formulas and say where they are from.
const FORMULA_FOLDERS: [&str; 5] =
    ["core/src/math/", "core/src/pose/", "core/src/scale/", "core/src/bundle/", "core/src/loop_closure/"];

/// What may stand at the root.
const TOP_LEVEL: [&str; 17] = [
    "core",
    "runtime",
    "shaders",
    "models",
    "tools",
    "tests",
    "docs",
    "Cargo.toml",
    "Cargo.lock",
    "memory_budget.toml",
    "README.md",
    "ARCHITECTURE.md",
    "CHANGELOG.md",
    "LICENSE-MIT",
    "LICENSE-APACHE",
    "rust-toolchain.toml",
    "deny.toml",
];

/// Build output, which git ignores.
const IGNORED: [&str; 2] = ["target", "out"];

pub(super) fn top_level(root: &Path) -> Vec<BrokenRule> {
    let Ok(entries) = std::fs::read_dir(root) else { return vec![] };
    let names = entries.flatten().map(|entry| entry.file_name().to_string_lossy().into_owned());
    names
        .filter(|name| !may_stand_at_the_root(name))
        .map(|name| BrokenRule {
            file: name.into(),
            line: 0,
            what: "nothing else belongs at the root: move it to the package or folder it is for".to_owned(),
        })
        .collect()
}

pub(super) fn may_stand_at_the_root(name: &str) -> bool {
    // rustfmt reads its settings from here only.
    name.starts_with('.') || name == "rustfmt.toml" || TOP_LEVEL.contains(&name) || IGNORED.contains(&name)
}

pub(super) fn of_file(file: &Path, text: &str) -> Vec<BrokenRule> {
    let path = file.to_string_lossy().replace('\\', "/");
    let mut broken = Vec::new();
    let mut report = |line: usize, what: String| broken.push(BrokenRule { file: file.to_owned(), line, what });
    let n_lines = text.lines().count();
    if n_lines >= MAX_LINES {
        report(0, format!("{n_lines} lines; a file has under {MAX_LINES}: it is two files"));
    }
    if path.ends_with(".rs") {
        unsafe_has_an_address(&path, text, &mut report);
        if path.starts_with("core/src/") {
            core_stays_bare(&path, text, &mut report);
        }
        if FORMULA_FOLDERS.iter().any(|folder| path.starts_with(folder)) {
            formulas_have_a_source(text, &mut report);
        }
    }
    broken
}

fn unsafe_has_an_address(path: &str, text: &str, report: &mut impl FnMut(usize, String)) {
    if UNSAFE_PLACES.iter().any(|(place, _)| path.starts_with(place)) {
        return;
    }
    for (idx, line) in text.lines().enumerate() {
        if has_word(&code_of(line), "unsafe") {
            let places: Vec<_> = UNSAFE_PLACES.iter().map(|(place, why)| format!("{place} ({why})")).collect();
            report(idx + 1, format!("unsafe outside its places: {}", places.join(", ")));
        }
    }
}

/// The compiler enforces the two attributes; this makes sure that they stay, and that std comes in for tests only.
fn core_stays_bare(path: &str, text: &str, report: &mut impl FnMut(usize, String)) {
    if path == "core/src/lib.rs" {
        for attribute in ["#![no_std]", "#![forbid(unsafe_code)]"] {
            if !text.lines().any(|line| line == attribute) {
                report(1, format!("core says {attribute}"));
            }
        }
    }
    let mut previous = "";
    for (idx, line) in text.lines().enumerate() {
        let code = code_of(line);
        let is_foreign = ["std", "alloc"].iter().any(|name| code.contains(&format!("extern crate {name}")));
        if is_foreign && previous.trim() != "#[cfg(test)]" {
            report(idx + 1, "core uses std in tests only: put #[cfg(test)] on the line above".to_owned());
        }
        previous = line;
    }
}

fn formulas_have_a_source(text: &str, report: &mut impl FnMut(usize, String)) {
    let mut has_source = false;
    for (idx, line) in text.lines().enumerate() {
        if line.starts_with("///") {
            has_source |= line.starts_with("/// # Source") || line.contains("Source: own derivation");
        } else if line.starts_with("pub fn ") || line.starts_with("pub const fn ") {
            if !has_source {
                let what = "a public formula has a heading `# Source` (paper and equation) in its documentation, \
                            or the words `Source: own derivation`";
                report(idx + 1, what.to_owned());
            }
            has_source = false;
        } else if !line.starts_with("#[") {
            has_source = false;
        }
    }
}
