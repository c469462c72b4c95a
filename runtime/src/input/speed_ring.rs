//! How far the wheels say that the vehicle went between two times.

use kilogs_camera::ipc::Speed;
use kilogs_core::conventions::TimestampNs;

/// Readings further apart than this say nothing of the time between them.
pub const MAX_GAP_NS: u64 = 500_000_000;

const S_PER_NS: f64 = 1e-9;

/// A way with its uncertainty.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Distance {
    /// Way of the vehicle, m; negative in reverse gear.
    pub metres: f64,
    /// Standard deviation, m: errors of neighbouring readings are taken as common ones, for a tyre's radius is.
    pub sigma_m: f64,
}

/// The newest readings in the order of time, in memory taken at the start; the oldest is overwritten.
#[derive(Clone, Debug)]
pub struct SpeedRing {
    readings: Vec<Speed>,
    capacity: usize,
    /// Where the oldest reading lies, once all places are taken.
    oldest: usize,
    n_unusable: u64,
}

impl SpeedRing {
    /// A ring that holds `capacity` readings.
    pub fn new(capacity: usize) -> Self {
        Self { readings: Vec::with_capacity(capacity), capacity, oldest: 0, n_unusable: 0 }
    }

    /// Takes a reading in. One that is no number, or not newer than the last, is left out and counted.
    pub fn push(&mut self, reading: Speed) {
        let is_newer = self.newest().is_none_or(|newest| reading.timestamp_ns > newest.timestamp_ns);
        let is_number = reading.metres_per_second.is_finite()
            && reading.standard_deviation.is_finite()
            && reading.standard_deviation >= 0.0;
        if !(is_newer && is_number) || self.capacity == 0 {
            self.n_unusable += 1;
        } else if self.readings.len() < self.capacity {
            self.readings.push(reading);
        } else {
            self.readings[self.oldest] = reading;
            self.oldest = (self.oldest + 1) % self.capacity;
        }
    }

    /// Forgets everything: another clock begins.
    pub fn clear(&mut self) {
        self.readings.clear();
        self.oldest = 0;
    }

    /// Readings held.
    pub fn len(&self) -> usize {
        self.readings.len()
    }

    /// Whether there is no reading.
    pub fn is_empty(&self) -> bool {
        self.readings.is_empty()
    }

    /// Readings that were left out.
    pub fn n_unusable(&self) -> u64 {
        self.n_unusable
    }

    /// The last reading.
    pub fn newest(&self) -> Option<Speed> {
        self.at(self.len().checked_sub(1)?)
    }

    /// The way between two times: trapezoids between readings, and the nearest reading where there is none on one side.
    /// `None` where a time in between has no reading within [`MAX_GAP_NS`], or time does not go on. Takes no memory.
    pub fn between(&self, from_ns: TimestampNs, to_ns: TimestampNs) -> Option<Distance> {
        if from_ns >= to_ns {
            return None;
        }
        let first = (0..self.len()).take_while(|&i| self.is_not_after(i, from_ns)).last().unwrap_or(0);
        let mut distance = Distance { metres: 0.0, sigma_m: 0.0 };
        let mut here = self.at(first)?;
        if here.timestamp_ns > from_ns {
            let border = Speed { timestamp_ns: from_ns, ..here };
            distance.add(border, here, [from_ns, to_ns])?;
        }
        for i in first + 1..self.len() {
            if here.timestamp_ns >= to_ns {
                return Some(distance);
            }
            let next = self.at(i)?;
            distance.add(here, next, [from_ns, to_ns])?;
            here = next;
        }
        if here.timestamp_ns < to_ns {
            let border = Speed { timestamp_ns: to_ns, ..here };
            distance.add(here, border, [from_ns, to_ns])?;
        }
        Some(distance)
    }

    /// Reading `i` from the oldest.
    fn at(&self, i: usize) -> Option<Speed> {
        self.readings.get((self.oldest + i) % self.len().max(1)).copied()
    }

    fn is_not_after(&self, i: usize, time_ns: TimestampNs) -> bool {
        self.at(i).is_some_and(|reading| reading.timestamp_ns <= time_ns)
    }
}

