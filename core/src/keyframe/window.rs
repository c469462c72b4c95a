//! The ring of the last keyframes.

use super::{Column, Landmark, WINDOW};
use crate::conventions::{Rigid, TimestampNs};
use nalgebra::{Point3, Vector2, Vector3};

/// Keyframes nearer to each other than this tell no depth, m. Ours: poses are off by centimetres among themselves, and while
/// a vehicle turns on the spot that error would pass for a baseline, its landmarks for a street of centimetres; on a drive
/// the gate's flow takes a few of these, 12 px at 10 m are 0.17 m.
pub const SHORTEST_BASELINE_M: f64 = 0.1;

/// A frame that the window remembers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Keyframe {
    /// Counts keyframes from 0.
    pub ordinal: u32,
    /// Index in the stream.
    pub frame_index: u64,
    /// Middle of the exposure.
    pub timestamp_ns: TimestampNs,
    /// Pose in the odometry world.
    pub camera_from_world: Rigid,
}

/// The last [`WINDOW`] keyframes; a new one overwrites the oldest.
///
/// A keyframe's column is its ordinal modulo the window, so that a landmark's sightings never move.
#[derive(Clone, Debug)]
pub struct KeyframeWindow {
    keyframes: [Option<Keyframe>; WINDOW],
    n_pushed: u32,
}

impl Default for KeyframeWindow {
    fn default() -> Self {
        Self::new()
    }
}

impl KeyframeWindow {
    /// An empty window.
    pub fn new() -> Self {
        Self { keyframes: [None; WINDOW], n_pushed: 0 }
    }

    /// Column of an ordinal.
    pub fn column_of(ordinal: u32) -> Column {
        ordinal as usize % WINDOW
    }

    /// Ordinal that the next keyframe will have.
    pub fn next_ordinal(&self) -> u32 {
        self.n_pushed
    }

    /// Number of keyframes in the window.
    pub fn len(&self) -> usize {
        self.keyframes.iter().flatten().count()
    }

    /// Whether there is no keyframe yet.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The newest keyframe.
    pub fn newest(&self) -> Option<&Keyframe> {
        self.at(Self::column_of(self.n_pushed.checked_sub(1)?))
    }

    /// The keyframe in a column.
    pub fn at(&self, column: Column) -> Option<&Keyframe> {
        self.keyframes.get(column)?.as_ref()
    }

    /// The keyframe in a column, to be moved.
    pub fn at_mut(&mut self, column: Column) -> Option<&mut Keyframe> {
        self.keyframes.get_mut(column)?.as_mut()
    }

    /// Columns from the oldest keyframe to the newest.
    pub fn columns_by_age(&self) -> impl Iterator<Item = Column> + use<> {
        let first = self.n_pushed - self.len() as u32;
        (first..self.n_pushed).map(Self::column_of)
    }

    /// Adds a keyframe and returns its column. In a full window the oldest leaves: landmarks that it hosted are
    /// handed to their next sighting, those that only it saw are freed.
    pub fn push(
        &mut self,
        frame_index: u64,
        timestamp_ns: TimestampNs,
        camera_from_world: Rigid,
        landmarks: &mut [Landmark],
    ) -> Column {
        let ordinal = self.n_pushed;
        let column = Self::column_of(ordinal);
        if let Some(leaving) = self.at(column).copied() {
            for landmark in landmarks.iter_mut() {
                landmark.forget(column, |l| self.rehost(l, &leaving));
            }
        }
        if let Some(slot) = self.keyframes.get_mut(column) {
            *slot = Some(Keyframe { ordinal, frame_index, timestamp_ns, camera_from_world });
        }
        self.n_pushed += 1;
        column
    }

    /// Empties the window but goes on counting ordinals.
    pub fn clear(&mut self, landmarks: &mut [Landmark]) {
        self.keyframes = [None; WINDOW];
        landmarks.iter_mut().for_each(Landmark::clear);
    }

    /// Multiplies the window's lengths by `factor`; the keyframe in `center` stays where it is.
    pub fn rescale(&mut self, factor: f64, center: Column, landmarks: &mut [Landmark]) {
        let Some(center) = self.at(center).map(|k| k.camera_from_world.inverse().translation.vector) else { return };
        for keyframe in self.keyframes.iter_mut().flatten() {
            let world_from_camera = keyframe.camera_from_world.inverse();
            let moved = center + (world_from_camera.translation.vector - center) * factor;
            keyframe.camera_from_world = Rigid::from_parts(moved.into(), world_from_camera.rotation).inverse();
        }
        for landmark in landmarks.iter_mut().filter(|l| l.has_depth()) {
            landmark.inverse_depth /= factor;
            landmark.sigma /= factor;
        }
    }

    /// A landmark as another camera sees it; `None` behind it or without depth.
    pub fn landmark_in(&self, landmark: &Landmark, camera_from_world: &Rigid) -> Option<LandmarkView> {
        let host = self.at(landmark.host())?;
        let camera_from_host = camera_from_world * host.camera_from_world.inverse();
        in_camera(landmark, &camera_from_host)
    }

