//! A scene point, remembered as an inverse depth along the ray of the keyframe that saw it first.

use nalgebra::{Vector2, Vector3};

/// Keyframes in the window, and sightings that a landmark can hold.
pub const WINDOW: usize = 8;

/// Place of a keyframe in the ring, below [`WINDOW`].
pub type Column = usize;

/// A scene point and where the keyframes of the window saw it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Landmark {
    /// One over the depth along the host's optical axis, 1/m; meaningful when `sigma` is above 0.
    pub inverse_depth: f64,
    /// Standard deviation of the inverse depth, 1/m; 0 when there is no depth yet.
    pub sigma: f64,
    /// Inverse depth before the step that an adjustment is trying.
    pub(crate) kept_inverse_depth: f64,
    seen_z1: [[f32; 2]; WINDOW],
    seen: u8,
    host: u8,
    /// Whether it was found to move or to contradict the others.
    pub is_outlier: bool,
    /// Whether its track is still alive.
    pub is_tracked: bool,
    /// The track that found it.
    pub track_id: u64,
}

const _: () = assert!(WINDOW <= u8::BITS as usize);

impl Default for Landmark {
    fn default() -> Self {
        Self::NONE
    }
}

impl Landmark {
    /// Fills storage that is still to be written.
    pub const NONE: Self = Self {
        inverse_depth: 0.0,
        sigma: 0.0,
        kept_inverse_depth: 0.0,
        seen_z1: [[0.0; 2]; WINDOW],
        seen: 0,
        host: 0,
        is_outlier: false,
        is_tracked: false,
        track_id: 0,
    };

    /// Forgets everything; the slot is free.
    pub fn clear(&mut self) {
        *self = Self::NONE;
    }

    /// Whether any keyframe of the window saw it.
    pub fn is_used(&self) -> bool {
        self.seen != 0
    }

    /// Whether its depth has been estimated.
    pub fn has_depth(&self) -> bool {
        self.sigma > 0.0
    }

    /// Number of keyframes of the window that saw it.
    pub fn n_sightings(&self) -> u32 {
        self.seen.count_ones()
    }

    /// The keyframe whose ray carries the inverse depth.
    pub fn host(&self) -> Column {
        usize::from(self.host)
    }

    /// Where the keyframe in that column saw it, on the plane z = 1.
    pub fn seen_by(&self, column: Column) -> Option<Vector2<f64>> {
        let is_seen = self.seen.checked_shr(column as u32).unwrap_or(0) & 1 == 1;
        let [x, y] = self.seen_z1.get(column).copied().filter(|_| is_seen)?;
        Some(Vector2::new(f64::from(x), f64::from(y)))
    }

    /// Ray of the host, with z = 1.
    pub fn host_ray(&self) -> Vector3<f64> {
        let [x, y] = self.seen_z1.get(self.host()).copied().unwrap_or_default();
        Vector3::new(f64::from(x), f64::from(y), 1.0)
    }

    /// Records a sighting; the first one makes its keyframe the host.
    pub fn record(&mut self, column: Column, seen_z1: &Vector2<f64>) {
        let Some(slot) = self.seen_z1.get_mut(column) else { return };
        *slot = [seen_z1.x as f32, seen_z1.y as f32];
        if self.seen == 0 {
            self.host = column as u8;
        }
        self.seen |= 1 << column;
    }

    /// Forgets the sighting of a column whose keyframe leaves the window.
    ///
    /// When that was the host, another column takes over: `rehost` gives it and the new inverse depth.
    pub fn forget(&mut self, column: Column, rehost: impl FnOnce(&Self) -> Option<(Column, f64, f64)>) {
        if self.seen_by(column).is_none() {
            return;
        }
        let next =
            if self.host() == column { rehost(self) } else { Some((self.host(), self.inverse_depth, self.sigma)) };
        self.seen &= !(1 << column);
        match next {
            Some((host, inverse_depth, sigma)) if self.seen_by(host).is_some() => {
                (self.host, self.inverse_depth, self.sigma) = (host as u8, inverse_depth, sigma);
            }
            _ => self.clear(),
        }
    }

    /// Columns that saw it, ascending.
    pub fn columns(&self) -> impl Iterator<Item = Column> + use<> {
        let seen = self.seen;
        (0..WINDOW).filter(move |&c| seen >> c & 1 == 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_sighting_hosts_and_its_departure_hands_over() {
        let mut landmark = Landmark::default();
        assert!(!landmark.is_used());
        landmark.record(3, &Vector2::new(0.5, 0.25));
        landmark.record(4, &Vector2::new(0.75, 0.5));
        (landmark.inverse_depth, landmark.sigma) = (0.1, 0.01);
        assert_eq!((landmark.host(), landmark.n_sightings()), (3, 2));
        landmark.forget(3, |_| Some((4, 0.125, 0.02)));
        assert_eq!((landmark.host(), landmark.inverse_depth, landmark.sigma), (4, 0.125, 0.02));
        assert_eq!(landmark.host_ray(), Vector3::new(0.75, 0.5, 1.0));
        landmark.forget(4, |_| None);
        assert_eq!(landmark, Landmark::default());
    }

    #[test]
    fn columns_outside_the_window_are_ignored() {
        let mut landmark = Landmark::default();
        landmark.record(WINDOW, &Vector2::zeros());
        assert!(!landmark.is_used());
        assert_eq!(landmark.seen_by(WINDOW), None);
        assert_eq!(landmark.seen_by(usize::MAX), None);
    }
}
