//! Corners that are recognised again by what is around them, however they were found the first time.

use super::corners::{self, Corner, CornerSettings};
use super::lanes::{Kernel, KernelTask, SimdLevel};
use super::pattern::{PAIRS, PATCH, PATTERN, RADIUS, TURNS};
use crate::frame::pyramid::{MARGIN_PX, PaddedImage};
use crate::frame::{ImageView, Pyramid, pyramid};

/// 256 comparisons of smoothed pixels, one bit each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Descriptor(pub [u64; PAIRS / 64]);

/// A corner that can be recognised.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Feature {
    /// Where it is in the full image, px.
    pub pixel: [f32; 2],
    /// Px of the full image per px of the image that it was found in.
    pub scale: f32,
    /// Where its surroundings are brighter: cosine and sine.
    pub direction: [f32; 2],
    /// Smallest eigenvalue of the corner, squared grey values per squared pixel.
    pub min_eigenvalue: f32,
    /// What is around it.
    pub descriptor: Descriptor,
}

impl Feature {
    /// Fills storage that is still to be written.
    pub const NONE: Self = Self {
        pixel: [0.0; 2],
        scale: 1.0,
        direction: [1.0, 0.0],
        min_eigenvalue: 0.0,
        descriptor: Descriptor([0; PAIRS / 64]),
    };
}

/// Constants of [`extract`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExtractSettings {
    /// The corners, in px of each of the images that they are looked for in.
    pub corners: CornerSettings,
}

impl ExtractSettings {
    /// Corners that noise would give are let in: descriptors tell them apart.
    pub const STANDARD: Self =
        Self { corners: CornerSettings { cell_px: 20.0, min_distance_px: 4.0, min_eigenvalue: 0.5, border_px: 12.0 } };
}

/// Memory of [`extract`].
#[derive(Debug)]
pub struct ExtractScratch<'m> {
    /// At least [`half_step_bytes`].
    pub half_step: &'m mut [u8],
    /// Bounds how many corners of one size are found.
    pub corners: &'m mut [Corner],
}

/// Image sizes between those of a pyramid, so that a feature looks much the same in one of them at any distance.
const HALF_STEP: f32 = core::f32::consts::SQRT_2;
const HALF_STEP_LEVELS: usize = 2;

/// Shares of the features that are looked for at a size of 1/√2, 1/2, 1/√8 and 1/4, by the inverse side of the images.
const SHARES: [f32; 4] = [0.39, 0.28, 0.19, 0.14];

/// Bytes that [`extract`] needs for images of this size.
pub fn half_step_bytes(width: usize, height: usize) -> usize {
    let [width, height] = half_step_size(width, height);
    width * height + pyramid::bytes_needed(width, height, HALF_STEP_LEVELS)
}

fn half_step_size(width: usize, height: usize) -> [usize; 2] {
    [width, height].map(|side| (side as f32 / HALF_STEP) as usize)
}

/// Finds and describes corners in four sizes of the image, each √2 smaller than the one before.
///
/// # Output
/// The front of `features`, whose length bounds how many are found; their number.
///
/// # Cost
/// O(pixels + features); 9 KiB of stack; no allocation. Same bits on every SIMD level.
///
/// # Source
/// Rublee et al. 2011 (ORB): oriented comparisons on several sizes; corners as in [`corners::detect_everywhere`].
pub fn extract(
    simd: SimdLevel,
    image: &Pyramid<'_>,
    settings: &ExtractSettings,
    scratch: &mut ExtractScratch<'_>,
    features: &mut [Feature],
) -> usize {
    let [width, height] = half_step_size(image.width(), image.height());
    if width == 0 || height == 0 || scratch.half_step.len() < half_step_bytes(image.width(), image.height()) {
        return 0;
    }
    let (pixels, storage) = scratch.half_step.split_at_mut(width * height);
    shrink(image.image(), width, pixels);
    let Ok(mut half_step) = Pyramid::new(storage, width, height, HALF_STEP_LEVELS) else { return 0 };
    let Ok(view) = ImageView::new(pixels, width, height, width) else { return 0 };
    if half_step.build(view).is_err() {
        return 0;
    }
    let sizes = [
        (HALF_STEP, half_step.level(0)),
        (2.0, image.level(1)),
        (2.0 * HALF_STEP, half_step.level(1)),
        (4.0, image.level(2)),
    ];
    let (mut n, mut n_due) = (0, 0.0);
    for ((scale, level), share) in sizes.into_iter().zip(SHARES) {
        let Some(level) = level else { continue };
        n_due += share * features.len() as f32;
        let n_corners = ((n_due + 0.5) as usize).min(features.len()).saturating_sub(n).min(scratch.corners.len());
        let corners = &mut scratch.corners[..n_corners];
        let report = corners::detect_everywhere(simd, level.image(), &settings.corners, corners);
        n += describe(simd, &level, scale, &corners[..report.n_found], &mut features[n..]);
    }
    n
}

