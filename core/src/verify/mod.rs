//! Does a vehicle move like that?

use crate::camera::Mounting;
use crate::conventions::Rigid;
use nalgebra::Vector3;

/// What a vehicle cannot do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionLimits {
    /// Largest change of the rotation rate between two steps, rad/s. Range 0.1..10; the paper's 5 degrees per
    /// keyframe, as a rate at its keyframes' 10 Hz, is 0.87.
    pub max_turn_change_rad_per_s: f64,
    /// Largest angle between the axle's step and the forward axis, rad. Range 0.05..1.5; 15 degrees in the paper.
    pub max_side_slip_rad: f64,
    /// Steps shorter than this have no believable direction and are not tested for it, m. Range 0.01..2.
    pub min_step_m: f64,
    /// Highest speed, m/s. Range 1..200.
    pub max_speed_m_per_s: f64,
    /// Largest change of speed, m/s^2. Range 1..200; beyond the tyres' 10 because single steps are noisy.
    pub max_acceleration_m_per_s2: f64,
    /// Whether the vehicle may drive backwards.
    pub reverse_allowed: bool,
}

/// What the last believed step was like.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionPrior {
    /// Rotation per second, `later_from_earlier`, as a rotation vector, rad/s.
    pub rotation_rate: Vector3<f64>,
    /// Speed, m/s.
    pub speed_m_per_s: f64,
}

/// The numbers behind a verdict.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionFigures {
    /// Turn against the prior's turn over the same time, rad; 0 without a prior.
    pub turn_change_rad: f64,
    /// Angle between the axle's step and the forward axis, rad; NaN when the step is too short to tell.
    pub side_slip_rad: f64,
    /// Length of the axle's step, m.
    pub step_m: f64,
}

/// Whether a step is believed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum MotionVerdict {
    /// A vehicle can do that.
    Accept(MotionFigures),
    /// Turns by too much since the last step.
    TurnsTooFast(MotionFigures),
    /// Slips sideways, or drives backwards where it may not.
    SlipsSideways(MotionFigures),
    /// Too fast, or changes its speed too suddenly.
    TooFast(MotionFigures),
}

impl MotionVerdict {
    /// Whether the step is believed.
    pub fn is_accepted(&self) -> bool {
        matches!(self, Self::Accept(_))
    }

    /// The numbers behind it.
    pub fn figures(&self) -> &MotionFigures {
        match self {
            Self::Accept(f) | Self::TurnsTooFast(f) | Self::SlipsSideways(f) | Self::TooFast(f) => f,
        }
    }
}

/// Judges the camera's step between two frames.
///
/// The side slip is that of the rear axle, which cannot slip: with R, t = `later_from_earlier` and the axle at
/// `lever` in camera axes, the axle moved in the earlier camera's frame by  R^T (lever - t) - lever.
///
/// # Inputs
/// * `later_from_earlier`: the step, m.
/// * `duration_s`: time between the two frames; not above 0 is an implausible step.
/// * `prior`: the last believed step, `None` at the start.
///
/// # Output
/// The first limit that is broken, with all numbers.
///
/// # Cost
/// Constant.
///
/// # Source
/// KiloGS paper, sec. 3.1.2; the lever arm and the rates are ours (method.md 6).
pub fn judge_motion(
    later_from_earlier: &Rigid,
    duration_s: f64,
    prior: Option<&MotionPrior>,
    mounting: &Mounting,
    limits: &MotionLimits,
) -> MotionVerdict {
    let lever = Vector3::from(mounting.lever_arm_m);
    let axle_step = later_from_earlier.rotation.inverse() * (lever - later_from_earlier.translation.vector) - lever;
    let step_m = axle_step.norm();
    let along = axle_step.dot(&Vector3::from(mounting.forward_axis));
    let along = if limits.reverse_allowed { along.abs() } else { along };
    let slip_rad = libm::acos((along / step_m).clamp(-1.0, 1.0));
    let is_long = step_m >= limits.min_step_m;
    let rotation = later_from_earlier.rotation.scaled_axis();
    let turn_change_rad = prior.map_or(0.0, |p| (rotation - p.rotation_rate * duration_s).norm());
    let side_slip_rad = if is_long { slip_rad } else { f64::NAN };
    let figures = MotionFigures { turn_change_rad, side_slip_rad, step_m };
    let speed = step_m / duration_s;
    // Written so that NaN is not accepted.
    if !(speed >= 0.0 && speed <= limits.max_speed_m_per_s) {
        return MotionVerdict::TooFast(figures);
    }
    if !prior.is_none_or(|p| (speed - p.speed_m_per_s).abs() * duration_s <= allowed_change(limits, duration_s)) {
        return MotionVerdict::TooFast(figures);
    }
    if turn_change_rad.is_nan() || turn_change_rad > limits.max_turn_change_rad_per_s * duration_s {
        return MotionVerdict::TurnsTooFast(figures);
    }
    if is_long && slip_rad > limits.max_side_slip_rad {
        return MotionVerdict::SlipsSideways(figures);
    }
    MotionVerdict::Accept(figures)
}

