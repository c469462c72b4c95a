//! Time and memory over the drive, in a number of buckets that does not depend on its length.

use super::{N_STAGES, STAGES, StageTimes};

/// Buckets of the chart.
const N_BUCKETS: usize = 256;

/// What happened during one stretch of frames.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DriveBucket {
    /// Frames in the bucket.
    pub n_frames: u64,
    /// Milliseconds per stage, summed over the frames.
    pub stage_sum_ms: [f64; N_STAGES],
    /// The most that this process had resident, bytes.
    pub rss_bytes: u64,
}

impl DriveBucket {
    fn merged(&self, later: &Self) -> Self {
        Self {
            n_frames: self.n_frames + later.n_frames,
            stage_sum_ms: std::array::from_fn(|k| self.stage_sum_ms[k] + later.stage_sum_ms[k]),
            rss_bytes: self.rss_bytes.max(later.rss_bytes),
        }
    }
}

/// Collects buckets of equal numbers of frames; when all are full, neighbours are merged and each takes twice as
/// many from then on.
#[derive(Clone, Debug)]
pub struct DriveChart {
    buckets: Box<[DriveBucket; N_BUCKETS]>,
    n_used: usize,
    frames_per_bucket: u64,
}

impl Default for DriveChart {
    fn default() -> Self {
        Self { buckets: Box::new([DriveBucket::default(); N_BUCKETS]), n_used: 0, frames_per_bucket: 1 }
    }
}

impl DriveChart {
    /// Adds a frame. Takes no memory.
    pub fn push(&mut self, times: &StageTimes, rss_bytes: u64) {
        let frame =
            DriveBucket { n_frames: 1, stage_sum_ms: STAGES.map(|(stage, _)| f64::from(times.ms(stage))), rss_bytes };
        let has_room = self.buckets().last().is_some_and(|last| last.n_frames < self.frames_per_bucket);
        if !has_room {
            if self.n_used == N_BUCKETS {
                self.halve();
            }
            self.n_used += 1;
        }
        let last = &mut self.buckets[self.n_used - 1];
        *last = last.merged(&frame);
    }

    /// The buckets so far, in the order of the drive; only the last may be incomplete.
    pub fn buckets(&self) -> &[DriveBucket] {
        &self.buckets[..self.n_used]
    }

    fn halve(&mut self) {
        for k in 0..N_BUCKETS / 2 {
            self.buckets[k] = self.buckets[2 * k].merged(&self.buckets[2 * k + 1]);
        }
        self.buckets[N_BUCKETS / 2..].fill(DriveBucket::default());
        self.n_used = N_BUCKETS / 2;
        self.frames_per_bucket *= 2;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::Stage;

    fn chart_of(n_frames: u64) -> DriveChart {
        let mut chart = DriveChart::default();
        for k in 0..n_frames {
            let mut times = StageTimes::default();
            times.add(Stage::Tracking, k as f32);
            chart.push(&times, 1000 + k);
        }
        chart
    }

    #[test]
    fn no_frame_is_lost_and_the_number_of_buckets_is_bounded() {
        for (n_frames, n_buckets, per_bucket) in [(0, 0, 0), (1, 1, 1), (256, 256, 1), (257, 129, 2), (5000, 157, 32)] {
            let chart = chart_of(n_frames);
            let buckets = chart.buckets();
            assert_eq!(buckets.len(), n_buckets, "{n_frames} frames");
            assert_eq!(buckets.iter().map(|b| b.n_frames).sum::<u64>(), n_frames);
            assert_eq!(buckets.first().map_or(0, |b| b.n_frames), per_bucket);
            let sum_ms: f64 = buckets.iter().map(|b| b.stage_sum_ms[Stage::Tracking as usize]).sum();
            assert_eq!(sum_ms, (n_frames * n_frames.saturating_sub(1) / 2) as f64);
            assert_eq!(buckets.last().map(|b| b.rss_bytes), n_frames.checked_sub(1).map(|k| 1000 + k));
        }
    }

    #[test]
    fn buckets_stay_in_order() {
        let chart = chart_of(1000);
        let means: Vec<f64> = chart
            .buckets()
            .iter()
            .map(|bucket| bucket.stage_sum_ms[Stage::Tracking as usize] / bucket.n_frames as f64)
            .collect();
        assert_eq!(means[..3], [1.5, 5.5, 9.5]);
        assert!(means.is_sorted());
    }
}
