//! Owns the memory of the depth sources and picks the one that can tell.

use super::settings::MapperSettings;
use kilogs_core::camera::Pinhole;
use kilogs_core::map::depth::motion_stereo::{self, MAX_SOURCES, StereoMemory};
use kilogs_core::map::depth::sweep::N_LABELS;
use kilogs_core::map::depth::{DepthImage, DepthRequest, aggregate, sparse};

/// Something that knows how far away the surfaces of a keyframe are.
pub trait DepthSource {
    /// Writes inverse depth and confidence of every pixel; false when it cannot tell anything, and nothing of `out`
    /// may be used.
    fn estimate(&mut self, request: &DepthRequest<'_>, settings: &MapperSettings, out: DepthImage<'_>) -> bool;
}

/// Triangulated points and the road: always tells something.
#[derive(Debug)]
pub struct SparseDepth;

impl DepthSource for SparseDepth {
    fn estimate(&mut self, request: &DepthRequest<'_>, settings: &MapperSettings, out: DepthImage<'_>) -> bool {
        sparse::estimate(request, &settings.sparse, out);
        true
    }
}

/// Motion stereo with its memory.
#[derive(Debug)]
pub struct MotionStereo {
    luma: Box<[u8]>,
    source_luma: Box<[u8]>,
    census: Box<[u64]>,
    source_census: Box<[u64]>,
    cost: Box<[u8]>,
    total: Box<[u16]>,
    paths: Box<[u16]>,
    inverse_depth: Box<[f32]>,
    confidence: Box<[f32]>,
    filtered: Box<[f32]>,
}

impl MotionStereo {
    /// Memory for images of the mapping camera's size.
    pub fn new(camera: &Pinhole) -> Self {
        let half_width = camera.width as usize / 2;
        let n = half_width * (camera.height as usize / 2);
        Self {
            luma: vec![0; n].into(),
            source_luma: vec![0; n].into(),
            census: vec![0; n].into(),
            source_census: vec![0; n * MAX_SOURCES].into(),
            cost: vec![0; n * N_LABELS].into(),
            total: vec![0; n * N_LABELS].into(),
            paths: vec![0; aggregate::scratch_len(half_width)].into(),
            inverse_depth: vec![0.0; n].into(),
            confidence: vec![0.0; n].into(),
            filtered: vec![0.0; n].into(),
        }
    }
}

impl DepthSource for MotionStereo {
    fn estimate(&mut self, request: &DepthRequest<'_>, settings: &MapperSettings, out: DepthImage<'_>) -> bool {
        let memory = StereoMemory {
            luma: &mut self.luma,
            source_luma: &mut self.source_luma,
            census: &mut self.census,
            source_census: &mut self.source_census,
            cost: &mut self.cost,
            total: &mut self.total,
            paths: &mut self.paths,
            inverse_depth: &mut self.inverse_depth,
            confidence: &mut self.confidence,
            filtered: &mut self.filtered,
        };
        motion_stereo::estimate(request, &settings.stereo, memory, out).n_sources > 0
    }
}
