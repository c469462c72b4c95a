//! Where the time of a view went.

use std::time::Instant;

/// Most stages that a backend tells apart.
pub const MAX_STAGES: usize = 48;

/// Time of each stage of a backend's last view, in the order in which they ran.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StageTimes {
    stages: heapless::Vec<(&'static str, f64), MAX_STAGES>,
}

impl StageTimes {
    /// Adds a stage, or more time to the stage of that name; stages beyond [`MAX_STAGES`] are left out.
    pub fn add(&mut self, name: &'static str, ms: f64) {
        match self.stages.iter_mut().find(|(found, _)| *found == name) {
            Some((_, total_ms)) => *total_ms += ms,
            None => {
                let _ = self.stages.push((name, ms));
            }
        }
    }

    /// Names and milliseconds.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, f64)> + '_ {
        self.stages.iter().copied()
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        self.stages.clear();
    }
}

/// Splits time into stages that follow one another; never allocates.
#[derive(Clone, Debug)]
pub struct StageClock {
    last: Instant,
    times: StageTimes,
}

impl StageClock {
    /// A clock with nothing measured.
    pub fn new() -> Self {
        Self { last: Instant::now(), times: StageTimes::default() }
    }

    /// Begins a view.
    pub fn restart(&mut self) {
        self.times.clear();
        self.last = Instant::now();
    }

    /// What has passed since the last call was `stage`.
    pub fn finish(&mut self, stage: &'static str) {
        let now = Instant::now();
        self.times.add(stage, now.duration_since(self.last).as_secs_f64() * 1e3);
        self.last = now;
    }

    /// Stages since the last [`restart`](Self::restart).
    pub fn times(&self) -> &StageTimes {
        &self.times
    }
}

impl Default for StageClock {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stages_keep_their_order_and_add_up() {
        let mut times = StageTimes::default();
        for (name, ms) in [("cull", 1.0), ("blend", 2.0), ("cull", 0.5)] {
            times.add(name, ms);
        }
        assert!(times.iter().eq([("cull", 1.5), ("blend", 2.0)]));
    }

    #[test]
    fn a_restarted_clock_has_forgotten() {
        let mut clock = StageClock::new();
        clock.finish("sort");
        assert_eq!(clock.times().iter().count(), 1);
        assert!(clock.times().iter().all(|(_, ms)| ms >= 0.0));
        clock.restart();
        assert_eq!(clock.times().iter().count(), 0);
    }
}
