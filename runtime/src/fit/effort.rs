//! How long to train.

use std::time::{Duration, Instant};

/// How long to train.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effort {
    /// So many steps: the same input gives the same bytes.
    Iterations(u64),
    /// So long, insertion included, and no more than so many steps.
    Time(Duration, u64),
}

impl Effort {
    /// What a command line asks for: whichever of both is reached first, or `default_steps`.
    pub fn of(iterations: Option<u64>, minutes: Option<f64>, default_steps: u64) -> Self {
        match minutes {
            Some(minutes) => Self::Time(Duration::from_secs_f64(60.0 * minutes), iterations.unwrap_or(u64::MAX)),
            None => Self::Iterations(iterations.unwrap_or(default_steps)),
        }
    }
}

/// How far the training is.
#[derive(Debug)]
pub(crate) struct Clock {
    effort: Effort,
    started: Instant,
}

impl Clock {
    /// Starts now.
    pub(crate) fn start(effort: Effort) -> Self {
        Self { effort, started: Instant::now() }
    }

    /// Share of the effort that is spent after `n_steps`, from 0; above 1 it is overspent.
    pub(crate) fn progress(&self, n_steps: u64) -> f64 {
        let of_steps = |all: u64| n_steps as f64 / all.max(1) as f64;
        match self.effort {
            Effort::Iterations(all) => of_steps(all),
            Effort::Time(all, steps) => {
                (self.started.elapsed().as_secs_f64() / all.as_secs_f64().max(1e-3)).max(of_steps(steps))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_minutes_and_steps_the_first_reached_ends() {
        assert_eq!(Effort::of(None, None, 7), Effort::Iterations(7));
        assert_eq!(Effort::of(Some(3), None, 7), Effort::Iterations(3));
        let progress = |effort, n_steps| Clock::start(effort).progress(n_steps);
        assert!(progress(Effort::of(Some(4), Some(60.0), 7), 2) >= 0.5);
        assert!(progress(Effort::of(None, Some(60.0), 7), 1 << 40) < 0.5);
    }
}
