//! The road's plane from the direct alignment of its pixels between two images.

use super::equations::Fit;
use super::strip::{Alignment, Normal5, Strip};
use super::tiles::{Election, elect};
use crate::camera::{Mounting, Pinhole};
use crate::conventions::Rigid;
use crate::features::SimdLevel;
use crate::frame::Pyramid;
use core::fmt;
use nalgebra::{Matrix3, Vector3};

/// Which part of the image is taken for road, and how far it may deviate from the mounting.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RoadSettings {
    /// Nearest and farthest road used, m ahead. Range 2..60. Nearer is sharper but leaves the image.
    pub distance_m: [f64; 2],
    /// Half the width of the road strip, m. Range 0.5..6; a narrow strip vanishes behind the car ahead, and what a wide one
    /// sees beside the road has to win an election against it.
    pub half_width_m: f64,
    /// Change of grey value at one place at which a pixel counts half: what does not change is flat, or rides along
    /// (a car ahead and its shadow). Range 0..50; 0 counts all alike.
    pub standing_grey: f64,
    /// Share of the motion's curvature that the strip follows. Range 0..1.
    pub bend: f64,
    /// Standard deviation of pitch and of roll of the road against the expected normal, rad. Range 0.001..0.1. The road ahead
    /// bends up and down and brakes pitch the body, but its crossfall is the one that the wheels stand on: along the true poses
    /// of the straight KITTI 01, 04 and 06 the roll varies by 0.003 to 0.005 rad. A loose roll is what vehicles' shadows on
    /// one side take for a road that falls away there.
    pub normal_sigma_rad: [f64; 2],
    /// Width in pixels that the working level of the pyramid should have at least. Range 300..2000.
    pub working_width_px: usize,
    /// Gauss-Newton steps per level. Range 1..30.
    pub max_iterations: usize,
    /// Fewest pixels that make a road. Range 50..5000.
    pub min_pixels: usize,
    /// Correlation of the aligned strips below which they do not show the same road. Range 0..1.
    pub min_correlation: f64,
    /// Logarithm of the likelihood by which the elected height must surpass any other. Range 0..50.
    pub min_margin: f64,
    /// Fewest px that the nearest road must move between the images. Range 1..50.
    pub min_flow_px: f64,
}

/// Two images of the road and the motion between them.
#[derive(Clone, Copy, Debug)]
pub struct RoadPair<'a, 'm> {
    /// The image that the plane is to be expressed in: the nearer, sharper view.
    pub later: &'a Pyramid<'m>,
    /// The image before the motion.
    pub earlier: &'a Pyramid<'m>,
    /// Camera of the full images.
    pub camera: &'a Pinhole,
    /// Motion between the two, m in the scale that is to be judged.
    pub earlier_from_later: Rigid,
    /// Where the road should be: unit normal from the camera to the road, camera axes of `later`.
    pub expected_normal: Vector3<f64>,
    /// Distance of the road expected in the motion's scale, m.
    pub expected_height_m: f64,
}

/// A road plane in the scale of the motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RoadAlignment {
    /// Unit normal from the camera to the road, camera axes of the later image.
    pub normal_in_camera: Vector3<f64>,
    /// Distance of the camera from the road in the scale of the motion, m.
    pub height_m: f64,
    /// Standard deviation of the height over the height, from the pixels' noise alone.
    pub relative_sigma: f64,
    /// Correlation of the aligned strips.
    pub correlation: f64,
    /// Pixels used, of the working level.
    pub n_pixels: usize,
    /// Share of the tiles with texture that agree with the plane.
    pub agreement: f64,
}

/// Why the road could not be measured; keep the scale that there is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RoadProblem {
    /// The motion does not move the road by enough pixels: wait for a longer step.
    TooLittleMotion {
        /// Flow of the nearest road, px.
        flow_px: f64,
    },
    /// The strip is not in the image, or has no texture.
    TooFewPixels {
        /// Pixels found.
        found: usize,
        /// Pixels needed.
        needed: usize,
    },
    /// The strips do not look alike: a vehicle, a shadow, or a wrong motion.
    Different {
        /// Correlation of the strips.
        correlation: f64,
    },
    /// Two heights explain the strips almost equally well: wait for a longer step.
    Ambiguous {
        /// Logarithm of how much likelier the better one is.
        margin: f64,
    },
    /// The plane went where no road can be.
    Implausible {
        /// Height found, m.
        height_m: f64,
    },
}

impl fmt::Display for RoadProblem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TooLittleMotion { flow_px } => write!(f, "the road moved by {flow_px:.1} px only"),
            Self::TooFewPixels { found, needed } => write!(f, "{found} road pixels, {needed} needed"),
            Self::Different { correlation } => write!(f, "the road strips correlate by {correlation:.2} only"),
            Self::Ambiguous { margin } => write!(f, "another height of the road is as likely but for e^{margin:.1}"),
            Self::Implausible { height_m } => write!(f, "the road came out {height_m:.2} m below the camera"),
        }
    }
}

impl core::error::Error for RoadProblem {}

