//! Time that this thread has computed for, so that a busy machine does not count.

use rustix::time::{ClockId, clock_gettime};

/// Times of a piece of work, ms.
pub struct Times {
    sorted_ms: Vec<f64>,
}

impl Times {
    /// Runs `work` for each of `rounds` and sorts what it took.
    pub fn of(rounds: impl IntoIterator<Item = usize>, mut work: impl FnMut(usize)) -> Self {
        let timed = |round| {
            let start = thread_ms();
            work(round);
            thread_ms() - start
        };
        let mut sorted_ms: Vec<f64> = rounds.into_iter().map(timed).collect();
        sorted_ms.sort_unstable_by(f64::total_cmp);
        Self { sorted_ms }
    }

    /// `median (fastest)`.
    pub fn text(&self) -> String {
        format!("{:.3} ({:.3})", middle(&self.sorted_ms), self.sorted_ms.first().copied().unwrap_or(f64::NAN))
    }
}

/// The middle one, NaN without any.
pub fn middle(sorted: &[f64]) -> f64 {
    sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
}

fn thread_ms() -> f64 {
    let now = clock_gettime(ClockId::ThreadCPUTime);
    now.tv_sec as f64 * 1e3 + now.tv_nsec as f64 * 1e-6
}
