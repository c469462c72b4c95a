//! A stored Gaussian in the coordinates of the map.

use kilogs_core::conventions::rotation_from_xyzw;
use kilogs_core::map::GaussianParams;
use kilogs_core::store::{StoredAnchor, StoredKeyframe};
use nalgebra::Vector3;

/// A Gaussian on its own.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct MapGaussian {
    /// Centre, m, map frame.
    pub(super) mean_m: [f32; 3],
    /// Natural logarithms of the standard deviations, m.
    pub(super) log_deviation: [f32; 3],
    /// Unit rotation `[x, y, z, w]` of its axes in the map frame.
    pub(super) rotation_xyzw: [f32; 4],
    /// Opacity before the logistic function.
    pub(super) opacity_logit: f32,
    /// RGB in [0, 1].
    pub(super) rgb: [f32; 3],
}

/// Takes a Gaussian from its keyframe to the map (see [`GaussianParams`] for its meaning there); `None` when it
/// has no finite place, shape or color.
pub(super) fn decode_gaussian(
    keyframe: &StoredKeyframe,
    anchor: &StoredAnchor,
    params: &GaussianParams,
) -> Option<MapGaussian> {
    let map_from_keyframe = rotation_from_xyzw(keyframe.rotation_xyzw);
    let in_keyframe_m = Vector3::from_fn(|axis, _| {
        let extent_m = f64::from(anchor.log_extent[axis]).exp();
        f64::from(anchor.position_in_keyframe_m[axis]) + f64::from(params.offset[axis]) * extent_m
    });
    let mean_m = map_from_keyframe * in_keyframe_m * keyframe.scale + Vector3::from(keyframe.translation_m);
    let log_scale = keyframe.scale.ln();
    let log_deviation = std::array::from_fn(|axis| {
        (f64::from(anchor.log_extent[axis]) + f64::from(params.log_scale[axis]) + log_scale) as f32
    });
    let keyframe_from_gaussian = params.quaternion_xyzw.map(f64::from);
    let norm2: f64 = keyframe_from_gaussian.iter().map(|value| value * value).sum();
    let rotation = map_from_keyframe * rotation_from_xyzw(keyframe_from_gaussian);
    let gaussian = MapGaussian {
        mean_m: mean_m.map(|value| value as f32).into(),
        log_deviation,
        rotation_xyzw: kilogs_core::conventions::quaternion_xyzw(&rotation).map(|value| value as f32),
        opacity_logit: params.opacity_logit,
        rgb: params.color_logit.map(logistic),
    };
    let numbers = gaussian.mean_m.iter().chain(&gaussian.log_deviation).chain(&gaussian.rotation_xyzw);
    let finite = numbers.chain(&gaussian.rgb).all(|value| value.is_finite()) && gaussian.opacity_logit.is_finite();
    (finite && norm2 > 0.0).then_some(gaussian)
}

fn logistic(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::FRAC_1_SQRT_2;

    const PARAMS: GaussianParams = GaussianParams {
        offset: [1.0, 0.0, -1.0],
        log_scale: [0.5, 0.0, 0.0],
        quaternion_xyzw: [0.0, 0.0, 0.0, 2.0],
        opacity_logit: -1.0,
        color_logit: [0.0, 100.0, -100.0],
    };
    const ANCHOR: StoredAnchor = StoredAnchor {
        position_in_keyframe_m: [1.0, 2.0, 10.0],
        keyframe_id: 0,
        log_extent: [0.0; 3],
        level: 0,
        n_gaussians: 1,
        feature_kind: 0,
    };
    // A quarter turn to the right (about y, down): forward becomes right.
    const KEYFRAME: StoredKeyframe = StoredKeyframe {
        keyframe_id: 0,
        chunk_id: 0,
        frame_index: 0,
        timestamp_ns: 0,
        rotation_xyzw: [0.0, FRAC_1_SQRT_2, 0.0, FRAC_1_SQRT_2],
        translation_m: [100.0, 0.0, 0.0],
        scale: 2.0,
        is_held_out: false,
        image_bytes: 0,
        image_crc: 0,
    };

    #[test]
    fn a_gaussian_turns_moves_and_grows_with_its_keyframe() {
        let gaussian = decode_gaussian(&KEYFRAME, &ANCHOR, &PARAMS).expect("finite");
        // In the keyframe: (2, 2, 9) m; turned: (9, 2, -2); doubled and moved.
        let expected = [118.0, 4.0, -4.0];
        let close = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-4);
        assert!(close(&gaussian.mean_m, &expected), "{gaussian:?}");
        let ln2 = std::f32::consts::LN_2;
        assert!(close(&gaussian.log_deviation, &[0.5 + ln2, ln2, ln2]), "{gaussian:?}");
        let half = std::f32::consts::FRAC_1_SQRT_2;
        assert!(close(&gaussian.rotation_xyzw, &[0.0, half, 0.0, half]), "{gaussian:?}");
        assert!(close(&gaussian.rgb, &[0.5, 1.0, 0.0]), "{gaussian:?}");
    }

    #[test]
    fn what_cannot_be_shown_is_left_out() {
        for params in [
            GaussianParams { quaternion_xyzw: [0.0; 4], ..PARAMS },
            GaussianParams { opacity_logit: f32::NAN, ..PARAMS },
            GaussianParams { offset: [f32::INFINITY, 0.0, 0.0], ..PARAMS },
            GaussianParams { color_logit: [f32::NAN; 3], ..PARAMS },
        ] {
            assert_eq!(decode_gaussian(&KEYFRAME, &ANCHOR, &params), None, "{params:?}");
        }
    }
}
