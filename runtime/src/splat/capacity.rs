//! How large a backend is: fixed before it starts.

use super::kernel_constants::MAX_IMAGE_SIDE_PX;
use super::{TrainingView, View};

/// Sizes fixed at construction; a backend's memory follows from them alone.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Capacities {
    /// Anchor slots.
    pub anchors: usize,
    /// Gaussians per anchor slot, at most 32.
    pub gaussians_per_anchor: usize,
    /// Gaussians that one view can hold.
    pub visible_gaussians: usize,
    /// Entries of all lists "Gaussians that meet this row of tiles"; about 2 per visible Gaussian.
    pub row_entries: usize,
    /// Gaussian-tile pairs of one view; about 3 to 6 per visible Gaussian.
    pub pairs: usize,
    /// Widest picture, px.
    pub image_width_px: u32,
    /// Highest picture, px.
    pub image_height_px: u32,
    /// Pixels of the largest picture that is trained with; may be less than the largest one rendered.
    pub training_pixels: usize,
    /// Rows of the keyframe table.
    pub keyframe_rows: usize,
    /// Rows of the chunk table.
    pub chunk_rows: usize,
    /// Exposure slots.
    pub exposure_slots: usize,
    /// Anchors have features and chunks have decoders; otherwise neither takes memory and the stored numbers are drawn.
    pub learned_decoder: bool,
}

/// Most Gaussians an anchor can have: their visibility is one 32-bit word.
pub const MAX_GAUSSIANS_PER_ANCHOR: usize = 32;

impl Capacities {
    /// Capacities for a picture size and a number of anchors, with the usual ratios between the lists.
    pub fn for_map(anchors: usize, gaussians_per_anchor: usize, width_px: u32, height_px: u32) -> Self {
        let visible_gaussians = anchors * gaussians_per_anchor;
        Self {
            anchors,
            gaussians_per_anchor,
            visible_gaussians,
            row_entries: visible_gaussians * 3,
            pairs: visible_gaussians * 8,
            image_width_px: width_px,
            image_height_px: height_px,
            training_pixels: width_px as usize * height_px as usize,
            keyframe_rows: 1,
            chunk_rows: 1,
            exposure_slots: 1,
            learned_decoder: false,
        }
    }

    /// The same capacities when they are possible.
    ///
    /// # Errors
    /// [`CapacityError`] names the first field that is zero or too large, and its bound.
    pub fn checked(self) -> Result<Self, CapacityError> {
        let index_bound = u32::MAX as usize / 2;
        let rows: [(&'static str, usize, usize); 11] = [
            ("anchors", self.anchors, index_bound / MAX_GAUSSIANS_PER_ANCHOR),
            ("gaussians_per_anchor", self.gaussians_per_anchor, MAX_GAUSSIANS_PER_ANCHOR),
            ("visible_gaussians", self.visible_gaussians, index_bound),
            ("row_entries", self.row_entries, index_bound),
            ("pairs", self.pairs, index_bound),
            ("image_width_px", self.image_width_px as usize, MAX_IMAGE_SIDE_PX as usize),
            ("image_height_px", self.image_height_px as usize, MAX_IMAGE_SIDE_PX as usize),
            ("training_pixels", self.training_pixels, index_bound),
            ("keyframe_rows", self.keyframe_rows, index_bound),
            ("chunk_rows", self.chunk_rows, u16::MAX as usize),
            ("exposure_slots", self.exposure_slots, index_bound),
        ];
        match rows.into_iter().find(|&(_, value, bound)| value == 0 || value > bound) {
            Some((field, value, bound)) => Err(CapacityError { field, value, bound }),
            None => Ok(self),
        }
    }

    /// Whether a view is within the capacities and its numbers are usable.
    pub fn fits(&self, view: &View) -> bool {
        let camera = &view.camera;
        let numbers = [camera.fx, camera.fy, camera.cx, camera.cy];
        (1..=self.image_width_px).contains(&camera.width)
            && (1..=self.image_height_px).contains(&camera.height)
            && usize::from(view.chunk_row) < self.chunk_rows
            && numbers.iter().all(|v| v.is_finite())
            && camera.fx > 0.0
            && camera.fy > 0.0
            && view.camera_from_map.translation.vector.iter().all(|v| v.is_finite())
            && view.camera_from_map.rotation.coords.iter().all(|v| v.is_finite())
    }

    /// Whether a training view is within the capacities and all its parts have its size.
    pub fn fits_training(&self, training: &TrainingView<'_>) -> bool {
        let n_pixels = training.view.n_pixels();
        self.fits(&training.view)
            && n_pixels <= self.training_pixels
            && training.target.n_pixels() == n_pixels
            && training.depth.is_none_or(|d| d.depth_m.len() == n_pixels && d.confidence.len() == n_pixels)
            && training.exposure_slot.is_none_or(|slot| (slot as usize) < self.exposure_slots)
    }
}

/// A capacity that no backend can have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("splat capacity {field} = {value} is not in 1..={bound}: change it in memory_budget.toml")]
pub struct CapacityError {
    /// Name of the field of [`Capacities`].
    pub field: &'static str,
    /// What was asked for.
    pub value: usize,
    /// Largest possible value.
    pub bound: usize,
}

/// One line of a backend's memory plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemoryRow {
    /// What the memory is for, as a budget row (`splat.anchors`).
    pub name: &'static str,
    /// How many elements.
    pub elements: usize,
    /// Bytes per element.
    pub bytes_per_element: usize,
}

impl MemoryRow {
    /// Bytes of the whole row.
    pub fn bytes(&self) -> usize {
        self.elements * self.bytes_per_element
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(change: impl FnOnce(&mut Capacities)) -> Option<&'static str> {
        let mut capacities = Capacities::for_map(8, 4, 64, 48);
        change(&mut capacities);
        capacities.checked().err().map(|e| e.field)
    }

    #[test]
    fn impossible_capacities_are_refused_by_name() {
        assert_eq!(refused(|_| ()), None);
        assert_eq!(refused(|c| c.anchors = 0), Some("anchors"));
        assert_eq!(refused(|c| c.gaussians_per_anchor = 33), Some("gaussians_per_anchor"));
        assert_eq!(refused(|c| c.image_width_px = 5000), Some("image_width_px"));
        assert_eq!(refused(|c| c.chunk_rows = 70_000), Some("chunk_rows"));
    }

    #[test]
    fn the_message_says_where_to_change_it() {
        let error = CapacityError { field: "pairs", value: 0, bound: 9 };
        assert_eq!(error.to_string(), "splat capacity pairs = 0 is not in 1..=9: change it in memory_budget.toml");
    }
}
