//! What the wheels of the simulated vehicle say.

use super::path::Drive;
use crate::ipc::Speed;
use kilogs_core::math::Rng;

/// A sensor without noise still counts teeth, m/s.
const SMALLEST_SIGMA_M_PER_S: f64 = 0.01;

/// A reading at the time of every frame.
pub struct TrueSpeed {
    /// Where the vehicle goes.
    pub drive: Drive,
    /// Frames per second.
    pub fps: f64,
    /// Standard deviation of the readings, m/s.
    pub sigma_m_per_s: f64,
    /// Seed of the noise.
    pub seed: u64,
    /// Frame of the next reading.
    pub frame: usize,
}

impl Iterator for TrueSpeed {
    type Item = Speed;

    fn next(&mut self) -> Option<Speed> {
        let frame = self.frame;
        if frame >= self.drive.n_frames() {
            return None;
        }
        self.frame += 1;
        // Central differences; half as wide at either end of the drive.
        let (before, behind) = (frame.saturating_sub(1), (frame + 1).min(self.drive.n_frames() - 1));
        let duration_s = (behind - before).max(1) as f64 / self.fps;
        let true_m_per_s = (self.drive.arc_m(behind) - self.drive.arc_m(before)) / duration_s;
        let mut rng = Rng::new(self.seed, frame as u64, u64::from(b'w'));
        // Twelve uniform draws have a variance of 1.
        let unit_noise: f64 = (0..12).map(|_| rng.unit_f64()).sum::<f64>() - 6.0;
        Some(Speed {
            timestamp_ns: (frame as f64 / self.fps * 1e9).round() as u64,
            metres_per_second: true_m_per_s + self.sigma_m_per_s * unit_noise,
            standard_deviation: self.sigma_m_per_s.max(SMALLEST_SIGMA_M_PER_S),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::drive_kind::DriveKind;
    use super::*;

    #[test]
    fn readings_add_up_to_the_way_and_scatter_as_they_say() {
        let drive = Drive::generate(DriveKind::StandingThenGo, 1, 200.0, 10.0);
        let readings = |sigma_m_per_s| {
            TrueSpeed { drive: drive.clone(), fps: 10.0, sigma_m_per_s, seed: 4, frame: 0 }
                .map(|reading| reading.metres_per_second)
                .collect::<Vec<f64>>()
        };
        let exact = readings(0.0);
        let way_m: f64 = exact.windows(2).map(|pair| 0.05 * (pair[0] + pair[1])).sum();
        let driven_m = drive.arc_m(drive.n_frames() - 1);
        assert!((way_m - driven_m).abs() < 0.3, "{way_m} m of {driven_m} m");
        assert_eq!(exact[10], 0.0, "it stands");
        let squares = exact.iter().zip(readings(0.3)).map(|(a, b)| (a - b) * (a - b));
        let sigma = (squares.sum::<f64>() / exact.len() as f64).sqrt();
        assert!((0.25..0.35).contains(&sigma), "{sigma} m/s");
    }
}
