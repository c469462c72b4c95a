//! What is kept of a keyframe so that another view can be measured against it.

use crate::features::corners::Corner;
use crate::features::descriptors::describe;
use crate::features::{Feature, SimdLevel};
use crate::frame::Pyramid;
use crate::tracking::KeyframePoint;

/// How far a point is that can be recognized.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PointDepth {
    /// Distance along the optical axis, m.
    pub depth_m: f32,
    /// Standard deviation of the inverse depth over the inverse depth.
    pub relative_sigma: f32,
}

/// The points of a keyframe by which another view can be measured against it.
#[derive(Clone, Copy, Debug)]
pub struct PlaceView<'a> {
    /// What they look like, and where they are: the track's place, to a fraction of a pixel.
    pub features: &'a [Feature],
    /// How far each is.
    pub depths: &'a [PointDepth],
}

/// Bytes per point that is kept.
pub const BYTES_PER_PLACE_POINT: usize = size_of::<Feature>() + size_of::<PointDepth>();
const _: () = assert!(BYTES_PER_PLACE_POINT == 64);

/// Levels of the pyramid on which points are described, the one that is most often recognized first.
const LEVELS: [usize; 2] = [1, 2];

/// Describes the points of a keyframe, each in two sizes of its surroundings: a place is seen from another distance.
///
/// # Output
/// The front of `features` and of `depths`, whose length bounds how many are kept: the points of the best known depth, in the order of
/// `points`; their number.
///
/// # Cost
/// O(points²) comparisons, nothing beside the descriptions; no allocation.
pub fn describe_points(
    simd: SimdLevel,
    image: &Pyramid<'_>,
    points: &[KeyframePoint],
    features: &mut [Feature],
    depths: &mut [PointDepth],
) -> usize {
    let n_wanted = features.len().min(depths.len()) / LEVELS.len();
    let mut n = 0;
    for (i, point) in points.iter().enumerate() {
        let is_before = |(j, other): (usize, &KeyframePoint)| (other.relative_sigma, j) < (point.relative_sigma, i);
        if points.len() > n_wanted && points.iter().enumerate().filter(|&p| is_before(p)).count() >= n_wanted {
            continue;
        }
        for level in LEVELS {
            let scale = (1 << level) as f32;
            let corner = Corner { pixel: point.pixel.map(|c| c / scale), min_eigenvalue: 0.0 };
            let (Some(level), Some(slots)) = (image.level(level), features.get_mut(n..=n)) else { continue };
            if describe(simd, &level, scale, &[corner], slots) == 1 {
                slots.iter_mut().for_each(|feature| feature.pixel = point.pixel);
                let known = PointDepth { depth_m: point.depth_m, relative_sigma: point.relative_sigma };
                depths.iter_mut().skip(n).take(1).for_each(|depth| *depth = known);
                n += 1;
            }
        }
    }
    n
}
