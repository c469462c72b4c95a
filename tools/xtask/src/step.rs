//! One external command, shown before it runs.

use std::path::Path;
use std::process::Command;

/// A command did not succeed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum StepFailed {
    /// It ran and failed; its own output says why.
    #[error("{name} failed; to repeat it alone: {command_line}")]
    Failed {
        /// What the step is for.
        name: String,
        /// What was run.
        command_line: String,
    },
    /// It could not be started.
    #[error("{name}: starting {command_line}: {source}")]
    NotStarted {
        /// What the step is for.
        name: String,
        /// What was to be run.
        command_line: String,
        /// Why it did not start.
        source: std::io::Error,
    },
    /// The workspace breaks its own rules, or a figure could not be had.
    #[error("{0}")]
    Broken(String),
}

/// Runs `program` in `root` and waits for it.
pub(crate) fn run(
    root: &Path,
    name: &str,
    program: &str,
    arguments: &[&str],
    environment: &[(&str, &str)],
) -> Result<(), StepFailed> {
    let variables: String = environment.iter().map(|(key, value)| format!("{key}='{value}' ")).collect();
    let command_line = format!("{variables}{program} {}", arguments.join(" "));
    eprintln!("\n== {name}: {command_line}");
    let status = Command::new(program).args(arguments).envs(environment.iter().copied()).current_dir(root).status();
    match status {
        Ok(status) if status.success() => Ok(()),
        Ok(_) => Err(StepFailed::Failed { name: name.to_owned(), command_line }),
        Err(source) => Err(StepFailed::NotStarted { name: name.to_owned(), command_line, source }),
    }
}

/// Whether `cargo NAME` is there.
pub(crate) fn has_cargo_command(name: &str) -> bool {
    succeeds("cargo", &[name, "--version"])
}

/// Whether a command runs and succeeds; its output is not shown.
pub(crate) fn succeeds(program: &str, arguments: &[&str]) -> bool {
    Command::new(program).args(arguments).output().is_ok_and(|output| output.status.success())
}
