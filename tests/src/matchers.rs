//! The classical matchers on storage of their own.

use kilogs_core::camera::Pinhole;
use kilogs_core::correspondence::{
    DenseCapacities, DenseMatcher, DenseNode, DenseSettings, DenseStorage, DescriptorMatcher,
    DescriptorMatcherSettings, DescriptorStorage,
};
use kilogs_core::features::descriptors::half_step_bytes;
use kilogs_core::features::{Corner, Feature, FeatureMatch, Nearest, SimdLevel};

const N_FEATURES: usize = 2048;

/// Hands both matchers, for images of this camera, to `drive`.
pub fn with_matchers<R>(
    camera: &Pinhole,
    drive: impl FnOnce(&mut DescriptorMatcher<'_>, &mut DenseMatcher<'_>) -> R,
) -> R {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let capacities = DenseCapacities { width, height };
    let dense_storage = DenseStorage {
        volume: &mut vec![0; capacities.volume_bytes()],
        pooled: &mut vec![0; capacities.volume_bytes()],
        planes: &mut vec![0.0; capacities.planes()],
        nodes: &mut vec![DenseNode::NONE; capacities.nodes()],
        moved_nodes: &mut vec![DenseNode::NONE; capacities.nodes()],
    };
    let sparse_storage = DescriptorStorage {
        half_step: &mut vec![0; half_step_bytes(width, height)],
        corners: &mut vec![Corner::NONE; N_FEATURES.div_ceil(2)],
        keyframe: &mut vec![Feature::NONE; N_FEATURES],
        current: &mut vec![Feature::NONE; N_FEATURES],
        nearest: &mut vec![Nearest::NONE; 2 * N_FEATURES],
        matches: &mut vec![FeatureMatch::default(); N_FEATURES],
    };
    let simd = SimdLevel::new();
    let settings = DescriptorMatcherSettings::STANDARD;
    let sparse = DescriptorMatcher::new(simd, settings, [width, height], sparse_storage);
    let dense = DenseMatcher::new(simd, DenseSettings::STANDARD, capacities, dense_storage);
    drive(&mut sparse.expect("as large as it asks for"), &mut dense.expect("as large as it asks for"))
}