/// Metres by which a step may differ from the prior's: acceleration, or what a step's noise is anyway.
fn allowed_change(limits: &MotionLimits, duration_s: f64) -> f64 {
    (limits.max_acceleration_m_per_s2 * duration_s * duration_s).max(limits.min_step_m)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::se3;
    use nalgebra::Vector6;

    const LIMITS: MotionLimits = MotionLimits {
        max_turn_change_rad_per_s: 0.87,
        max_side_slip_rad: 0.26,
        min_step_m: 0.1,
        max_speed_m_per_s: 70.0,
        max_acceleration_m_per_s2: 50.0,
        reverse_allowed: false,
    };
    const MOUNTING: Mounting = Mounting {
        height_m: 1.65,
        pitch_rad: 0.0,
        roll_rad: 0.0,
        forward_axis: [0.0, 0.0, 1.0],
        lever_arm_m: [0.0, 0.0, -2.0],
    };

    fn judged(tangent: [f64; 6], prior: Option<MotionPrior>) -> MotionVerdict {
        judge_motion(&se3::exp(&Vector6::from(tangent)), 0.1, prior.as_ref(), &MOUNTING, &LIMITS)
    }

    fn prior(yaw_rate: f64, speed_m_per_s: f64) -> Option<MotionPrior> {
        Some(MotionPrior { rotation_rate: Vector3::y() * yaw_rate, speed_m_per_s })
    }

    #[test]
    fn driving_on_is_accepted_and_each_limit_has_its_verdict() {
        use MotionVerdict as V;
        let straight = [0.0, 0.0, 0.0, 0.0, 0.0, -1.0];
        assert!(judged(straight, None).is_accepted());
        assert!(judged(straight, prior(0.0, 10.0)).is_accepted());
        assert!(matches!(judged([0.0, 0.1, 0.0, 0.0, 0.0, -1.0], prior(0.0, 10.0)), V::TurnsTooFast(_)));
        assert!(matches!(judged([0.0, 0.0, 0.0, -0.5, 0.0, -0.8], prior(0.0, 10.0)), V::SlipsSideways(_)));
        assert!(matches!(judged([0.0, 0.0, 0.0, 0.0, 0.0, 1.0], None), V::SlipsSideways(_)));
        assert!(matches!(judged([0.0, 0.0, 0.0, 0.0, 0.0, -8.0], None), V::TooFast(_)));
        assert!(matches!(judged(straight, prior(0.0, 20.0)), V::TooFast(_)));
    }

    #[test]
    fn a_camera_ahead_of_the_axle_may_swing_sideways_in_a_turn() {
        // The axle drives 0.4 m straight ahead while the vehicle turns by 0.15 rad about it: the camera, 2 m
        // ahead, swings by 0.3 m. Without the lever arm that would be a slip of 37 degrees.
        let world_from_axle = Rigid::new(Vector3::new(0.0, 0.0, 0.4), Vector3::y() * 0.15);
        let axle_from_camera = Rigid::translation(0.0, 0.0, 2.0);
        let earlier_from_later = axle_from_camera.inverse() * world_from_axle * axle_from_camera;
        let step = earlier_from_later.inverse();
        let with_lever = judge_motion(&step, 0.1, prior(-1.5, 4.0).as_ref(), &MOUNTING, &LIMITS);
        assert!(with_lever.is_accepted(), "{with_lever:?}");
        assert!(with_lever.figures().side_slip_rad < 1e-6);
        let no_lever = Mounting { lever_arm_m: [0.0; 3], ..MOUNTING };
        let without = judge_motion(&step, 0.1, prior(-1.5, 4.0).as_ref(), &no_lever, &LIMITS);
        assert!(matches!(without, MotionVerdict::SlipsSideways(_)), "{without:?}");
    }

    #[test]
    fn nan_and_no_time_are_never_accepted_and_standing_always() {
        assert!(!judged([f64::NAN; 6], None).is_accepted());
        let standing = judged([0.0; 6], prior(0.0, 0.0));
        assert!(standing.is_accepted() && standing.figures().side_slip_rad.is_nan());
        let step = Rigid::translation(0.0, 0.0, -1.0);
        assert!(!judge_motion(&step, 0.0, None, &MOUNTING, &LIMITS).is_accepted());
    }
}