    /// The oldest remaining keyframe that saw the landmark, with its inverse depth and that one's sigma there.
    fn rehost(&self, landmark: &Landmark, leaving: &Keyframe) -> Option<(Column, f64, f64)> {
        let next = self.columns_by_age().find(|&c| c != landmark.host() && landmark.seen_by(c).is_some())?;
        if !landmark.has_depth() {
            return Some((next, 0.0, 0.0));
        }
        let next_from_host = self.at(next)?.camera_from_world * leaving.camera_from_world.inverse();
        let LandmarkView { inverse_depth, sigma, .. } = in_camera(landmark, &next_from_host)?;
        Some((next, inverse_depth, sigma))
    }
}

/// A landmark in another camera than its host.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LandmarkView {
    /// Where it is seen, on the plane z = 1.
    pub z1: Vector2<f64>,
    /// Its inverse depth there, 1/m.
    pub inverse_depth: f64,
    /// Standard deviation of that inverse depth, 1/m.
    pub sigma: f64,
}

fn in_camera(landmark: &Landmark, camera_from_host: &Rigid) -> Option<LandmarkView> {
    let ray: Vector3<f64> = landmark.host_ray();
    let q =
        camera_from_host.rotation * Point3::from(ray) + camera_from_host.translation.vector * landmark.inverse_depth;
    // q.z = z'/z, and d(1/z')/d(1/z) = (z/z')^2 for motion along the axis, the usual case.
    (landmark.has_depth() && q.z > 0.0).then(|| LandmarkView {
        z1: q.coords.xy() / q.z,
        inverse_depth: landmark.inverse_depth / q.z,
        sigma: landmark.sigma / (q.z * q.z),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at_z(z: f64) -> Rigid {
        Rigid::translation(0.0, 0.0, -z)
    }

    #[test]
    fn a_full_window_overwrites_the_oldest_and_rehosts_its_landmarks() {
        let mut window = KeyframeWindow::new();
        let mut landmarks = [Landmark::default(); 2];
        let point = Vector3::new(2.0, 1.0, 20.0);
        for i in 0..WINDOW as u32 + 1 {
            let column = window.push(u64::from(i), 0, at_z(f64::from(i)), &mut landmarks);
            assert_eq!(column, i as usize % WINDOW);
            let seen = point - Vector3::z() * f64::from(i);
            landmarks[0].record(column, &(seen / seen.z).xy());
            if i == 0 {
                (landmarks[0].inverse_depth, landmarks[0].sigma) = (0.05, 0.001);
                landmarks[1].record(0, &Vector2::zeros());
            }
        }
        assert_eq!((window.len(), window.next_ordinal()), (WINDOW, WINDOW as u32 + 1));
        assert_eq!(landmarks[0].host(), 1);
        assert!((landmarks[0].inverse_depth - 1.0 / 19.0).abs() < 1e-9);
        assert!(!landmarks[1].is_used(), "only the oldest keyframe saw it");
        assert_eq!(window.columns_by_age().collect::<std::vec::Vec<_>>(), [1, 2, 3, 4, 5, 6, 7, 0]);
    }

    #[test]
    fn rescaling_keeps_what_the_center_sees() {
        let mut window = KeyframeWindow::new();
        let mut landmarks = [Landmark::default()];
        window.push(0, 0, at_z(5.0), &mut landmarks);
        landmarks[0].record(0, &Vector2::new(0.1, 0.2));
        (landmarks[0].inverse_depth, landmarks[0].sigma) = (0.1, 0.001);
        window.push(1, 1, at_z(7.0), &mut landmarks);
        let newest = window.newest().expect("two").camera_from_world;
        let before = window.landmark_in(&landmarks[0], &newest).expect("in front");
        window.rescale(2.0, 1, &mut landmarks);
        let after = window.landmark_in(&landmarks[0], &newest).expect("in front");
        assert!((before.z1 - after.z1).norm() < 1e-12);
        assert!((before.inverse_depth - 2.0 * after.inverse_depth).abs() < 1e-12);
        assert!((before.sigma - 2.0 * after.sigma).abs() < 1e-12);
        assert_eq!(window.newest().expect("two").camera_from_world, newest);
    }

    #[test]
    fn the_sigma_is_that_of_the_inverse_depth_in_the_other_camera() {
        const TINY: f64 = 1e-7;
        let mut window = KeyframeWindow::new();
        let mut landmarks = [Landmark::default()];
        window.push(0, 0, at_z(0.0), &mut landmarks);
        landmarks[0].record(0, &Vector2::new(0.1, 0.2));
        for (inverse_depth, moved_m) in [(0.05, 0.0), (0.05, 10.0), (0.05, -20.0), (-0.001, 10.0)] {
            let view = |inverse_depth: f64| {
                let mut landmark = landmarks[0];
                (landmark.inverse_depth, landmark.sigma) = (inverse_depth, 0.002);
                window.landmark_in(&landmark, &at_z(moved_m)).expect("in front")
            };
            let slope = (view(inverse_depth + TINY).inverse_depth - view(inverse_depth).inverse_depth) / TINY;
            let sigma = view(inverse_depth).sigma;
            assert!((sigma / (0.002 * slope) - 1.0).abs() < 1e-4, "{inverse_depth} after {moved_m} m: {sigma}");
        }
    }
}