impl Distance {
    /// Adds the part of the way between two readings that lies within a span; `None` where they are too far apart.
    fn add(&mut self, a: Speed, b: Speed, [from_ns, to_ns]: [TimestampNs; 2]) -> Option<()> {
        let gap_ns = b.timestamp_ns - a.timestamp_ns;
        if gap_ns > MAX_GAP_NS {
            return None;
        }
        let (start_ns, end_ns) = (a.timestamp_ns.max(from_ns), b.timestamp_ns.min(to_ns));
        if start_ns >= end_ns {
            return Some(());
        }
        let share = |time_ns: u64| (time_ns - a.timestamp_ns) as f64 / gap_ns as f64;
        // The value in the middle of the part is the mean over it.
        let middle = 0.5 * (share(start_ns) + share(end_ns));
        let mean = |of: fn(&Speed) -> f64| of(&a) + (of(&b) - of(&a)) * middle;
        let duration_s = (end_ns - start_ns) as f64 * S_PER_NS;
        self.metres += duration_s * mean(|reading| reading.metres_per_second);
        self.sigma_m += duration_s * mean(|reading| reading.standard_deviation);
        Some(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    /// Readings of (ms, m/s), each with 0.1 m/s, in a ring of 4.
    fn ring(readings: &[(u64, f64)]) -> SpeedRing {
        let mut ring = SpeedRing::new(4);
        for &(ms, metres_per_second) in readings {
            ring.push(Speed { timestamp_ns: ms * MS, metres_per_second, standard_deviation: 0.1 });
        }
        ring
    }

    #[test]
    fn the_way_is_the_area_under_the_readings() {
        let check = |readings: &[(u64, f64)], from_ms: u64, to_ms: u64, expected_m: Option<f64>| {
            let found = ring(readings).between(from_ms * MS, to_ms * MS);
            let is_near = match (found, expected_m) {
                (Some(found), Some(expected_m)) => {
                    let sigma_m = 1e-4 * (to_ms - from_ms) as f64;
                    (found.metres - expected_m).abs() < 1e-9 && (found.sigma_m - sigma_m).abs() < 1e-9
                }
                (found, expected) => found.is_none() && expected.is_none(),
            };
            assert!(is_near, "{readings:?} {from_ms}..{to_ms}: {found:?} instead of {expected_m:?}");
        };
        let even = [(0, 10.0), (100, 10.0), (200, 10.0)];
        check(&even, 0, 200, Some(2.0));
        check(&even, 50, 130, Some(0.8));
        check(&even, 50, 60, Some(0.1));
        check(&[(0, 0.0), (400, 8.0)], 0, 400, Some(1.6));
        check(&[(0, 0.0), (400, 8.0)], 200, 400, Some(1.2));
        check(&[(0, -4.0), (400, -4.0)], 100, 200, Some(-0.4));
        // Beyond the first and the last reading, as far as a gap may reach.
        check(&even, 200, 700, Some(5.0));
        check(&even, 200, 701, None);
        check(&[(500, 2.0), (600, 2.0)], 0, 600, Some(1.2));
        check(&[(501, 2.0), (600, 2.0)], 0, 600, None);
        // A gap within, and one that is over before.
        check(&[(0, 2.0), (501, 2.0), (600, 2.0)], 0, 600, None);
        check(&[(0, 2.0), (501, 2.0), (600, 2.0)], 501, 600, Some(0.198));
        check(&even, 100, 100, None);
        check(&even, 100, 50, None);
        check(&[], 0, 100, None);
        // The oldest of five is overwritten.
        check(&[(0, 9.0), (100, 1.0), (200, 1.0), (300, 1.0), (400, 1.0)], 100, 400, Some(0.3));
        check(&[(0, 9.0), (600, 1.0), (700, 1.0), (800, 1.0), (900, 1.0)], 0, 900, None);
    }

    #[test]
    fn what_is_no_reading_is_left_out_and_counted() {
        let mut ring = ring(&[(100, 1.0), (100, 5.0), (50, 5.0), (200, f64::NAN), (200, f64::INFINITY), (200, 1.0)]);
        assert_eq!((ring.len(), ring.n_unusable()), (2, 4));
        assert_eq!(ring.newest().map(|reading| reading.timestamp_ns), Some(200 * MS));
        ring.clear();
        assert!(ring.is_empty() && ring.between(0, 100).is_none());
        ring.push(Speed { timestamp_ns: 1, metres_per_second: 1.0, standard_deviation: 0.1 });
        assert_eq!(ring.len(), 1, "another clock may begin earlier");
    }
}
