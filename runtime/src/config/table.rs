//! Every setting: its key, what values it takes, and the field that it fills.

use super::schema::{Kind, Range, Scalar, Setting};
use crate::mapping::MAX_OLDER_VIEWS;
use crate::refine::PruneScore;
use crate::settings::{Matcher, Settings};
use crate::splat::LearningRate;
use kilogs_core::map::insertion::StructureOperator;
use kilogs_core::scale::{ScaleSource, ScaleSources};
use kilogs_core::tracking::{DynamicFilter, PYRAMID_LEVELS, PoseModels};
use std::time::Duration;

macro_rules! number {
    ($key:literal, $range:expr, $($field:tt)+) => {
        Setting {
            key: $key,
            kind: Kind::Number { range: $range, put: |settings, value| settings.$($field)+ = Scalar::of(value) },
        }
    };
}

macro_rules! whole {
    ($key:literal, $range:expr, $($field:tt)+) => {
        Setting {
            key: $key,
            kind: Kind::Whole { range: $range, put: |settings, value| settings.$($field)+ = Scalar::of(value) },
        }
    };
}

macro_rules! switch {
    ($key:literal, $planned:expr, $($field:tt)+) => {
        Setting { key: $key, kind: Kind::Switch { planned: $planned, put: |settings, on| settings.$($field)+ = on } }
    };
}

impl Scalar for LearningRate {
    fn of(value: f64) -> Self {
        Self::constant(value as f32)
    }
}

