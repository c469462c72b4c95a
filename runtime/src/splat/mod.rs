//! The seam between the map and whatever computes its pictures and gradients.
//!
//! The map's trainable numbers live *inside* a backend, one fixed-capacity slot per anchor; the host keeps
//! what never changes by training (voxel, page, level, keyframe) and talks to the backend in whole anchors,
//! whole views and whole training steps. A backend never calls back and never allocates after construction.
//! What does not fit is left out and counted in [`Overflow`], never written out of range.

mod background;
mod capacity;
pub mod cpu;
mod stages;
pub mod device;
pub mod kernel_constants;
pub mod kernels;
pub mod layout;
pub mod program;
pub mod wgpu;
mod row_table;
mod score;
mod training;
pub mod vulkan;

pub use background::{
    BACKGROUND_COLUMNS, BACKGROUND_MAX_ELEVATION_RAD, BACKGROUND_MIN_ELEVATION_RAD, BACKGROUND_ROWS, BACKGROUND_TEXELS,
    background_texel_direction,
};
pub use capacity::{Capacities, CapacityError, MAX_GAUSSIANS_PER_ANCHOR, MemoryRow};
pub use kilogs_core::map::{AnchorFeature, AnchorHeader, DecoderShape, GaussianParams};
pub use row_table::{BYTES_PER_ROW, RowTable};
pub use score::{AnchorScore, ScoreReport};
pub use stages::{MAX_STAGES, StageClock, StageTimes};
pub use training::{
    ChunkRows, DecoderRates, DepthTarget, Exposure, LearningRate, LearningRates, LossTerms, LossWeights, PoseGradient,
    StepReport, StepSettings, TargetImage, TrainingView,
};

use kilogs_core::map::numbers;
use nalgebra::{UnitQuaternion, Vector3};

/// Similarity that takes keyframe coordinates to the map: `x_map = scale * R x_keyframe + t`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KeyframePlacement {
    /// Rotation of `map_from_keyframe`.
    pub rotation: UnitQuaternion<f64>,
    /// Translation of `map_from_keyframe`, m.
    pub translation_m: Vector3<f64>,
    /// Scale of `map_from_keyframe`; 1 until a loop closure corrects it.
    pub scale: f64,
}

impl KeyframePlacement {
    /// A keyframe that is the map's own frame.
    pub fn identity() -> Self {
        Self { rotation: UnitQuaternion::identity(), translation_m: Vector3::zeros(), scale: 1.0 }
    }
}

/// The camera that looks at the map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Camera from map.
    pub camera_from_map: kilogs_core::conventions::Rigid,
    /// Intrinsics at the size to render.
    pub camera: kilogs_core::camera::Pinhole,
    /// Chunk whose background colors the sky.
    pub chunk_row: u16,
}

impl View {
    /// Pixels of the picture.
    pub fn n_pixels(&self) -> usize {
        self.camera.width as usize * self.camera.height as usize
    }
}

/// Where a picture goes; every slice has exactly `width * height` elements, row by row from the top left.
#[derive(Debug)]
pub struct RenderTarget<'a> {
    /// Color with the background behind it.
    pub rgb: &'a mut [[f32; 3]],
    /// `sum T alpha z`, m: not divided by `1 - transmittance`; 0 where nothing was hit.
    pub depth_m: &'a mut [f32],
    /// How much of the background is seen, 0 to 1.
    pub transmittance: &'a mut [f32],
}

/// What did not fit, counted in the unit of its capacity; all zero when everything did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Overflow {
    /// Gaussians in view beyond [`Capacities::visible_gaussians`].
    pub visible_gaussians: u32,
    /// Gaussian-row entries beyond [`Capacities::row_entries`].
    pub row_entries: u32,
    /// Gaussian-tile pairs beyond [`Capacities::pairs`].
    pub pairs: u32,
}

/// How much work a view was.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RenderStats {
    /// Gaussians whose splat meets the picture.
    pub visible: u32,
    /// Entries of the lists of tile rows.
    pub row_entries: u32,
    /// Gaussian-tile pairs that were blended.
    pub pairs: u32,
    /// What did not fit.
    pub overflow: Overflow,
    /// The view itself was refused (larger than the capacities, unknown chunk row, wrong slice lengths);
    /// nothing was written.
    pub refused: bool,
}

