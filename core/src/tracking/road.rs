//! Metres from the road, a network's depths and the wheels, at the start and ever after.

use super::tracker::Tracker;
use super::{Aids, KeyframePoint, RoadPlane, Travelled};
use crate::conventions::Rigid;
use crate::keyframe::{Column, KeyframeWindow, WINDOW};
use crate::pose::{RelativePose, StepLength};
use crate::scale::{
    MAX_DEPTHS, RoadAlignment, RoadPair, ScaleFilter, ScaleMeasurement, ScaleSource, ScaleSources, ScaleUpdate,
    align_road, depth_ratio, wheel_ratio,
};
use nalgebra::{Translation3, Vector3};

/// Lengths of the first step that are searched, m.
const FIRST_STEP_RANGE_M: [f64; 2] = [0.1, 8.0];
/// How far a step's length may be off that the speed so far predicts, before there are landmarks.
const COASTED_RANGE: [f64; 2] = [0.5, 2.0];
/// Lengths that are tried around one that landmarks tell: how far the scale may drift unseen behind a truck.
const KNOWN_RANGE: [f64; 2] = [0.75, 1.33];

/// Keyframes without a measured scale after which the window holds no length that was measured: behind a truck that fills
/// the view the landmarks are the truck's.
const FORGOTTEN_KEYFRAMES: u32 = WINDOW as u32;
/// Two measurements of a scale that was forgotten agree within this factor, or are noise.
const CONFIRMED_RANGE: f64 = 1.2;

/// Upper part of the image whose depths are not compared (peer: the lower 70 % of the rows are).
const SKY_SHARE: f32 = 0.3;
/// Points whose triangulated depth is less certain are not compared.
const MAX_DEPTH_SIGMA: f32 = 0.1;
/// A measurement that keeps this much weight shows the road well enough to learn its normal from.
const BELIEVED_WEIGHT: f64 = 0.5;

/// A step's length as the road tells it.
pub(super) struct RoadStep {
    pub(super) step_m: f64,
    pub(super) n_pixels: usize,
}

/// What a keyframe learnt about the scale.
#[derive(Clone, Copy)]
pub(super) struct ScaleFigures {
    /// Measured over predicted scale, of the first source that measured it; NaN when none did.
    pub(super) ratio: f64,
    pub(super) n_pixels: usize,
    /// Whose measurements were merged.
    pub(super) sources: ScaleSources,
}

impl ScaleFigures {
    const NOTHING: Self = Self { ratio: f64::NAN, n_pixels: 0, sources: ScaleSources::NONE };
}

/// The step between the two newest keyframes, whose scale is measured.
struct ScaledStep {
    earlier: Column,
    earlier_slot: usize,
    earlier_from_later: Rigid,
}

