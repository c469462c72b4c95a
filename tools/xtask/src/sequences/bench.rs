//! Where recordings, program and outputs are, and how one recording is replayed and judged.

use super::CommonArgs;
use crate::step::{StepFailed, run as step};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Everything that a table needs to make its rows.
pub(super) struct Bench {
    /// Folder of the recordings.
    pub data: PathBuf,
    /// Those that are wanted and there.
    pub recordings: Vec<String>,
    /// Folder of all outputs.
    pub out: PathBuf,
    kilogs: PathBuf,
}

impl CommonArgs {
    /// Whether a recording or drive of this name is wanted.
    pub fn is_wanted(&self, name: &str) -> bool {
        self.only.as_deref().is_none_or(|text| name.contains(text))
    }

    /// Finds what is needed; builds the program unless one is named.
    pub fn bench<'a>(&self, root: &Path, names: impl IntoIterator<Item = &'a str>) -> Result<Bench, StepFailed> {
        let from_environment = || std::env::var_os("KILOGS_DATA").map(PathBuf::from);
        let data = self.data.clone().or_else(from_environment).unwrap_or_else(|| root.join("../shared/data"));
        let mut recordings = Vec::new();
        for name in names.into_iter().filter(|name| self.is_wanted(name)) {
            if data.join(name).is_dir() {
                recordings.push(name.to_owned());
            } else {
                eprintln!("left out: {} is not there; give the folder with --data DIR", data.join(name).display());
            }
        }
        let kilogs = match &self.kilogs {
            Some(program) => program.clone(),
            None => {
                step(root, "release binary", "cargo", &["build", "--release", "--bin", "kilogs"], &[])?;
                root.join("target/release/kilogs")
            }
        };
        Ok(Bench { data, recordings, out: root.join("target/sequences"), kilogs })
    }
}

impl Bench {
    /// One that nothing is there for.
    #[cfg(test)]
    pub fn of(data: &str, out: &str, kilogs: &str) -> Self {
        let [data, out, kilogs] = [data, out, kilogs].map(PathBuf::from);
        Self { data, recordings: Vec::new(), out, kilogs }
    }

    /// Replays a recording into `out` and judges it by its truth, where it has one. What both say goes to `log.txt`.
    pub fn replay_and_judge(&self, dataset: &Path, out: &Path, options: &[String]) -> Result<(), StepFailed> {
        let [dataset_text, out_text] = [dataset, out].map(|path| path.to_string_lossy().into_owned());
        let mut words = vec!["replay".to_owned(), dataset_text.clone(), "--out".to_owned(), out_text.clone()];
        words.extend(options.iter().cloned());
        // Figures of an earlier run must not pass for those of one that fails.
        let _ = std::fs::remove_dir_all(out);
        self.kilogs(out, &words)?;
        let truth = dataset.join("poses.txt");
        if !truth.is_file() {
            return Ok(());
        }
        let truth = truth.to_string_lossy().into_owned();
        self.kilogs(out, &["eval", &out_text, "--gt", &truth, "--dataset", &dataset_text].map(str::to_owned))
    }

    /// Runs the program; a failure is told by its last line. What it prints goes to `said.txt`, its log to `log.txt`.
    pub fn kilogs(&self, out: &Path, words: &[String]) -> Result<(), StepFailed> {
        let command_line = format!("{} {}", self.kilogs.display(), words.join(" "));
        eprintln!("== {command_line}");
        let not_started =
            |source| StepFailed::NotStarted { name: "kilogs".to_owned(), command_line: command_line.clone(), source };
        std::fs::create_dir_all(out).map_err(not_started)?;
        let said = Command::new(&self.kilogs).args(words).stdin(Stdio::null()).output().map_err(not_started)?;
        let text = String::from_utf8_lossy(&said.stderr);
        std::fs::write(out.join("log.txt"), &*text).map_err(not_started)?;
        std::fs::write(out.join("said.txt"), &said.stdout).map_err(not_started)?;
        if said.status.success() {
            return Ok(());
        }
        let reason = reason_of_failure(&text);
        Err(StepFailed::Broken(format!("{reason} ({})", said.status)))
    }
}

/// The line of a program's words that says why it failed.
fn reason_of_failure(text: &str) -> String {
    let mut lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
    let error = lines.clone().find(|line| line.to_lowercase().contains("error"));
    let line = error.or_else(|| lines.next_back()).unwrap_or("it said nothing");
    line.trim_start_matches("error: ").to_owned()
}

/// A text of an output folder.
pub(super) fn read_text(path: &Path) -> Result<String, StepFailed> {
    std::fs::read_to_string(path).map_err(|error| unreadable(path, &error))
}

/// A JSON document of an output folder.
pub(super) fn read_json(path: &Path) -> Result<Value, StepFailed> {
    serde_json::from_str(&read_text(path)?).map_err(|error| unreadable(path, &error))
}

fn unreadable(path: &Path, error: &dyn std::fmt::Display) -> StepFailed {
    StepFailed::Broken(format!("reading {}: {error}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failure_is_told_by_its_line() {
        let check = |text: &str, expected: &str| assert_eq!(reason_of_failure(text), expected);
        check("[INFO] starting\nerror: no such setting\n\nFor more information\n", "no such setting");
        check("starting\nthe device is gone\n", "the device is gone");
        check("", "it said nothing");
    }
}
