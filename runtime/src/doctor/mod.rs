//! `kilogs doctor`: is this machine ready, and if not, what to do.

mod checks;

use crate::budget::{Budget, Plan, PlanCameraArgs};
use crate::run_error::RunError;
use crate::settings::Settings;
use std::fmt;
use std::path::PathBuf;

/// Options of `kilogs doctor`.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = "Example:\n  kilogs doctor --size 1920x1080 --budget 1080p-2gib.toml")]
pub struct DoctorArgs {
    /// Budget file, or the name of a built-in profile.
    #[arg(long, value_name = "FILE")]
    pub budget: Option<PathBuf>,
    /// What the camera delivers.
    #[command(flatten)]
    pub camera: PlanCameraArgs,
}

/// One thing that was looked at.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    /// What was looked at.
    pub subject: &'static str,
    /// What was found.
    pub found: String,
    /// What to do about it; nothing when it is fine.
    pub advice: Option<String>,
}

impl Finding {
    fn fine(subject: &'static str, found: String) -> Self {
        Self { subject, found, advice: None }
    }

    fn mend(subject: &'static str, found: String, advice: String) -> Self {
        Self { subject, found, advice: Some(advice) }
    }
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.advice {
            None => write!(f, "ok    {:<14} {}", self.subject, self.found),
            Some(advice) => write!(f, "MEND  {:<14} {}: {advice}", self.subject, self.found),
        }
    }
}

/// Something has to be mended before a run can succeed. Exit code 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("examining this machine: {n_problems} of {n_checks} checks failed; each MEND line says what to do")]
pub struct NotReady {
    /// Checks that failed.
    pub n_problems: usize,
    /// Checks that were made.
    pub n_checks: usize,
}

/// Looks at everything a run needs.
pub fn examine(args: &DoctorArgs, settings: &Settings) -> Vec<Finding> {
    let mut findings = vec![checks::cores(), checks::simd()];
    match Budget::load(args.budget.as_deref()) {
        Ok(budget) => match args.camera.plan_input(settings) {
            Ok(input) => {
                let plan = Plan::compute(&budget, &input);
                findings.push(checks::shared_memory(plan.ipc_bytes()));
                findings.push(checks::budget(&plan, budget.file()));
                findings.push(checks::machine_memory(plan.host_bytes()));
            }
            Err(error) => findings.push(Finding::mend("device", "cannot be used".to_owned(), error.to_string())),
        },
        Err(error) => findings.push(Finding::mend("budget", "cannot be used".to_owned(), error.to_string())),
    }
    findings.extend(checks::vulkan());
    findings.extend(checks::models(settings));
    findings
}

/// Prints a line for each check.
///
/// # Errors
/// [`RunError`] of [`NotReady`] when something has to be mended, or of what standard output did not take.
pub fn run(args: &DoctorArgs, settings: &Settings) -> Result<(), RunError> {
    let findings = examine(args, settings);
    let lines: String = findings.iter().map(|finding| format!("{finding}\n")).collect();
    kilogs_eval::stdout::show(&lines).map_err(RunError::stdout)?;
    match findings.iter().filter(|finding| finding.advice.is_some()).count() {
        0 => Ok(()),
        n_problems => Err(RunError::Run(NotReady { n_problems, n_checks: findings.len() }.to_string())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::compute::BackendChoice;

    fn args(budget: Option<&str>, size: (u32, u32)) -> DoctorArgs {
        let camera = PlanCameraArgs { size, pixel_bytes: 3, backend: BackendChoice::Auto, device: None };
        DoctorArgs { budget: budget.map(PathBuf::from), camera }
    }

    fn subjects_to_mend(args: &DoctorArgs) -> Vec<&'static str> {
        examine(args, &Settings::measured()).into_iter().filter(|f| f.advice.is_some()).map(|f| f.subject).collect()
    }

    #[test]
    fn a_machine_that_builds_this_can_run_the_tiny_profile() {
        assert_eq!(subjects_to_mend(&args(Some("tiny.toml"), (64, 48))), [""; 0]);
    }

    #[test]
    fn a_budget_that_cannot_be_used_is_to_be_mended() {
        let check = |budget, size, expected: &[&str]| {
            let found = subjects_to_mend(&args(budget, size));
            assert!(expected.iter().all(|subject| found.contains(subject)), "{found:?}, expected {expected:?}");
        };
        check(Some("/nowhere/budget.toml"), (64, 48), &["budget"]);
        check(Some("tiny.toml"), (4096, 4096), &["budget"]);
    }

    #[test]
    fn every_line_starts_with_its_verdict() {
        let fine = Finding::fine("cores", "2".to_owned());
        let bad = Finding::mend("cores", "0".to_owned(), "buy one".to_owned());
        assert_eq!(fine.to_string(), "ok    cores          2");
        assert_eq!(bad.to_string(), "MEND  cores          0: buy one");
    }
}
