//! The scale from what is not the road: depths that somebody knows, and the wheels.

use crate::camera::Mounting;
use crate::conventions::Rigid;
use nalgebra::Vector3;

/// Who measured the scale.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScaleSource {
    /// The road under the camera, whose height is known.
    GroundPlane,
    /// A network that knows the depth of images.
    DepthNetwork,
    /// The way that the wheels rolled.
    WheelSpeed,
}

impl ScaleSource {
    /// Number of sources.
    pub const N: usize = 3;

    /// Place among the sources.
    pub(super) fn place(self) -> usize {
        self as usize
    }
}

/// Some of the sources.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ScaleSources([bool; ScaleSource::N]);

impl ScaleSources {
    /// None.
    pub const NONE: Self = Self([false; ScaleSource::N]);
    /// What needs no trained network: the road, and the wheels where they are known.
    pub const UNTRAINED: Self = Self([true, false, true]);
    /// Every one.
    pub const ALL: Self = Self([true; ScaleSource::N]);

    /// These sources.
    pub fn of(sources: &[ScaleSource]) -> Self {
        sources.iter().fold(Self::NONE, |all, &source| all.with(source))
    }

    /// These and others.
    pub fn and(self, others: Self) -> Self {
        let mut all = self;
        all.0.iter_mut().zip(others.0).for_each(|(mine, other)| *mine |= other);
        all
    }

    /// The same and one more.
    pub fn with(mut self, source: ScaleSource) -> Self {
        if let Some(slot) = self.0.get_mut(source.place()) {
            *slot = true;
        }
        self
    }

    /// Whether it is one of them.
    pub fn contains(self, source: ScaleSource) -> bool {
        self.0.get(source.place()).copied().unwrap_or(false)
    }
}

/// One measurement of the scale, whatever it comes from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScaleMeasurement {
    /// True length over length in the odometry's scale.
    pub ratio: f64,
    /// Relative standard deviation that the measurement claims for itself.
    pub relative_sigma: f64,
    /// Where it comes from.
    pub source: ScaleSource,
}

/// Most points whose depths are compared.
pub const MAX_DEPTHS: usize = 256;
/// Fewest depths that must agree (peer: more than 10).
const MIN_DEPTHS: usize = 11;
/// Depths beyond this are not compared, m (peer).
const MAX_DEPTH_M: f32 = 100.0;
/// Standard deviations beyond which a ratio disagrees.
const OUTLIER_SIGMAS: f64 = 3.0;
/// Standard deviation over median absolute deviation of Gaussian noise.
const SIGMA_PER_MAD: f64 = 1.4826;
/// Standard deviation of a median over that of the mean.
const MEDIAN_EFFICIENCY: f64 = 1.2533;

/// The scale from depths that are known in metres.
///
/// # Inputs
/// * `depths_m`: `[triangulated, known]` of the same points; what is not finite, not positive or farther than 100 m is
///   left out, and so is what is more than [`MAX_DEPTHS`].
///
/// # Output
/// The median of known over triangulated; `None` when fewer than eleven points agree within three deviations.
///
/// # Cost
/// O(n log n); 2 KiB of stack.
///
/// # Source
/// Median and median absolute deviation: Rousseeuw & Croux 1993.
pub fn depth_ratio(depths_m: impl Iterator<Item = [f32; 2]>) -> Option<ScaleMeasurement> {
    let is_usable = |depth_m: &f32| *depth_m > 0.0 && *depth_m <= MAX_DEPTH_M;
    let usable = depths_m.filter(|pair| pair.iter().all(is_usable));
    let mut logs = heapless::Vec::<f64, MAX_DEPTHS>::new();
    for [triangulated_m, known_m] in usable.take(MAX_DEPTHS) {
        let _ = logs.push(libm::log(f64::from(known_m) / f64::from(triangulated_m)));
    }
    let center = median(&mut logs)?;
    let mut deviations: heapless::Vec<f64, MAX_DEPTHS> = logs.iter().map(|log| (log - center).abs()).collect();
    let sigma = SIGMA_PER_MAD * median(&mut deviations)?;
    let n = logs.iter().filter(|&log| (log - center).abs() <= OUTLIER_SIGMAS * sigma).count();
    if n < MIN_DEPTHS {
        return None;
    }
    let relative_sigma = MEDIAN_EFFICIENCY * sigma / libm::sqrt(n as f64);
    Some(ScaleMeasurement { ratio: libm::exp(center), relative_sigma, source: ScaleSource::DepthNetwork })
}

