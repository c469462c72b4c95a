//! Plane sweep: how well each depth of each pixel agrees with the earlier keyframes.

use super::census::CENSUS_BITS;
use crate::camera::Pinhole;
use crate::conventions::Rigid;
use crate::map::insertion::MapImageSize;
use nalgebra::{Matrix3, Vector3};

/// Depths that are tried per pixel.
pub const N_LABELS: usize = 96;

/// Inverse depth of each label, 1/m: the first is infinity, the last the nearest surface.
///
/// A camera that moved forward by b sees a point at radius r move to r / (1 + b w); equal steps of that
/// factor are equal steps in pixels.
pub fn label_inverse_depths(baseline_m: f64, max_inverse_depth: f64) -> [f32; N_LABELS] {
    let smallest_factor = 1.0 / (1.0 + baseline_m * max_inverse_depth);
    let mut labels = [0.0; N_LABELS];
    for (label, inverse_depth) in labels.iter_mut().enumerate() {
        let factor = 1.0 + (smallest_factor - 1.0) * label as f64 / (N_LABELS - 1) as f64;
        *inverse_depth = ((1.0 / factor - 1.0) / baseline_m) as f32;
    }
    labels
}

/// One earlier keyframe, described and placed.
#[derive(Debug, Clone, Copy)]
pub struct SweepSource<'a> {
    /// Census descriptors, row by row.
    pub census: &'a [u64],
    /// `K R K^-1`: where infinitely far pixels go.
    pub at_infinity: Matrix3<f32>,
    /// `K t`: where they move per inverse metre.
    pub per_inverse_depth: Vector3<f32>,
}

impl<'a> SweepSource<'a> {
    /// Places a described keyframe against the one that asks.
    pub fn new(census: &'a [u64], camera: &Pinhole, source_from_reference: &Rigid) -> Self {
        let k = Matrix3::new(camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0);
        let k_inverse = Matrix3::new(
            1.0 / camera.fx,
            0.0,
            -camera.cx / camera.fx,
            0.0,
            1.0 / camera.fy,
            -camera.cy / camera.fy,
            0.0,
            0.0,
            1.0,
        );
        let rotation = source_from_reference.rotation.to_rotation_matrix();
        Self {
            census,
            at_infinity: (k * rotation.matrix() * k_inverse).cast(),
            per_inverse_depth: (k * source_from_reference.translation.vector).cast(),
        }
    }
}

/// Cost where no earlier keyframe sees the point: that of a mediocre agreement.
pub const UNSEEN_COST: u8 = 14;

/// Writes the cost of every label of every pixel, pixel by pixel: the mean of the two best Hamming distances.
///
/// The two best, not all: a point that one keyframe sees hidden behind a car is still seen by the others.
///
/// # Source
/// Collins 1996, "A space-sweep approach to true multi-image matching"; best-half selection after Kang,
/// Szeliski & Chai 2001.
pub fn sweep(
    reference_census: &[u64],
    sources: &[SweepSource<'_>],
    size: MapImageSize,
    labels: &[f32; N_LABELS],
    cost: &mut [u8],
) {
    for (index, (target, &descriptor)) in cost.chunks_exact_mut(N_LABELS).zip(reference_census).enumerate() {
        let pixel = Vector3::new((index % size.width) as f32 + 0.5, (index / size.width) as f32 + 0.5, 1.0);
        let mut best = [[u8::MAX; 2]; N_LABELS];
        for source in sources {
            let far = source.at_infinity * pixel;
            for (two_best, &inverse_depth) in best.iter_mut().zip(labels) {
                let seen = far + source.per_inverse_depth * inverse_depth;
                let scale = 1.0 / seen.z;
                let (x, y) = (seen.x * scale, seen.y * scale);
                let inside = seen.z > 0.0 && x >= 0.0 && y >= 0.0 && x < size.width as f32 && y < size.height as f32;
                let at = if inside { y as usize * size.width + x as usize } else { usize::MAX };
                let Some(found) = source.census.get(at) else { continue };
                let distance = (descriptor ^ found).count_ones() as u8;
                if distance < two_best[0] {
                    *two_best = [distance, two_best[0]];
                } else if distance < two_best[1] {
                    two_best[1] = distance;
                }
            }
        }
        for (value, two_best) in target.iter_mut().zip(&best) {
            *value = match *two_best {
                [u8::MAX, _] => UNSEEN_COST,
                [only, u8::MAX] => only,
                [first, second] => (first + second) / 2,
            };
        }
    }
}

const _: () = assert!(2 * CENSUS_BITS < u8::MAX as u32, "two distances are added in eight bits");

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conventions::Rigid;

    const CAMERA: Pinhole = Pinhole { width: 64, height: 8, fx: 40.0, fy: 40.0, cx: 32.0, cy: 4.0 };
    const SIZE: MapImageSize = MapImageSize { width: 64, height: 8 };

    #[test]
    fn labels_run_from_infinity_to_the_nearest_surface_in_growing_steps() {
        let labels = label_inverse_depths(5.0, 0.25);
        assert_eq!(labels[0], 0.0);
        assert!((labels[N_LABELS - 1] - 0.25).abs() < 1e-6);
        assert!(labels.windows(3).all(|w| w[2] - w[1] > w[1] - w[0] && w[1] > w[0]));
    }

    #[test]
    fn a_sideways_step_shows_every_pixel_at_its_depth() {
        // The other camera stood 1 m to the left: a point at 10 m is seen 4 px farther right.
        let reference: std::vec::Vec<u64> = (0..512u64).map(|i| i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 16).collect();
        let mut source = reference.clone();
        source.copy_within(0..508, 4);
        let source_from_reference = Rigid::translation(1.0, 0.0, 0.0);
        let sources = [SweepSource::new(&source, &CAMERA, &source_from_reference)];
        let labels = label_inverse_depths(1.0, 0.5);
        let mut cost = std::vec![0; 512 * N_LABELS];
        sweep(&reference, &sources, SIZE, &labels, &mut cost);
        let at = 3 * 64 + 20;
        let costs = &cost[at * N_LABELS..(at + 1) * N_LABELS];
        for (&label, &cost) in labels.iter().zip(costs) {
            assert_eq!(cost == 0, (3.5..4.5).contains(&(40.0 * label)), "inverse depth {label}: {cost}");
        }
        let right_edge = &cost[(3 * 64 + 63) * N_LABELS..][..N_LABELS];
        assert_eq!(right_edge[N_LABELS - 1], UNSEEN_COST, "moved out of the picture");
    }
}
