//! Each rule finds what breaks it, and the workspace breaks none.

use super::*;

fn lines_broken(file: &str, text: &str) -> Vec<usize> {
    rules::of_file(Path::new(file), text).iter().map(|rule| rule.line).collect()
}

#[test]
fn the_workspace_keeps_its_rules() {
    let broken: Vec<_> = broken_rules(&crate::workspace_root()).iter().map(ToString::to_string).collect();
    assert!(broken.is_empty(), "{}", broken.join("\n"));
}

#[test]
fn long_files_are_found() {
    let check = |n_lines: usize, expected: &[usize]| {
        assert_eq!(lines_broken("runtime/src/a.rs", &"// x\n".repeat(n_lines)), expected, "{n_lines}");
        assert_eq!(lines_broken("shaders/a.wgsl", &"// x\n".repeat(n_lines)), expected, "{n_lines}");
    };
    check(399, &[]);
    check(400, &[0]);
}

#[test]
fn unsafe_is_found_where_it_is_code() {
    let check = |file: &str, text: &str, expected: &[usize]| assert_eq!(lines_broken(file, text), expected, "{text}");
    check("runtime/src/map.rs", "fn f() {\n    unsafe { g() }\n}\n", &[2]);
    check("runtime/src/map.rs", "unsafe impl Send for X {}", &[1]);
    check("runtime/src/map.rs", "let quote = '\"'; unsafe { g() }", &[1]);
    check("runtime/src/map.rs", "let text = \"a \\\" b\"; unsafe { g() }", &[1]);
    check("runtime/src/map.rs", "// unsafe here\nlet x = \"unsafe\";\n#![forbid(unsafe_code)]\n", &[]);
    check("runtime/src/splat/cpu/simd.rs", "unsafe { g() }", &[]);
    check("runtime/src/splat/mod.rs", "unsafe { g() }", &[1]);
}

#[test]
fn core_without_its_attributes_is_found() {
    let check = |file: &str, text: &str, expected: &[usize]| assert_eq!(lines_broken(file, text), expected, "{text}");
    check("core/src/lib.rs", "#![no_std]\n#![forbid(unsafe_code)]\n", &[]);
    check("core/src/lib.rs", "#![no_std]\n", &[1]);
    check("core/src/lib.rs", "", &[1, 1]);
    check("core/src/x.rs", "extern crate std;\n", &[1]);
    check("core/src/x.rs", "#[cfg(test)]\nextern crate std;\n", &[]);
    check("core/src/x.rs", "extern crate alloc;\n", &[1]);
}

#[test]
fn a_formula_without_a_source_is_found() {
    let check =
        |text: &str, expected: &[usize]| assert_eq!(lines_broken("core/src/pose/x.rs", text), expected, "{text}");
    check("/// Adds.\n///\n/// # Source\n/// Gauss 1801.\npub fn add() {}\n", &[]);
    check("/// # Source\n/// Gauss 1801.\n#[must_use]\npub fn add() {}\n", &[]);
    check("/// Source: own derivation, see docs/x.md\npub fn add() {}\n", &[]);
    check("/// Adds.\npub fn add() {}\n", &[2]);
    check("/// # Source\n/// Gauss 1801.\npub fn add() {}\npub fn sub() {}\n", &[4]);
    check("fn private() {}\n", &[]);
    assert_eq!(lines_broken("core/src/frame/x.rs", "pub fn add() {}\n"), [0; 0]);
}

#[test]
fn strangers_at_the_root_are_found() {
    let check = |name: &str, expected: bool| assert_eq!(rules::may_stand_at_the_root(name), expected, "{name}");
    check("core", true);
    check(".ci", true);
    check("notes.txt", false);
    check("src", false);
}