/// Interpolates bilinearly at every √2-nd pixel.
fn shrink(image: ImageView<'_>, width: usize, pixels: &mut [u8]) {
    const BITS: u32 = 8;
    const ONE: u32 = 1 << BITS;
    let split = |i: usize, last: usize| {
        let at = ((i as f32 + 0.5) * HALF_STEP - 0.5) * ONE as f32;
        let whole = (at as usize >> BITS).min(last.saturating_sub(1));
        (whole, (at as u32).wrapping_sub((whole as u32) << BITS).min(ONE))
    };
    for (y, out) in pixels.chunks_exact_mut(width).enumerate() {
        let (row, wy) = split(y, image.height() - 1);
        let (above, below) = (image.row(row), image.row((row + 1).min(image.height() - 1)));
        for (x, out) in out.iter_mut().enumerate() {
            let (column, wx) = split(x, image.width() - 1);
            let next = (column + 1).min(image.width() - 1);
            let blend = |row: &[u8]| (ONE - wx) * u32::from(row[column]) + wx * u32::from(row[next]);
            *out = (((ONE - wy) * blend(above) + wy * blend(below) + (ONE * ONE / 2)) >> (2 * BITS)) as u8;
        }
    }
}

/// Describes corners of one image, which is `scale` times smaller than the full one. Corners so close to the border that
/// their surroundings are not in image and margin are left out.
///
/// # Output
/// The front of `features`, in the order of `corners`; their number.
///
/// # Source
/// Calonder et al. 2010 (BRIEF) with the intensity centroid's direction (Rosin 1999, as in ORB); the pairs are drawn by
/// our own generator.
pub fn describe(
    simd: SimdLevel,
    level: &PaddedImage<'_>,
    scale: f32,
    corners: &[Corner],
    features: &mut [Feature],
) -> usize {
    let mut n = 0;
    simd.run(Describe { level, scale, corners, features, n: &mut n });
    n
}

struct Describe<'a> {
    level: &'a PaddedImage<'a>,
    scale: f32,
    corners: &'a [Corner],
    features: &'a mut [Feature],
    n: &'a mut usize,
}

impl KernelTask for Describe<'_> {
    #[inline(always)]
    fn run<K: Kernel>(self, kernel: K) {
        let Self { level, scale, corners, features, n } = self;
        let mut slots = features.iter_mut();
        for corner in corners {
            let Some(patch) = smooth(level, corner.pixel) else { continue };
            let Some(slot) = slots.next() else { break };
            let [x, y] = centroid(&patch);
            let norm = kernel.sqrt(f64::from(x * x + y * y)) as f32;
            *slot = Feature {
                pixel: corner.pixel.map(|c| c * scale),
                scale,
                direction: if norm > 0.0 { [x / norm, y / norm] } else { [1.0, 0.0] },
                min_eigenvalue: corner.min_eigenvalue,
                descriptor: compare(&patch, nearest_direction([x, y])),
            };
            *n += 1;
        }
    }
}

