//! Rules of the workspace that no compiler checks.

mod rules;
mod source_text;

use std::fmt;
use std::path::{Path, PathBuf};

/// A rule that a file breaks.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct BrokenRule {
    /// The file, from the root.
    pub(crate) file: PathBuf,
    /// Line, from 1; 0 for the file as a whole.
    pub(crate) line: usize,
    /// What is wrong and what to do.
    pub(crate) what: String,
}

impl fmt::Display for BrokenRule {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}: {}", self.file.display(), self.line, self.what)
    }
}

const SOURCE_FOLDERS: [&str; 5] = ["core", "runtime", "tools", "tests", "shaders"];

/// Everything in the workspace that breaks a rule.
pub(crate) fn broken_rules(root: &Path) -> Vec<BrokenRule> {
    let mut files = Vec::new();
    for folder in SOURCE_FOLDERS {
        collect_sources(&root.join(folder), &mut files);
    }
    files.sort();
    let mut broken = rules::top_level(root);
    for path in &files {
        let relative = path.strip_prefix(root).unwrap_or(path);
        match std::fs::read_to_string(path) {
            Ok(text) => broken.extend(rules::of_file(relative, &text)),
            Err(error) => {
                broken.push(BrokenRule { file: relative.to_owned(), line: 0, what: format!("not readable: {error}") });
            }
        }
    }
    broken
}

fn collect_sources(folder: &Path, files: &mut Vec<PathBuf>) {
    let Ok(entries) = std::fs::read_dir(folder) else { return };
    for entry in entries.flatten() {
        let path = entry.path();
        if path.is_dir() && entry.file_name() != "target" {
            collect_sources(&path, files);
        } else if path.extension().is_some_and(|extension| extension == "rs" || extension == "wgsl") {
            files.push(path);
        }
    }
}

#[cfg(test)]
mod tests;
