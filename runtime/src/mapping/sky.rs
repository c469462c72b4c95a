//! The sky as keyframes see it: what backgrounds are before steps learn them.

use super::images::pixel_index;
use super::insert::color_at;
use super::mapper::{CHUNK_KEYFRAMES, Mapper};
use crate::splat::{BACKGROUND_COLUMNS, BACKGROUND_ROWS, BACKGROUND_TEXELS, background_texel_direction};

/// What is known of the sky.
pub(super) struct Sky {
    /// The newest chunk that has a background.
    pub of_chunk: Option<u32>,
    /// Colors on their way into the backend or out of it, RGB in [0, 1].
    pub texels: Box<[[f32; 3]]>,
    /// Directions in which sky was seen, by texel.
    seen: Box<[bool]>,
}

impl Sky {
    /// Memory of the texels and of what is known of them.
    pub const BYTES: usize = BACKGROUND_TEXELS * (size_of::<[f32; 3]>() + size_of::<bool>());

    pub fn new() -> Self {
        Self {
            of_chunk: None,
            texels: vec![[0.0; 3]; BACKGROUND_TEXELS].into(),
            seen: vec![false; BACKGROUND_TEXELS].into(),
        }
    }
}

impl Mapper {
    /// Shows the sky that a keyframe is the first to see in its direction, as far as it was told from the rest by stereo. A new
    /// chunk goes on with the sky of the one before; the first one begins with the mean of its first keyframe's.
    pub(super) fn look_at_sky(&mut self, age: usize) {
        let Some(kept) = self.images.newest(age) else { return };
        let chunk = kept.keyframe.ordinal / CHUNK_KEYFRAMES;
        let Some(chunk_row) = self.row_of_chunk(chunk).filter(|_| self.sky.of_chunk <= Some(chunk)) else { return };
        let row_before = self.sky.of_chunk.and_then(|before| self.row_of_chunk(before));
        let (camera, inverse_depth) = (self.images.camera(), &self.scratch.inverse_depth);
        let is_sky = |index: usize| inverse_depth[index] <= 0.0;
        let color_of = |index: usize| color_at(&kept, self.images.channels(), index);
        let camera_from_world = kept.keyframe.world_from_camera.inverse();
        let sky_at = |texel: usize| {
            let direction = background_texel_direction(texel % BACKGROUND_COLUMNS, texel / BACKGROUND_COLUMNS);
            let pixel = camera.project(&(camera_from_world.rotation * direction.cast::<f64>()))?;
            pixel_index(camera, &pixel).filter(|&index| is_sky(index))
        };
        let Sky { of_chunk, texels, seen } = &mut self.sky;
        let n_new = (0..BACKGROUND_TEXELS).filter(|&texel| !seen[texel] && sky_at(texel).is_some()).count();
        if *of_chunk == Some(chunk) && n_new < MIN_NEW_TEXELS {
            return;
        }
        if !row_before.is_some_and(|row| self.backend.read_background(row, texels)) {
            let n_pixels = self.scratch.size.n_pixels();
            // Without any sky in view, the upper quarter of the image is the best guess.
            let any_sky = (0..n_pixels).any(is_sky);
            let guessed = (0..n_pixels).filter(|&index| if any_sky { is_sky(index) } else { index < n_pixels / 4 });
            texels.fill(mean(guessed.map(color_of)));
            seen.fill(false);
        }
        for (texel, (color, seen)) in texels.iter_mut().zip(seen).enumerate().filter(|(_, (_, seen))| !**seen) {
            if let Some(index) = sky_at(texel) {
                (*color, *seen) = (color_of(index), true);
            }
        }
        self.backend.write_background(chunk_row, texels);
        *of_chunk = Some(chunk);
    }
}

/// So many texels are a direction of their own: a column of the table. Writing a background restarts its optimizer moments,
/// which fewer are not worth.
const MIN_NEW_TEXELS: usize = BACKGROUND_ROWS;

fn mean(colors: impl Iterator<Item = [f32; 3]>) -> [f32; 3] {
    let (mut sum, mut n) = ([0.0f32; 3], 0u32);
    for color in colors {
        sum.iter_mut().zip(color).for_each(|(sum, value)| *sum += value);
        n += 1;
    }
    sum.map(|sum| sum / n.max(1) as f32)
}