/// Sums of 5 x 5 px, row by row; the corner is at row and column `PATCH / 2`.
type Patch = [u16; PATCH * PATCH];

/// Side of the smoothing, px.
const SMOOTH: usize = 5;
const GROWN: usize = PATCH + SMOOTH - 1;

#[inline(always)]
fn smooth(level: &PaddedImage<'_>, pixel: [f32; 2]) -> Option<Patch> {
    const REACH: i32 = (PATCH / 2 + SMOOTH / 2) as i32;
    let [x, y] = pixel.map(|c| c as i32);
    let end = |side: usize| (side + MARGIN_PX) as i32;
    if x + REACH > end(level.width()) || y + REACH > end(level.height()) {
        return None;
    }
    let bytes = level.from_pixel(x - REACH, y - REACH)?;
    let mut sums = [[0u16; PATCH]; GROWN];
    for (r, sums) in sums.iter_mut().enumerate() {
        let row: &[u8; GROWN] = bytes.get(r * level.stride()..)?.first_chunk()?;
        for c in 0..PATCH {
            let five = [row[c], row[c + 1], row[c + 2], row[c + 3], row[c + 4]].map(u16::from);
            sums[c] = five[0] + five[1] + five[2] + five[3] + five[4];
        }
    }
    let mut patch = [0; PATCH * PATCH];
    for (r, out) in patch.chunks_exact_mut(PATCH).enumerate() {
        for c in 0..PATCH {
            out[c] = sums[r][c] + sums[r + 1][c] + sums[r + 2][c] + sums[r + 3][c] + sums[r + 4][c];
        }
    }
    Some(patch)
}

/// All bits within [`RADIUS`] of the centre of the patch.
static DISC: [[u16; PATCH]; PATCH] = {
    let mut disc = [[0; PATCH]; PATCH];
    let mut i = 0;
    while i < PATCH * PATCH {
        let (dx, dy) = ((i % PATCH) as i32 - PATCH as i32 / 2, (i / PATCH) as i32 - PATCH as i32 / 2);
        if dx * dx + dy * dy <= RADIUS * RADIUS {
            disc[i / PATCH][i % PATCH] = u16::MAX;
        }
        i += 1;
    }
    disc
};

/// First moments of the disc.
#[inline(always)]
fn centroid(patch: &Patch) -> [f32; 2] {
    let mut columns = [0i32; PATCH];
    let mut lifted = [0i32; PATCH];
    for (r, (row, disc)) in patch.chunks_exact(PATCH).zip(&DISC).enumerate() {
        let dy = r as i32 - PATCH as i32 / 2;
        for c in 0..PATCH {
            let value = i32::from(row[c] & disc[c]);
            columns[c] += value;
            lifted[c] += dy * value;
        }
    }
    let (mut x, mut y) = (0, 0);
    for c in 0..PATCH {
        x += (c as i32 - PATCH as i32 / 2) * columns[c];
        y += lifted[c];
    }
    [x as f32, y as f32]
}

#[inline(always)]
fn nearest_direction([x, y]: [f32; 2]) -> usize {
    let (mut best, mut most) = (0, f32::MIN);
    for (k, [cos, sin]) in TURNS.iter().enumerate() {
        let along = x * cos + y * sin;
        if along > most {
            (best, most) = (k, along);
        }
    }
    best
}

#[inline(always)]
fn compare(patch: &Patch, direction: usize) -> Descriptor {
    let mut words = [0u64; PAIRS / 64];
    let at = |position: u16| patch[usize::from(position) % (PATCH * PATCH)];
    for (word, pairs) in words.iter_mut().zip(PATTERN[direction].chunks_exact(64)) {
        for (bit, &[a, b]) in pairs.iter().enumerate() {
            *word |= u64::from(at(a) < at(b)) << bit;
        }
    }
    Descriptor(words)
}

#[cfg(test)]
mod tests;
