//! How long to train.

use std::time::{Duration, Instant};

/// How long to train.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effort {
    /// So many steps: the same input gives the same bytes.
    Iterations(u64),
    /// So long, insertion included.
    Time(Duration),
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
        match self.effort {
            Effort::Iterations(all) => n_steps as f64 / all.max(1) as f64,
            Effort::Time(all) => self.started.elapsed().as_secs_f64() / all.as_secs_f64().max(1e-3),
        }
    }
}