/// Measures the road's plane by aligning its pixels between two images.
///
/// A point of the plane m^T X = 1 (m = normal / height) seen along the ray x has the inverse depth m^T x, so the
/// earlier camera sees it along  R x + t (m^T x),  which is linear in m. First the tiles of the strip elect one of a
/// row of heights, then all pixels but those of the tiles that dissent minimise
/// sum_p rho(g I_earlier(warp(p; m)) + b - I_later(p)) over m, contrast g and brightness b, rho = Tukey, with a
/// prior on the direction of m, by Gauss-Newton from coarse to fine.
///
/// # Inputs
/// * `pair`: images, motion and where the road is expected; the motion's scale is the unit of the result.
/// * `range`: heights over the expected one that are possible; a wide range finds the length of a step that nobody knows.
/// * `mounting`: true height of the camera, which places the strip in the image.
///
/// # Output
/// The plane in the scale of the motion: true height over its height is the factor to true metres.
///
/// # Errors
/// [`RoadProblem`]: nothing was learnt about the scale.
///
/// # Cost
/// O(pixels of the strip in the working level * (heights + iterations)); 30 KiB of stack. Same bits on every SIMD level.
///
/// # Source
/// Faugeras & Lustman 1988 (plane-induced homography); Baker & Matthews 2004 (alignment). Own derivation of the
/// parametrisation and the election.
pub fn align_road<'a>(
    simd: SimdLevel,
    pair: &RoadPair<'a, '_>,
    range: [f64; 2],
    mounting: &Mounting,
    settings: &'a RoadSettings,
) -> Result<RoadAlignment, RoadProblem> {
    require_flow(pair, range[0], mounting, settings)?;
    let finest = finest_level(pair, settings);
    let nothing = RoadProblem::TooFewPixels { found: 0, needed: settings.min_pixels };
    let working = Strip::new(pair, finest, mounting, settings).ok_or(nothing)?;
    let election = elect(simd, &working, pair, range)?;
    if election.margin < settings.min_margin {
        return Err(RoadProblem::Ambiguous { margin: election.margin });
    }
    require_flow(pair, election.height_ratio, mounting, settings)?;
    let mut state = Alignment::at(pair.expected_normal / (pair.expected_height_m * election.height_ratio));
    let mut measured = None;
    for level in (finest..(finest + 2).min(pair.later.n_levels())).rev() {
        let Some(strip) = Strip::new(pair, level, mounting, settings) else { continue };
        let before = state;
        match state.iterate(simd, &strip, pair, &election.mask, mounting, settings) {
            Ok(found) => measured = Some(found),
            // A coarse level only brings the start nearer: one that is too small for that is left out.
            Err(RoadProblem::TooFewPixels { .. }) if level > finest => state = before,
            Err(problem) => return Err(problem),
        }
    }
    let (normal_equations, fit) = measured.ok_or(nothing)?;
    judge(&state, &normal_equations, &fit, &election, pair, settings)
}

/// The nearest road must move by enough pixels if it lies at this ratio of the height expected.
fn require_flow(
    pair: &RoadPair<'_, '_>,
    height_ratio: f64,
    mounting: &Mounting,
    settings: &RoadSettings,
) -> Result<(), RoadProblem> {
    let nearest_z1 = Vector3::new(0.0, mounting.height_m / settings.distance_m[0], 1.0);
    let plane = pair.expected_normal / (pair.expected_height_m * height_ratio);
    let shift = pair.earlier_from_later.translation.vector * plane.dot(&nearest_z1);
    let flow_px = pair.camera.fy * (shift.xy() - nearest_z1.xy() * shift.z).norm();
    if flow_px.is_nan() || flow_px < settings.min_flow_px {
        return Err(RoadProblem::TooLittleMotion { flow_px });
    }
    Ok(())
}

/// The coarsest level that is still as wide as the settings ask for.
fn finest_level(pair: &RoadPair<'_, '_>, settings: &RoadSettings) -> usize {
    (0..pair.later.n_levels())
        .rev()
        .find(|&l| pair.later.level(l).is_some_and(|level| level.width() >= settings.working_width_px))
        .unwrap_or(0)
}

/// The alignment may not leave the elected height by more than this factor: then it went somewhere else.
const MAX_CHANGE: f64 = 1.2;

fn judge(
    state: &Alignment,
    normal_equations: &Normal5,
    fit: &Fit,
    election: &Election,
    pair: &RoadPair<'_, '_>,
    settings: &RoadSettings,
) -> Result<RoadAlignment, RoadProblem> {
    let height_m = 1.0 / state.plane.norm();
    let ratio = height_m / (pair.expected_height_m * election.height_ratio);
    if !(1.0 / MAX_CHANGE..=MAX_CHANGE).contains(&ratio) {
        return Err(RoadProblem::Implausible { height_m });
    }
    if fit.correlation.is_nan() || fit.correlation < settings.min_correlation {
        return Err(RoadProblem::Different { correlation: fit.correlation });
    }
    let normal_in_camera = state.plane * height_m;
    let covariance = normal_equations.cholesky().map(|c| c.inverse().fixed_view::<3, 3>(0, 0).into_owned());
    let variance = covariance.map_or(f64::INFINITY, |c: Matrix3<f64>| normal_in_camera.dot(&(c * normal_in_camera)));
    Ok(RoadAlignment {
        normal_in_camera,
        height_m,
        relative_sigma: libm::sqrt(variance) * height_m,
        correlation: fit.correlation,
        n_pixels: fit.n_pixels,
        agreement: election.n_agreeing as f64 / election.n_votes as f64,
    })
}