impl Tracker<'_> {
    /// Length of the step from the keyframe to the current frame, from the road alone.
    pub(super) fn road_step(&mut self, motion: &RelativePose, predicted_m: f64) -> Option<RoadStep> {
        let later_from_earlier =
            |length_m: f64| Rigid::from_parts(Translation3::from(motion.direction * length_m), motion.rotation);
        let pair = |length_m: f64| RoadPair {
            later: &self.pyramids[self.current_slot],
            earlier: &self.pyramids[self.keyframe_slot],
            camera: &self.camera,
            earlier_from_later: later_from_earlier(length_m).inverse(),
            expected_normal: self.expected_normal,
            expected_height_m: self.mounting.height_m,
        };
        let settings = &self.settings.road;
        let [shortest_m, longest_m] = FIRST_STEP_RANGE_M;
        // Who stood a moment ago tells nothing of the step after that.
        let is_known = self.motion.prior.is_some() && predicted_m > shortest_m;
        // A step of 1 m sees the road at 1 / length of its height.
        let (start_m, range) =
            if is_known { (predicted_m, COASTED_RANGE) } else { (1.0, [1.0 / longest_m, 1.0 / shortest_m]) };
        let found = align_road(self.simd, &pair(start_m), range, &self.mounting, settings).ok()?;
        let step_m = start_m * self.mounting.height_m / found.height_m;
        Some(RoadStep { step_m, n_pixels: found.n_pixels })
    }

    /// Adds the way of a frame to that since the last keyframe; unknown once a frame does not tell.
    pub(super) fn note_travelled(&mut self, frame: Option<Travelled>) {
        let sum = |(way, frame): (Travelled, Travelled)| Travelled {
            metres: way.metres + frame.metres,
            sigma_m: libm::hypot(way.sigma_m, frame.sigma_m),
        };
        self.travelled = self.travelled.zip(frame).map(sum);
    }

    /// Length of the step from the keyframe to the current frame, from the wheels alone.
    pub(super) fn wheel_step(&self, motion: &RelativePose) -> Option<StepLength> {
        let way = self.travelled.filter(|_| self.settings.scale_sources.contains(ScaleSource::WheelSpeed))?;
        let of_one_m = Rigid::from_parts(Translation3::from(motion.direction), motion.rotation).inverse();
        let found = wheel_ratio(&of_one_m, &self.mounting, way.metres, way.sigma_m)?;
        let relative_sigma = libm::hypot(found.relative_sigma, self.settings.scale.wheel_sigma);
        Some(StepLength { length_m: found.ratio, sigma_m: found.ratio * relative_sigma })
    }

    /// Measures the scale between the two newest keyframes by all that can tell it, merges that and corrects the window.
    ///
    /// `earlier_slot` holds the pyramid of the keyframe before the newest, `current_slot` that of the newest.
    pub(super) fn correct_scale(&mut self, earlier_slot: usize, aids: &mut Aids<'_>) -> ScaleFigures {
        let Some(step) = self.newest_step(earlier_slot) else { return ScaleFigures::NOTHING };
        // What does not look at the road comes first, because the road is what traffic hides.
        let wheels = self.measure_wheels(&step);
        let depths = self.measure_depths(earlier_slot, aids);
        let road = self.measure_road(&step);
        let of_road = road.map(|found| ScaleMeasurement {
            ratio: self.mounting.height_m / found.height_m,
            relative_sigma: found.relative_sigma,
            source: ScaleSource::GroundPlane,
        });
        let step_m = step.earlier_from_later.translation.vector.norm();
        let drift = self.scale.drive(step_m, step.earlier_from_later.rotation.angle(), &self.settings.scale);
        self.drift_at_keyframe.drive(step_m);
        self.window.rescale(drift, step.earlier, self.landmarks);
        self.n_unmeasured = self.n_unmeasured.saturating_add(1);
        self.merge([wheels, depths, of_road], drift, road, step.earlier)
    }

    /// The same for the very first step, whose length is already the road's or the wheels'; the points of the newest keyframe
    /// are published.
    pub(super) fn correct_first_scale(&mut self, aids: &mut Aids<'_>) -> ScaleSources {
        let Some(step) = self.newest_step(self.keyframe_slot) else { return ScaleSources::NONE };
        let measured = [self.measure_wheels(&step), self.measure_depths(self.keyframe_slot, aids), None];
        self.merge(measured, 1.0, None, step.earlier).sources
    }

    fn newest_step(&self, earlier_slot: usize) -> Option<ScaledStep> {
        let newest = self.window.newest()?;
        let earlier = KeyframeWindow::column_of(newest.ordinal.checked_sub(1)?);
        let earlier_from_later = self.window.at(earlier)?.camera_from_world * newest.camera_from_world.inverse();
        Some(ScaledStep { earlier, earlier_slot, earlier_from_later })
    }

    /// Merges what the sources measured, one after the other; `factor` is what the window was multiplied by since.
    fn merge(
        &mut self,
        measured: [Option<ScaleMeasurement>; ScaleSource::N],
        mut factor: f64,
        road: Option<RoadAlignment>,
        center: Column,
    ) -> ScaleFigures {
        let mut figures = ScaleFigures { n_pixels: road.map_or(0, |found| found.n_pixels), ..ScaleFigures::NOTHING };
        for measured in measured.into_iter().flatten() {
            let measured = ScaleMeasurement { ratio: measured.ratio / factor, ..measured };
            figures.ratio = if figures.ratio.is_nan() { measured.ratio } else { figures.ratio };
            if self.is_scale_forgotten() && !self.scale_is_found_again(measured.ratio) {
                continue;
            }
            let update = self.scale.update(&measured, &self.settings.scale);
            let ScaleUpdate::Accept { correction, weight, gains } = update else { continue };
            self.n_unmeasured = 0;
            figures.sources = figures.sources.with(measured.source);
            self.drift_at_keyframe.correct_scale(gains);
            self.window.rescale(correction, center, self.landmarks);
            factor *= correction;
            let is_road = measured.source == ScaleSource::GroundPlane && weight > BELIEVED_WEIGHT;
            if let Some(found) = road.filter(|_| is_road) {
                self.learn_normal(&found);
            }
        }
        figures
    }

    /// Whether nothing in the window has a length that was measured.
    fn is_scale_forgotten(&self) -> bool {
        self.n_unmeasured > FORGOTTEN_KEYFRAMES
    }

    /// Whether the last two measurements of a forgotten scale agree; then the filter begins anew.
    fn scale_is_found_again(&mut self, ratio: f64) -> bool {
        let before = self.unconfirmed_ratio.replace(ratio);
        let agrees = before.is_some_and(|before| (1.0 / CONFIRMED_RANGE..CONFIRMED_RANGE).contains(&(ratio / before)));
        if agrees {
            self.forget_scale();
        }
        agrees
    }

    /// The next measurement is the first one.
    pub(super) fn forget_scale(&mut self) {
        self.scale = ScaleFilter::new(&self.settings.scale);
        self.drift.forget_scale();
        self.drift_at_keyframe.forget_scale();
        (self.n_unmeasured, self.unconfirmed_ratio) = (0, None);
    }

    /// The way of the wheels between the two newest keyframes.
    fn measure_wheels(&self, step: &ScaledStep) -> Option<ScaleMeasurement> {
        let way = self.travelled.filter(|_| self.settings.scale_sources.contains(ScaleSource::WheelSpeed))?;
        wheel_ratio(&step.earlier_from_later, &self.mounting, way.metres, way.sigma_m)
    }

    /// The road between the two newest keyframes.
    fn measure_road(&self, step: &ScaledStep) -> Option<RoadAlignment> {
        if !self.settings.scale_sources.contains(ScaleSource::GroundPlane) {
            return None;
        }
        let step_m = step.earlier_from_later.translation.vector.norm();
        let [shortest_m, longest_m] = FIRST_STEP_RANGE_M;
        let is_forgotten = self.is_scale_forgotten() && step_m > 0.0;
        let range = if is_forgotten { [step_m / longest_m, step_m / shortest_m] } else { KNOWN_RANGE };
        let pair = RoadPair {
            later: &self.pyramids[self.current_slot],
            earlier: &self.pyramids[step.earlier_slot],
            camera: &self.camera,
            earlier_from_later: step.earlier_from_later,
            expected_normal: self.expected_normal,
            expected_height_m: self.mounting.height_m,
        };
        align_road(self.simd, &pair, range, &self.mounting, &self.settings.road).ok()
    }

    /// Compares what is known about the depths in the keyframe before the newest with its triangulated points.
    fn measure_depths(&self, earlier_slot: usize, aids: &mut Aids<'_>) -> Option<ScaleMeasurement> {
        let is_wanted = self.settings.scale_sources.contains(ScaleSource::DepthNetwork);
        let prior = aids.depth.as_mut().filter(|_| is_wanted)?;
        let points = self.keyframe_points();
        let highest_px = SKY_SHARE * self.camera.height as f32;
        let is_usable = |p: &&KeyframePoint| p.pixel[1] >= highest_px && p.relative_sigma < MAX_DEPTH_SIGMA;
        let stride = points.iter().filter(is_usable).count().div_ceil(MAX_DEPTHS).max(1);
        let chosen = || points.iter().filter(is_usable).step_by(stride).take(MAX_DEPTHS);
        let pixels: heapless::Vec<[f32; 2], MAX_DEPTHS> = chosen().map(|p| p.pixel).collect();
        let mut depths_m = [f32::NAN; MAX_DEPTHS];
        let known = depths_m.get_mut(..pixels.len())?;
        prior.depths_m(&self.pyramids[earlier_slot], &pixels, known);
        depth_ratio(chosen().zip(known.iter()).map(|(point, &known_m)| [point.depth_m, known_m]))
    }

    /// Lets the expected normal follow the measured ones slowly and not far from the mounting's.
    fn learn_normal(&mut self, found: &RoadAlignment) {
        self.road =
            Some(RoadPlane { normal_in_camera: found.normal_in_camera.into(), height_m: self.mounting.height_m });
        let share = self.settings.normal_adaptation;
        let next: Vector3<f64> = (self.expected_normal * (1.0 - share) + found.normal_in_camera * share).normalize();
        if next.angle(&self.mounting.road_normal_in_camera()) <= self.settings.max_normal_deviation_rad {
            self.expected_normal = next;
        }
    }
}