fn median(values: &mut [f64]) -> Option<f64> {
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

/// Shortest way between two keyframes that tells a scale, m.
const MIN_WAY_M: f64 = 0.1;

/// The scale from the way of the rear axle between two keyframes.
///
/// Solves  | a + s b | = chord  for s, where the axle moves by a = (R - 1) lever because the vehicle turns and by s b
/// because the camera does; the chord belongs to the way along the arc of the turn.
///
/// # Inputs
/// * `earlier_from_later`: motion of the camera in the odometry's scale.
/// * `way_m`, `sigma_m`: way along the wheels' track with its standard deviation.
///
/// # Output
/// `None` when the vehicle moved too little, or only turned.
///
/// # Cost
/// O(1).
///
/// # Source
/// Own derivation.
pub fn wheel_ratio(
    earlier_from_later: &Rigid,
    mounting: &Mounting,
    way_m: f64,
    sigma_m: f64,
) -> Option<ScaleMeasurement> {
    let half_turn_rad = 0.5 * earlier_from_later.rotation.angle();
    let chord_per_arc = if half_turn_rad > 1e-6 { libm::sin(half_turn_rad) / half_turn_rad } else { 1.0 };
    let chord_m = way_m * chord_per_arc;
    let lever = Vector3::from(mounting.lever_arm_m);
    let swing = earlier_from_later.rotation * lever - lever;
    let step = earlier_from_later.translation.vector;
    // s^2 step^2 + 2 s (swing . step) + swing^2 = chord^2
    let (square, along) = (step.norm_squared(), swing.dot(&step));
    let root = libm::sqrt(along * along - square * (swing.norm_squared() - chord_m * chord_m));
    let ratio = (root - along) / square;
    let slope = chord_m / (root * ratio);
    let relative_sigma = sigma_m * chord_per_arc * slope;
    let is_usable = way_m >= MIN_WAY_M && ratio > 0.0 && ratio.is_finite() && relative_sigma.is_finite();
    is_usable.then_some(ScaleMeasurement { ratio, relative_sigma, source: ScaleSource::WheelSpeed })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;
    use nalgebra::{Translation3, UnitQuaternion};

    #[test]
    fn known_depths_tell_the_scale_through_a_third_of_nonsense() {
        let check = |n: usize, n_wrong: usize, scale: f64, expected: bool| {
            let mut rng = Rng::new(3, 0, 0);
            let pairs = (0..n).map(|i| {
                let depth_m = 5.0 + 60.0 * rng.unit_f64();
                let noise = 1.0 + 0.04 * (rng.unit_f64() - 0.5);
                let factor = if i < n_wrong { 3.0 } else { scale * noise };
                [depth_m as f32, (depth_m * factor) as f32]
            });
            let found = depth_ratio(pairs);
            assert_eq!(found.is_some(), expected, "{n} {n_wrong} {scale}: {found:?}");
            if let Some(found) = found {
                let error = libm::log(found.ratio / scale).abs();
                assert!(error < 0.01 && found.relative_sigma < 0.01 && found.relative_sigma > 0.0, "{found:?}");
            }
        };
        check(60, 0, 1.0, true);
        check(90, 30, 0.8, true);
        check(1000, 0, 1.2, true);
        check(10, 0, 1.0, false);
        check(0, 0, 1.0, false);
        let unknown = [[f32::NAN, 3.0], [3.0, f32::NAN], [-1.0, 2.0], [3.0, 101.0]];
        assert_eq!(depth_ratio(unknown.iter().copied().cycle().take(100)), None);
    }

    #[test]
    fn the_wheels_tell_the_scale_also_in_a_turn() {
        // The camera sits 1.2 m ahead of the rear axle, which follows an arc of the given length and turn.
        let check = |arc_m: f64, turn_rad: f64, scale: f64| {
            let mounting = Mounting {
                height_m: 1.5,
                pitch_rad: 0.0,
                roll_rad: 0.0,
                forward_axis: [0.0, 0.0, 1.0],
                lever_arm_m: [0.0, 1.0, -1.2],
            };
            let half = 0.5 * turn_rad;
            let chord_m = if turn_rad == 0.0 { arc_m } else { arc_m * libm::sin(half) / half };
            let axle = Vector3::new(libm::sin(half), 0.0, libm::cos(half)) * chord_m;
            let turn = UnitQuaternion::from_scaled_axis(Vector3::y() * turn_rad);
            let lever = Vector3::from(mounting.lever_arm_m);
            let camera = axle + lever - turn * lever;
            let ours = Rigid::from_parts(Translation3::from(camera / scale), turn);
            let found = wheel_ratio(&ours, &mounting, arc_m, 0.01 * arc_m).expect("it moves");
            assert!((found.ratio / scale - 1.0).abs() < 1e-9, "{arc_m} {turn_rad}: {found:?}");
            let longer = wheel_ratio(&ours, &mounting, arc_m * 1.0001, 0.0).expect("it moves");
            let slope = (longer.ratio / found.ratio - 1.0) / 1e-4;
            assert!((found.relative_sigma / (0.01 * slope) - 1.0).abs() < 0.01, "{found:?} {slope}");
        };
        check(1.0, 0.0, 1.0);
        check(1.5, 0.0, 0.7);
        check(0.5, 0.08, 1.3);
        check(2.0, -0.3, 1.0);
        let standing = Rigid::identity();
        let mounting = Mounting {
            height_m: 1.5,
            pitch_rad: 0.0,
            roll_rad: 0.0,
            forward_axis: [0.0, 0.0, 1.0],
            lever_arm_m: [0.0; 3],
        };
        assert_eq!(wheel_ratio(&standing, &mounting, 1.0, 0.01), None);
        assert_eq!(wheel_ratio(&Rigid::translation(0.0, 0.0, 1.0), &mounting, f64::NAN, 0.01), None);
    }
}
