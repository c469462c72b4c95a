//! `kilogs doctor`: is this machine ready, and if not, what to do.

mod checks;

use crate::budget::{Budget, Plan, PlanCameraArgs};
use crate::compute::BackendChoice;
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
    findings.extend(examine_plan(args, settings));
    findings.extend(checks::vulkan());
    findings.extend(checks::models(settings));
    findings
}

/// Looks at the budget and at what it asks of the machine; of one that cannot be used, at what the built-in one asks, and without
/// the device that cannot be used.
fn examine_plan(args: &DoctorArgs, settings: &Settings) -> Vec<Finding> {
    let mut findings = Vec::new();
    let mut cannot_be_used =
        |subject, error: String| findings.push(Finding::mend(subject, "cannot be used".to_owned(), error));
    let budget = Budget::load(args.budget.as_deref()).map_err(|error| cannot_be_used("budget", error.to_string())).ok();
    let input = args.camera.plan_input(settings).or_else(|error| {
        cannot_be_used("device", error.to_string());
        PlanCameraArgs { backend: BackendChoice::Cpu, device: None, ..args.camera }.plan_input(settings)
    });
    let is_usable = budget.is_some();
    let (Some(budget), Ok(input)) = (budget.or_else(|| Budget::builtin().ok()), input) else { return findings };
    let plan = Plan::compute(&budget, &input);
    findings.push(checks::shared_memory(plan.ipc_bytes()));
    if is_usable {
        findings.push(checks::budget(&plan, budget.file()));
    }
    findings.push(checks::machine_memory(plan.host_bytes()));
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
    fn what_cannot_be_used_hides_nothing_else() {
        let subjects = |args: &DoctorArgs| -> Vec<_> {
            examine(args, &Settings::measured()).into_iter().map(|finding| finding.subject).collect()
        };
        let good = args(Some("tiny.toml"), (64, 48));
        let mut no_device = args(Some("tiny.toml"), (64, 48));
        (no_device.camera.backend, no_device.camera.device) = (BackendChoice::Vulkan, Some(99));
        for bad in [args(Some("/nowhere/budget.toml"), (64, 48)), no_device] {
            let found = subjects(&bad);
            assert!(subjects(&good).iter().all(|subject| found.contains(subject)), "{found:?}");
        }
    }

    #[test]
    fn every_line_starts_with_its_verdict() {
        let fine = Finding::fine("cores", "2".to_owned());
        let bad = Finding::mend("cores", "0".to_owned(), "buy one".to_owned());
        assert_eq!(fine.to_string(), "ok    cores          2");
        assert_eq!(bad.to_string(), "MEND  cores          0: buy one");
    }
}