/// One implementation of decoding, splatting and training.
///
/// Slots are `0..capacities().anchors`; the caller owns their allocation. A slot that was never written, or was
/// retired, is not drawn. Rows and slots out of range are ignored and counted in the returned number.
pub trait SplatBackend: Send {
    /// What was fixed at construction.
    fn capacities(&self) -> &Capacities;

    /// Fills slots, sets their features to 0 and restarts their optimizer moments; `params` holds `gaussians_per_anchor` elements per slot,
    /// of which the header says how many are used. Returns how many were refused (slot, keyframe row or count out
    /// of range, or a number that is not finite).
    fn write_anchors(&mut self, slots: &[u32], headers: &[AnchorHeader], params: &[GaussianParams]) -> usize;

    /// Reads slots back in the layout of [`write_anchors`](Self::write_anchors); slots out of range are left
    /// untouched and counted. A slot that is not in use reads as `n_gaussians = 0`.
    fn read_anchors(&self, slots: &[u32], headers: &mut [AnchorHeader], params: &mut [GaussianParams]) -> usize;

    /// Sets the features of filled slots and restarts their optimizer moments. Returns how many were refused (slot out
    /// of range, a number that is not finite); all of them without [`Capacities::learned_decoder`].
    fn write_features(&mut self, slots: &[u32], features: &[AnchorFeature]) -> usize;

    /// Reads features back; slots out of range are left untouched and counted, all of them without
    /// [`Capacities::learned_decoder`].
    fn read_features(&self, slots: &[u32], features: &mut [AnchorFeature]) -> usize;

    /// Frees slots. Returns how many were out of range.
    fn retire_anchors(&mut self, slots: &[u32]) -> usize;

    /// Sets `map_from_keyframe` of rows `first_row..`: anchors follow at once, nothing of them is rewritten.
    /// Returns how many were out of range.
    fn set_keyframes(&mut self, first_row: u32, placements: &[KeyframePlacement]) -> usize;

    /// Sets the background of a chunk row and restarts its optimizer moments; RGB in [0, 1], row by row from the
    /// lowest elevation, [`BACKGROUND_TEXELS`] of them. False when the row or the length is wrong.
    fn write_background(&mut self, chunk_row: u16, texels: &[[f32; 3]]) -> bool;

    /// Reads the background of a chunk row. False when the row or the length is wrong.
    fn read_background(&self, chunk_row: u16, texels: &mut [[f32; 3]]) -> bool;

    /// Sets the decoder of a chunk row, in the layout of [`kilogs_core::map::decoder`], and restarts its optimizer
    /// moments; rows that were never written add nothing. False when the row or the length is wrong, a number is not
    /// finite, or without [`Capacities::learned_decoder`].
    fn write_decoder(&mut self, chunk_row: u16, weights: &[f32]) -> bool;

    /// Reads the decoder of a chunk row. False when the row or the length is wrong, or without
    /// [`Capacities::learned_decoder`].
    fn read_decoder(&self, chunk_row: u16, weights: &mut [f32]) -> bool;

    /// Sets the exposure of a slot and restarts its optimizer moments. False when the slot is out of range.
    fn write_exposure(&mut self, slot: u32, exposure: Exposure) -> bool;

    /// Exposure of a slot, `None` when it is out of range.
    fn read_exposure(&self, slot: u32) -> Option<Exposure>;

    /// Draws the map, exposure not applied.
    fn render(&mut self, view: &View, target: RenderTarget<'_>) -> RenderStats;

    /// Draws the map, compares, and takes one optimizer step with everything in view.
    fn train_step(&mut self, view: &TrainingView<'_>, settings: &StepSettings) -> StepReport;

    /// Draws the map, compares, and says of every slot how it contributes: `scores` has one element per slot and is
    /// overwritten, those of slots that are not in view with zeros. Nothing learns, the view's exposure is applied, and
    /// `view.depth` is not looked at.
    fn score_view(&mut self, view: &TrainingView<'_>, error_threshold: f32, scores: &mut [AnchorScore]) -> ScoreReport;

    /// Time of each stage of the last [`render`](Self::render) or [`train_step`](Self::train_step); empty when the
    /// backend cannot tell.
    fn stage_times(&self) -> StageTimes {
        StageTimes::default()
    }
}
