//! Where new Gaussians are worth their memory: structure of the camera image that the rendered map lacks.

mod structure;

use crate::math::Rng;
pub use structure::{StructureOperator, find_structure};

/// What decides how many samples a keyframe asks for, and where.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InsertionSettings {
    /// What counts as structure.
    pub operator: StructureOperator,
    /// Only the pixels that no neighbour exceeds are candidates.
    pub suppression: bool,
    /// Standard deviations of the two Gaussians of the difference, px at mapping resolution; (0, 4], ascending.
    /// The paper does not publish its own.
    pub sigmas_px: [f32; 2],
    /// Weight of the difference of Gaussians in the probability, [0, 1]. Paper, section 3.3.1.
    pub structure_weight: f32,
    /// Weight of the normalised depth gradient, [0, 1]. Paper, section 3.3.1.
    pub depth_edge_weight: f32,
    /// Samples that an image seen for the first time asks for, as a share of its pixels; (0, 0.1].
    pub samples_per_pixel: f32,
    /// Probability of a pixel through which the background shows wholly, so that flat surfaces are covered; [0, 1].
    pub bare_probability: f32,
    /// Nothing but what the background shows through: what covers the rest is right.
    pub only_bare: bool,
    /// Weight of the difference of brightness between picture and map, at least 0. Ours: a moved or repainted
    /// surface has the structure it should have, in the wrong place.
    pub error_weight: f32,
    /// Standard deviation of a new Gaussian relative to the spacing of the samples, above 0.
    pub sigma_per_spacing: f32,
}

impl InsertionSettings {
    /// The values that the shipped maps were measured with.
    pub const MEASURED: Self = Self {
        operator: StructureOperator::DifferenceOfGaussians,
        suppression: true,
        sigmas_px: [1.0, 1.6],
        structure_weight: 0.9,
        depth_edge_weight: 0.1,
        samples_per_pixel: 0.01,
        bare_probability: 0.4,
        only_bare: false,
        error_weight: 1.0,
        sigma_per_spacing: 0.5,
    };
}

/// Size of the images of one insertion, px.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MapImageSize {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

impl MapImageSize {
    /// Number of pixels.
    pub fn n_pixels(self) -> usize {
        self.width * self.height
    }
}

/// Writes the min-max normalised gradient of the logarithmic depth; pixels without depth (zero) have none.
///
/// Logarithmic, because the error of a depth grows with the depth: a gradient in metres would see nothing
/// but the noise of the farthest surfaces.
pub fn depth_edges(inverse_depth: &[f32], size: MapImageSize, edges: &mut [f32]) {
    let MapImageSize { width, height } = size;
    let at = |x: usize, y: usize| inverse_depth.get(y * width + x).copied().unwrap_or(0.0);
    let relative = |from: f32, to: f32, middle: f32| {
        let usable = from > 0.0 && to > 0.0 && middle > 0.0;
        if usable { 0.5 * (to - from) / middle } else { 0.0 }
    };
    let mut largest = 0.0f32;
    for (y, row) in edges.chunks_exact_mut(width).enumerate().take(height) {
        for (x, edge) in row.iter_mut().enumerate() {
            let along_x = relative(at(x.saturating_sub(1), y), at((x + 1).min(width - 1), y), at(x, y));
            let along_y = relative(at(x, y.saturating_sub(1)), at(x, (y + 1).min(height - 1)), at(x, y));
            *edge = libm::sqrtf(along_x * along_x + along_y * along_y).min(1.0);
            largest = largest.max(*edge);
        }
    }
    if largest > 0.0 {
        edges.iter_mut().for_each(|edge| *edge /= largest);
    }
}

/// `P = min(structure_weight * gain * DoG + depth_edge_weight * |grad D|, 1)`, the paper's eq. for insertion.
fn probability(settings: &InsertionSettings, gain: f32, structure: f32, depth_edge: f32) -> f32 {
    (settings.structure_weight * (gain * structure).min(1.0) + settings.depth_edge_weight * depth_edge).min(1.0)
}

/// What the camera and the rendered map show at mapping resolution, one value per pixel each.
#[derive(Debug, Clone, Copy)]
pub struct InsertionImages<'a> {
    /// Size of all of them.
    pub size: MapImageSize,
    /// [`find_structure`] of the camera image.
    pub structure: &'a [f32],
    /// [`depth_edges`] of the depth source.
    pub depth_edges: &'a [f32],
    /// [`find_structure`] of the rendered image.
    pub rendered_structure: &'a [f32],
    /// [`depth_edges`] of the rendered depth.
    pub rendered_depth_edges: &'a [f32],
    /// Share of the background that the rendered map lets through, [0, 1].
    pub transmittance: &'a [f32],
    /// Absolute difference of brightness between camera and rendered image, [0, 1].
    pub error: &'a [f32],
    /// Confidence of the depth, [0, 1]; pixels at zero are never sampled.
    pub confidence: &'a [f32],
}