/// Every setting, in the order of `default.toml`.
pub(super) const SETTINGS: &[Setting] = &[
    Setting {
        key: "tracking.pose_models",
        kind: Kind::Choice { available: &["both", "essential", "pnp"], planned: &[], put: put_pose_models },
    },
    Setting {
        key: "tracking.dynamic_filter",
        kind: Kind::Choice { available: &["off", "paper", "region"], planned: &[], put: put_dynamic_filter },
    },
    Setting {
        key: "tracking.dense_fallback",
        kind: Kind::Choice {
            available: &["off", "on"],
            planned: &[],
            put: |settings, word| settings.tracking.dense_fallback = word == "on",
        },
    },
    Setting {
        key: "tracking.bundle_adjustment",
        kind: Kind::Choice {
            available: &["off", "on"],
            planned: &[],
            put: |settings, word| settings.tracking.tracker.bundle_adjustment = word == "on",
        },
    },
    Setting {
        key: "tracking.matcher",
        kind: Kind::Choice { available: &["classical", "xfeat", "disk"], planned: &[], put: put_matcher },
    },
    whole!("tracking.lk_levels", Range::closed(1.0, PYRAMID_LEVELS as f64), tracking.tracker.tracks.lk.n_levels),
    whole!("tracking.lk_max_steps", Range::closed(1.0, 100.0), tracking.tracker.tracks.lk.max_steps),
    number!("tracking.lk_min_eigenvalue", Range::closed(0.0, 1000.0), tracking.tracker.tracks.lk.min_eigenvalue),
    number!("tracking.lk_min_correlation", Range::closed(-1.0, 1.0), tracking.tracker.tracks.lk.min_correlation),
    number!("tracking.lk_max_backward_px", Range::open_closed(0.0, 10.0), tracking.tracker.tracks.lk.max_backward_px),
    number!("tracking.refine_max_px", Range::open_closed(0.0, 10.0), tracking.tracker.tracks.affine.max_moved_px),
    whole!("tracking.refine_max_steps", Range::closed(0.0, 50.0), tracking.tracker.tracks.affine.max_steps),
    number!(
        "tracking.refine_min_correlation",
        Range::closed(-1.0, 1.0),
        tracking.tracker.tracks.affine.min_correlation
    ),
    number!("tracking.corner_cell_px", Range::closed(8.0, 48.0), tracking.tracker.tracks.corners.cell_px),
    number!(
        "tracking.corner_min_distance_px",
        Range::closed(0.0, 48.0),
        tracking.tracker.tracks.corners.min_distance_px
    ),
    number!(
        "tracking.corner_min_eigenvalue",
        Range::closed(0.0, 10000.0),
        tracking.tracker.tracks.corners.min_eigenvalue
    ),
    number!("tracking.gate_min_flow_px", Range::open_closed(0.0, 500.0), tracking.tracker.gate.min_flow_px),
    number!("tracking.gate_min_survivors_ratio", Range::closed(0.0, 1.0), tracking.tracker.gate.min_survivors_ratio),
    whole!("tracking.gate_min_tracks", Range::closed(0.0, 65536.0), tracking.tracker.gate.min_tracks),
    number!("tracking.noise_px", Range::closed(0.05, 2.0), tracking.tracker.noise_px),
    number!("tracking.matched_noise_px", Range::closed(0.05, 5.0), tracking.tracker.matched_noise_px),
    number!("tracking.gric_sigma_px", Range::closed(0.1, 5.0), tracking.tracker.gric_sigma_px),
    number!("tracking.essential_inlier_px", Range::closed(0.1, 4.0), tracking.tracker.essential_inlier_px),
    whole!("tracking.max_trials", Range::closed(20.0, 5000.0), tracking.tracker.max_trials),
    number!("tracking.confidence", Range::closed_open(0.9, 1.0), tracking.tracker.confidence),
    number!("tracking.pnp_inlier_sigmas", Range::closed(2.0, 10.0), tracking.tracker.pnp_inlier_sigmas),
    whole!("tracking.min_inliers", Range::closed(6.0, 200.0), tracking.tracker.min_inliers),
    whole!("tracking.enough_inliers", Range::closed(6.0, 1000.0), tracking.tracker.enough_inliers),
    number!("tracking.min_inlier_ratio", Range::closed(0.0, 1.0), tracking.tracker.min_inlier_ratio),
    number!("tracking.min_in_front_ratio", Range::closed(0.0, 1.0), tracking.tracker.min_in_front_ratio),
    number!("tracking.standing_flow_px", Range::closed(0.05, 2.0), tracking.tracker.standing_flow_px),
    number!("tracking.first_flow_px", Range::closed(2.0, 50.0), tracking.tracker.first_flow_px),
    whole!("tracking.max_doubtful_frames", Range::closed(1.0, 100.0), tracking.tracker.max_doubtful_frames),
    whole!("tracking.min_corners", Range::closed(8.0, 500.0), tracking.tracker.min_corners),
    whole!("tracking.bundle_iterations", Range::closed(1.0, 50.0), tracking.tracker.bundle_iterations),
    number!("tracking.outlier_sigmas", Range::closed(2.0, 20.0), tracking.tracker.outlier_sigmas),
    number!("tracking.below_road_ratio", Range::closed(0.0, 1.0), tracking.tracker.below_road_ratio),
    number!("tracking.normal_adaptation", Range::closed(0.0, 1.0), tracking.tracker.normal_adaptation),
    number!("tracking.max_normal_deviation_rad", Range::closed(0.0, 0.2), tracking.tracker.max_normal_deviation_rad),
    Setting {
        key: "tracking.scale_source",
        kind: Kind::Choice {
            available: &["fused", "all", "ground_plane", "depth_network", "wheel_speed"],
            planned: &[],
            put: put_scale_source,
        },
    },
    number!("tracking.road_nearest_m", Range::closed(2.0, 60.0), tracking.tracker.road.distance_m[0]),
    number!("tracking.road_farthest_m", Range::closed(2.0, 60.0), tracking.tracker.road.distance_m[1]),
    number!("tracking.road_half_width_m", Range::closed(0.5, 6.0), tracking.tracker.road.half_width_m),
    number!("tracking.road_standing_grey", Range::closed(0.0, 50.0), tracking.tracker.road.standing_grey),
    number!("tracking.road_bend", Range::closed(0.0, 1.0), tracking.tracker.road.bend),
    number!("tracking.road_pitch_sigma_rad", Range::closed(0.001, 0.1), tracking.tracker.road.normal_sigma_rad[0]),
    number!("tracking.road_roll_sigma_rad", Range::closed(0.001, 0.1), tracking.tracker.road.normal_sigma_rad[1]),
    whole!("tracking.road_working_width_px", Range::closed(300.0, 2000.0), tracking.tracker.road.working_width_px),
    whole!("tracking.road_max_iterations", Range::closed(1.0, 30.0), tracking.tracker.road.max_iterations),
    whole!("tracking.road_min_pixels", Range::closed(50.0, 5000.0), tracking.tracker.road.min_pixels),
    number!("tracking.road_min_correlation", Range::closed(0.0, 1.0), tracking.tracker.road.min_correlation),
    number!("tracking.road_min_flow_px", Range::closed(1.0, 50.0), tracking.tracker.road.min_flow_px),
    number!("tracking.road_min_margin", Range::closed(0.0, 50.0), tracking.tracker.road.min_margin),
    number!("tracking.scale_first_sigma", Range::closed(0.1, 3.0), tracking.tracker.scale.first_sigma),
    number!("tracking.scale_drift_per_sqrt_m", Range::closed(0.0001, 0.05), tracking.tracker.scale.drift_per_sqrt_m),
    number!(
        "tracking.scale_drift_rate_sigma_per_m",
        Range::closed(0.0, 0.01),
        tracking.tracker.scale.drift_rate_sigma_per_m
    ),
    number!(
        "tracking.scale_drift_rate_change_per_m",
        Range::closed(0.0, 0.001),
        tracking.tracker.scale.drift_rate_change_per_m
    ),
    number!(
        "tracking.scale_turn_drift_per_sqrt_rad",
        Range::closed(0.0, 0.2),
        tracking.tracker.scale.turn_drift_per_sqrt_rad
    ),
    number!("tracking.scale_network_sigma", Range::closed(0.005, 0.3), tracking.tracker.scale.network_sigma),
    number!("tracking.scale_wheel_sigma", Range::closed(0.001, 0.3), tracking.tracker.scale.wheel_sigma),
    number!("tracking.scale_measurement_sigma", Range::closed(0.005, 0.3), tracking.tracker.scale.measurement_sigma),
    number!("tracking.scale_correlation_m", Range::closed(0.0, 100.0), tracking.tracker.scale.correlation_m),
    number!("tracking.scale_early_sigma", Range::closed(0.0, 1.0), tracking.tracker.scale.early_sigma),
    number!("tracking.scale_kernel_sigmas", Range::closed(1.0, 5.0), tracking.tracker.scale.kernel_sigmas),
    number!("tracking.scale_max_jump", Range::closed(1.05, 10.0), tracking.tracker.scale.max_jump),
    number!("tracking.scale_gate_sigmas", Range::closed(2.0, 10.0), tracking.tracker.scale.gate_sigmas),
    number!(
        "tracking.motion_max_turn_change_rad_per_s",
        Range::closed(0.1, 10.0),
        tracking.tracker.motion.max_turn_change_rad_per_s
    ),
    number!("tracking.motion_max_side_slip_rad", Range::closed(0.05, 1.5), tracking.tracker.motion.max_side_slip_rad),
    number!("tracking.motion_min_step_m", Range::closed(0.01, 2.0), tracking.tracker.motion.min_step_m),
    number!("tracking.motion_max_speed_m_per_s", Range::closed(1.0, 200.0), tracking.tracker.motion.max_speed_m_per_s),
    number!(
        "tracking.motion_max_acceleration_m_per_s2",
        Range::closed(1.0, 200.0),
        tracking.tracker.motion.max_acceleration_m_per_s2
    ),
    number!(
        "tracking.motion_hardest_braking_m_per_s2",
        Range::closed(1.0, 30.0),
        tracking.tracker.hardest_braking_m_per_s2
    ),
    switch!("tracking.motion_reverse_allowed", None, tracking.tracker.motion.reverse_allowed),
    switch!("mapping.enabled", None, mapping.enabled),
    Setting {
        key: "mapping.decoder",
        kind: Kind::Choice {
            available: &["direct", "learned", "shared"],
            planned: &[],
            put: |settings, word| {
                settings.mapping.mapper.learned_decoder = word != "direct";
                settings.mapping.mapper.shared_decoder = word == "shared";
            },
        },
    },
    number!("mapping.resolution", Range::closed(0.125, 1.0), mapping.mapper.resolution),
    whole!("mapping.min_width_px", Range::closed(0.0, 4096.0), mapping.mapper.min_width_px),
    whole!("mapping.window", Range::closed(1.0, 64.0), mapping.mapper.window),
    whole!("mapping.older_views", Range::closed(0.0, MAX_OLDER_VIEWS as f64), mapping.mapper.older_views),
    number!("mapping.newest_share", Range::closed(0.0, 1.0), mapping.mapper.newest_share),
    number!("mapping.older_share", Range::closed(0.0, 1.0), mapping.mapper.older_share),
    number!("mapping.min_confidence", Range::closed(0.0, 1.0), mapping.mapper.min_confidence),
    number!("mapping.page_distance_m", Range::closed(10.0, 10000.0), mapping.mapper.page_distance_m),
    number!("mapping.min_opacity", Range::closed(0.0, 1.0), mapping.mapper.min_opacity),
    number!("mapping.max_width_ratio", Range::open_closed(0.0, 1.0), mapping.mapper.max_width_ratio),
    Setting {
        key: "mapping.insertion",
        kind: Kind::Choice {
            available: &["ours", "log", "canny", "random"],
            planned: &[],
            put: |settings, word| {
                settings.mapping.mapper.insertion.operator = match word {
                    "log" => StructureOperator::LaplacianOfGaussian,
                    "canny" => StructureOperator::Canny,
                    "random" => StructureOperator::Random,
                    _ => StructureOperator::DifferenceOfGaussians,
                };
            },
        },
    },
    switch!("mapping.insertion_suppression", None, mapping.mapper.insertion.suppression),
    number!("mapping.gaussians_per_m", Range::closed(1.0, 1000000.0), mapping.mapper.gaussians_per_m),
    number!("mapping.first_view_m", Range::closed(0.0, 1000.0), mapping.mapper.first_view_m),
    number!("mapping.insertion_structure_weight", Range::closed(0.0, 1.0), mapping.mapper.insertion.structure_weight),
    number!("mapping.insertion_depth_edge_weight", Range::closed(0.0, 1.0), mapping.mapper.insertion.depth_edge_weight),
    number!(
        "mapping.insertion_samples_per_pixel",
        Range::open_closed(0.0, 0.1),
        mapping.mapper.insertion.samples_per_pixel
    ),
    number!("mapping.insertion_bare_probability", Range::closed(0.0, 1.0), mapping.mapper.insertion.bare_probability),
    number!("mapping.insertion_error_weight", Range::closed(0.0, 10.0), mapping.mapper.insertion.error_weight),
    number!(
        "mapping.insertion_sigma_per_spacing",
        Range::open_closed(0.0, 5.0),
        mapping.mapper.insertion.sigma_per_spacing
    ),
    number!("mapping.spawn_opacity", Range::open(0.0, 1.0), mapping.mapper.spawn.opacity),
    number!("mapping.spawn_max_stretch", Range::closed(1.0, 100.0), mapping.mapper.spawn.max_stretch),
    number!("mapping.spawn_flatness", Range::open_closed(0.0, 1.0), mapping.mapper.spawn.flatness),
    number!("mapping.stereo_nearest_m", Range::closed(0.5, 50.0), mapping.mapper.stereo.nearest_m),
    number!("mapping.stereo_farthest_m", Range::closed(10.0, 1000.0), mapping.mapper.stereo.farthest_m),
    number!("mapping.stereo_min_baseline_m", Range::closed(0.05, 5.0), mapping.mapper.stereo.min_baseline_m),
    switch!("mapping.exposure", None, mapping.mapper.learned_exposure),
    number!("mapping.trusted_depth_m", Range::closed(1.0, 1000.0), mapping.mapper.trusted_depth_m),
    number!("mapping.rate_log_scale", Range::closed(0.0, 1.0), mapping.mapper.step.rates.log_scale),
    number!("mapping.rate_opacity", Range::closed(0.0, 1.0), mapping.mapper.step.rates.opacity),
    number!("mapping.rate_exposure", Range::closed(0.0, 1.0), mapping.mapper.step.rates.exposure),
    number!("mapping.loss_l1", Range::closed(0.0, 100.0), mapping.mapper.step.weights.l1),
    number!("mapping.loss_ssim", Range::closed(0.0, 100.0), mapping.mapper.step.weights.ssim),
    number!("mapping.loss_depth", Range::closed(0.0, 100.0), mapping.mapper.step.weights.depth),
    number!("mapping.loss_isotropy", Range::closed(0.0, 100.0), mapping.mapper.step.weights.isotropy),
    number!("mapping.loss_exposure", Range::closed(0.0, 100.0), mapping.mapper.step.weights.exposure),
    whole!("lifecycle.stretch_keyframes", Range::closed(1.0, 10000.0), lifecycle.stretch_keyframes),
    switch!("lifecycle.densify", None, lifecycle.densify),
    number!("lifecycle.densify_px", Range::closed(0.0, 10000.0), lifecycle.densify_px),
    switch!("lifecycle.prune", None, lifecycle.prune),
    Setting {
        key: "lifecycle.score",
        kind: Kind::Choice {
            available: &["paper", "error-weighted"],
            planned: &[],
            put: |settings, word| {
                settings.lifecycle.score = if word == "paper" { PruneScore::Paper } else { PruneScore::ErrorWeighted };
            },
        },
    },
    number!("lifecycle.prune_score", Range::closed(0.0, 1.0), lifecycle.prune_score),
    number!("lifecycle.error_threshold", Range::closed(0.0, 1.0), lifecycle.error_threshold),
    whole!("lifecycle.views", Range::closed(1.0, 1000.0), lifecycle.views),
    number!("lifecycle.max_gaussians_per_m", Range::closed(1.0, 1000000.0), lifecycle.max_gaussians_per_m),
    switch!("loop_closure.enabled", None, loop_closure.enabled),
    Setting {
        key: "loop_closure.vocabulary",
        kind: Kind::Text { put: |settings, text| settings.loop_closure.vocabulary = text.into() },
    },
    whole!(
        "loop_closure.min_gap_keyframes",
        Range::closed(10.0, 1000.0),
        loop_closure.closer.recognizer.min_gap_keyframes
    ),
    whole!(
        "loop_closure.consecutive_keyframes",
        Range::closed(1.0, 20.0),
        loop_closure.closer.recognizer.n_consecutive
    ),
    whole!("loop_closure.min_inliers", Range::closed(10.0, 500.0), loop_closure.closer.verification.min_inliers),
    number!(
        "loop_closure.min_inlier_ratio",
        Range::closed(0.0, 1.0),
        loop_closure.closer.verification.min_inlier_ratio
    ),
    number!("loop_closure.min_spread", Range::closed(0.0, 0.5), loop_closure.closer.verification.min_spread),
    number!("loop_closure.max_scale", Range::closed(1.05, 10.0), loop_closure.closer.verification.max_scale),
    number!("loop_closure.max_distance_m", Range::closed(1.0, 50.0), loop_closure.closer.verification.max_distance_m),
    number!("loop_closure.max_added_sigmas", Range::closed(4.0, 20.0), loop_closure.closer.max_added_sigmas),
    whole!("loop_closure.min_keyframes_between", Range::closed(1.0, 50.0), loop_closure.closer.min_keyframes_between),
    number!("loop_closure.drift_rotation_rad", Range::closed(0.00001, 0.1), loop_closure.noise.rotation_rad),
    number!("loop_closure.drift_translation_m", Range::closed(0.0001, 1.0), loop_closure.noise.translation_m),
    number!("loop_closure.drift_log_scale", Range::closed(0.00001, 0.1), loop_closure.noise.log_scale),
    number!("loop_closure.follow_rotation_rad", Range::closed(0.0001, 0.1), loop_closure.alignment.rotation_rad),
    number!("loop_closure.follow_translation_m", Range::closed(0.001, 10.0), loop_closure.alignment.translation_m),
    number!("loop_closure.follow_log_scale", Range::closed(0.0001, 0.1), loop_closure.alignment.log_scale),
    Setting {
        key: "inference.models",
        kind: Kind::Text { put: |settings, text| settings.inference.models = text.into() },
    },
    whole!("inference.max_width_px", Range::closed(64.0, 8192.0), inference.max_width_px),
    Setting {
        key: "inference.deadline_ms",
        kind: Kind::Number {
            range: Range::closed(1.0, 60000.0),
            put: |settings, ms| settings.inference.deadline = Duration::from_secs_f64(ms / 1e3),
        },
    },
];

fn put_matcher(settings: &mut Settings, word: &str) {
    settings.tracking.matcher = match word {
        "xfeat" => Matcher::XFeat,
        "disk" => Matcher::Disk,
        _ => Matcher::Classical,
    };
}

fn put_pose_models(settings: &mut Settings, word: &str) {
    settings.tracking.tracker.pose_models = match word {
        "essential" => PoseModels::Essential,
        "pnp" => PoseModels::Pnp,
        _ => PoseModels::Both,
    };
}

fn put_scale_source(settings: &mut Settings, word: &str) {
    settings.tracking.tracker.scale_sources = match word {
        "all" => ScaleSources::ALL,
        "ground_plane" => ScaleSources::of(&[ScaleSource::GroundPlane]),
        "depth_network" => ScaleSources::of(&[ScaleSource::DepthNetwork]),
        "wheel_speed" => ScaleSources::of(&[ScaleSource::WheelSpeed]),
        _ => ScaleSources::UNTRAINED,
    };
}

fn put_dynamic_filter(settings: &mut Settings, word: &str) {
    settings.tracking.tracker.dynamic_filter = match word {
        "off" => DynamicFilter::Off,
        "paper" => DynamicFilter::Paper,
        _ => DynamicFilter::Region,
    };
}
