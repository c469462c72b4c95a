//! Whether anchors are still what they were when they came from disk, whatever slots they are in.

use crate::splat::{AnchorFeature, GaussianParams};
use kilogs_core::store::StoredAnchor;
use zerocopy::IntoBytes;

/// Checksum of an anchor with the Gaussians that it uses; those of several anchors are added up.
pub(super) fn fingerprint(anchor: &StoredAnchor, feature: &AnchorFeature, gaussians: &[GaussianParams]) -> u64 {
    // Whether a feature was stored says its value.
    let anchor = StoredAnchor { feature_kind: 0, ..*anchor };
    let mut crc = crc32fast::Hasher::new();
    crc.update(anchor.as_bytes());
    crc.update(feature.as_bytes());
    crc.update(gaussians.get(..usize::from(anchor.n_gaussians)).unwrap_or_default().as_bytes());
    u64::from(crc.finalize())
}