/// A pixel that asks for a Gaussian.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct InsertionSample {
    /// Column.
    pub x: u16,
    /// Row.
    pub y: u16,
    /// Standard deviation that covers the gap to the neighbouring samples, px.
    pub sigma_px: f32,
}

/// Steps of the bisection for the gain; 2^-20 of the search interval.
const GAIN_STEPS: usize = 20;
/// Largest gain that is tried: a difference of a thousandth of the brightness already counts as structure.
const MAX_GAIN: f32 = 1000.0;

/// Gain at which the camera image alone asks for `samples_per_pixel`.
///
/// `kept` is scratch, one flag per pixel. The sum over the local maxima grows with the gain, so bisection finds it.
fn calibrate_gain(images: &InsertionImages<'_>, settings: &InsertionSettings, kept: &[u8]) -> f32 {
    let wanted = settings.samples_per_pixel * images.size.n_pixels() as f32;
    let (mut low, mut high) = (0.0f32, MAX_GAIN);
    for _ in 0..GAIN_STEPS {
        let gain = 0.5 * (low + high);
        let expected: f32 = images
            .structure
            .iter()
            .zip(images.depth_edges)
            .zip(kept)
            .filter(|(_, kept)| **kept != 0)
            .map(|((&structure, &edge), _)| probability(settings, gain, structure, edge))
            .sum();
        if expected < wanted {
            low = gain;
        } else {
            high = gain;
        }
    }
    high
}

/// Memory of [`sample`], one value per pixel each.
#[derive(Debug)]
pub struct SamplingScratch<'m> {
    /// Probability of each pixel.
    pub probability: &'m mut [f32],
    /// Local maxima of the camera's structure.
    pub kept: &'m mut [u8],
}

/// What an insertion asked for.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Sampled {
    /// Samples written.
    pub n_samples: usize,
    /// Samples that found no room in the output.
    pub n_refused: usize,
    /// Gain at which the image alone asks for the configured number of samples.
    pub gain: f32,
}

/// Chooses the pixels that get a Gaussian: `P_kf = max(P - P_rendered, 0)` plus what shows through and what is wrong,
/// thinned to the maxima of 3x3 neighbourhoods, and scaled down to about `most_samples` where it asks for more.
///
/// What a pixel asks for beyond what it gets is passed on to its neighbours (error diffusion), so that samples are as
/// evenly spaced as their density allows. They come out in scan order; those beyond `samples.len()` are refused and
/// counted.
///
/// # Source
/// The paper, section 3.3.1; Floyd & Steinberg 1976 in place of independent draws, the terms for bare and wrong pixels
/// and the calibration of the gain are ours.
pub fn sample(
    images: &InsertionImages<'_>,
    settings: &InsertionSettings,
    most_samples: f32,
    rng: &mut Rng,
    scratch: SamplingScratch<'_>,
    samples: &mut [InsertionSample],
) -> Sampled {
    let SamplingScratch { probability: wanted, kept } = scratch;
    // A jitter far below any probability that matters breaks the ties of flat regions evenly.
    const TIE_BREAK: f32 = 1e-4;
    for (value, &structure) in wanted.iter_mut().zip(images.structure) {
        *value = structure + TIE_BREAK * rng.unit_f32();
    }
    if settings.suppression {
        mark_maxima(wanted, images.size, kept);
    } else {
        kept.fill(1);
    }
    let gain = calibrate_gain(images, settings, kept);
    let mut demand = 0.0f32;
    for (index, (value, &kept)) in wanted.iter_mut().zip(&*kept).enumerate() {
        let at = |image: &[f32]| image.get(index).copied().unwrap_or(0.0);
        let seen = probability(settings, gain, at(images.structure), at(images.depth_edges));
        let rendered = probability(settings, gain, at(images.rendered_structure), at(images.rendered_depth_edges));
        let bare = settings.bare_probability * at(images.transmittance);
        let wrong = settings.error_weight * at(images.error);
        let is_candidate = kept != 0 && at(images.confidence) > 0.0;
        // At random, every pixel asks for all that it can get.
        let asked = match settings.operator {
            _ if settings.only_bare => bare,
            StructureOperator::Random => 1.0,
            _ => ((seen - rendered).max(0.0) + bare + wrong).min(1.0),
        };
        *value = if is_candidate { asked } else { 0.0 };
        demand += *value;
    }
    let share = if demand > most_samples { most_samples.max(0.0) / demand } else { 1.0 };
    wanted.iter_mut().for_each(|value| *value *= share);
    let mut drawn = Sampled { gain, ..Sampled::default() };
    for index in 0..images.size.n_pixels() {
        let is_candidate = kept.get(index).is_some_and(|kept| *kept != 0);
        if !diffuse(wanted, images, is_candidate, rng, index) {
            continue;
        }
        let (x, y) = (index % images.size.width, index / images.size.width);
        let sigma_px = covering_sigma_px(images, settings, (gain, share), kept, (x, y));
        match samples.get_mut(drawn.n_samples) {
            Some(slot) => {
                *slot = InsertionSample { x: x as u16, y: y as u16, sigma_px };
                drawn.n_samples += 1;
            }
            None => drawn.n_refused += 1,
        }
    }
    drawn
}

/// Whether a pixel is chosen; the difference to what it asks for goes to the neighbours that come later and have depth.
fn diffuse(wanted: &mut [f32], images: &InsertionImages<'_>, is_candidate: bool, rng: &mut Rng, index: usize) -> bool {
    let MapImageSize { width, height } = images.size;
    let has_depth = |index: usize| images.confidence.get(index).is_some_and(|sure| *sure > 0.0);
    // Around one half; a fixed threshold draws lines where little is asked for.
    let threshold = 0.25 + 0.5 * rng.unit_f32();
    let asked = wanted.get(index).copied().unwrap_or(0.0);
    let is_chosen = is_candidate && has_depth(index) && asked >= threshold;
    let rest = if is_chosen { asked - 1.0 } else { asked };
    let (x, y) = (index % width, index / width);
    let neighbours = [(1, 0, 7.0), (-1, 1, 3.0), (0, 1, 5.0), (1, 1, 1.0)].map(|(dx, dy, sixteenths)| {
        let column = x.checked_add_signed(dx).filter(|&column| column < width && y + dy < height);
        (column.map(|column| (y + dy) * width + column).filter(|&at| has_depth(at)), sixteenths)
    });
    // What a neighbour cannot take goes to the others.
    let taken: f32 = neighbours.iter().filter(|(at, _)| at.is_some()).map(|(_, sixteenths)| sixteenths).sum();
    for (at, sixteenths) in neighbours {
        if let Some(value) = at.and_then(|at| wanted.get_mut(at)) {
            *value += rest * sixteenths / taken;
        }
    }
    is_chosen
}

/// Marks the pixels that no pixel of their 3x3 neighbourhood exceeds.
fn mark_maxima(values: &[f32], size: MapImageSize, kept: &mut [u8]) {
    let MapImageSize { width, height } = size;
    for y in 0..height {
        for x in 0..width {
            let at = |x: usize, y: usize| values.get(y * width + x).copied().unwrap_or(f32::NEG_INFINITY);
            let value = at(x, y);
            let is_maximum = (y.saturating_sub(1)..(y + 2).min(height))
                .all(|v| (x.saturating_sub(1)..(x + 2).min(width)).all(|u| at(u, v) <= value));
            if let Some(flag) = kept.get_mut(y * width + x) {
                *flag = u8::from(is_maximum);
            }
        }
    }
}

/// Half side of the window in which the density of samples is counted, px.
const DENSITY_RADIUS_PX: usize = 6;
/// `1 / sqrt(density)` times a constant: the density is what the camera image asks for around the pixel, as if
/// the map were empty, so that a late refinement of a covered surface is as fine as its texture, and a bare surface is
/// covered by the few samples that it gets.
fn covering_sigma_px(
    images: &InsertionImages<'_>,
    settings: &InsertionSettings,
    (gain, share): (f32, f32),
    kept: &[u8],
    (x, y): (usize, usize),
) -> f32 {
    let MapImageSize { width, height } = images.size;
    let (mut expected, mut n_pixels) = (0.0f32, 0usize);
    for v in y.saturating_sub(DENSITY_RADIUS_PX)..(y + DENSITY_RADIUS_PX + 1).min(height) {
        for u in x.saturating_sub(DENSITY_RADIUS_PX)..(x + DENSITY_RADIUS_PX + 1).min(width) {
            let index = v * width + u;
            n_pixels += 1;
            if kept.get(index).copied().unwrap_or(0) != 0 {
                let at = |image: &[f32]| image.get(index).copied().unwrap_or(0.0);
                let seen = probability(settings, gain, at(images.structure), at(images.depth_edges));
                // What is bare gets that share of what it asks for; what is covered already is as dense as it asks for.
                let granted = 1.0 - at(images.transmittance) * (1.0 - share);
                expected += (seen + settings.bare_probability).min(1.0) * granted;
            }
        }
    }
    settings.sigma_per_spacing * libm::sqrtf(n_pixels as f32 / expected.max(1.0))
}

#[cfg(test)]
mod tests;
