//! Which parts of the strip show the road: every tile votes for the height at which its two images agree.

use super::ground_plane::{RoadPair, RoadProblem};
use super::strip::Strip;
use crate::features::SimdLevel;
use crate::features::doubles::{Doubles, FOUR, all_of, blend};
use crate::features::lanes::{Kernel, KernelTask};
use crate::frame::ImageView;
use nalgebra::{Matrix3, Vector3};

/// Width and height of a tile in pixels of the voting level.
const TILE_PX: [usize; 2] = [16, 6];
/// Most tiles beside each other and one below the other; what a larger strip has more does not vote.
const MAX_TILES: [usize; 2] = [80, 40];
/// Ratio of neighbouring heights.
const FACTOR: f64 = 1.04;
/// Most heights that are tried.
const MAX_HEIGHTS: usize = 128;
/// A tile whose grey values have a smaller standard deviation shows nothing.
const MIN_TEXTURE_GREY: f64 = 2.0;
/// Standard deviation of a difference that is never undercut: camera noise in two images, and interpolation.
const NOISE_GREY: f64 = 1.5;
/// Neighbouring pixels share noise: one in this many counts as independent.
const PIXELS_PER_INDEPENDENT: f64 = 16.0;
/// Share of the tiles that may show anything but the road.
const STRANGE_SHARE: f64 = 0.5;
/// A tile dissents when its own best height is likelier than the elected one by more than this logarithm.
const MAX_EXCESS: f64 = 4.0;
/// Heights that are at most this far from the elected one are the same opinion.
const SAME_OPINION: usize = 3;
/// Heights this much beyond the possible ones are tried, too, so that what fits there best does not vote for the last
/// possible one.
const MARGIN: f64 = 1.25;
/// Share of the tiles that agree from which on the lane is clear.
const CLEAR_SHARE: f64 = 0.7;
const NO_VOTE: f32 = f32::INFINITY;

/// What the tiles elected.
pub(super) struct Election {
    /// Height over the height expected.
    pub(super) height_ratio: f64,
    /// Logarithm of how much likelier it is than the best height of another opinion.
    pub(super) margin: f64,
    /// Tiles with texture, and those of them that agree.
    pub(super) n_votes: usize,
    pub(super) n_agreeing: usize,
    pub(super) mask: RoadMask,
}

/// Which part of the strip is to be aligned, to be asked for by rays.
///
/// Where most tiles agree, that is everything but the tiles that dissent, because faint texture counts. Where something
/// hides the road, it is only the tiles that show it.
pub(super) struct RoadMask {
    /// Tiles that are left out.
    rows: [u128; MAX_TILES[1]],
    first_row_z1: f64,
    left_z1: f64,
    /// Size of a tile on the plane z = 1.
    size_z1: [f64; 2],
}

const _: () = assert!(MAX_TILES[0] <= u128::BITS as usize);

impl RoadMask {
    /// Leaves nothing out of tiles whose first row begins at a height on the plane z = 1.
    fn of_everything(strip: &Strip<'_>, first_row_z1: f64) -> Self {
        let c = &strip.camera;
        let size_z1 = [TILE_PX[0] as f64 / c.fx, TILE_PX[1] as f64 / c.fy];
        Self { rows: [0; MAX_TILES[1]], first_row_z1, left_z1: -c.cx / c.fx, size_z1 }
    }

    fn exclude(&mut self, [column, row]: [usize; 2]) {
        if let Some(bits) = self.rows.get_mut(row) {
            *bits |= 1 << column;
        }
    }

    /// The tiles that are left out of those beside each other at a height on the plane z = 1, a bit each.
    #[inline(always)]
    pub(super) fn row(&self, y_z1: f64) -> u128 {
        let row = (y_z1 - self.first_row_z1) / self.size_z1[1];
        if row >= 0.0 { self.rows.get(row as usize).copied().unwrap_or(0) } else { 0 }
    }

    /// Whether a ray falls into a tile of `row` that is left out.
    #[inline(always)]
    pub(super) fn excludes(&self, row: u128, x_z1: f64) -> bool {
        let column = (x_z1 - self.left_z1) / self.size_z1[0];
        column >= 0.0 && column < MAX_TILES[0] as f64 && row >> (column as u32) & 1 == 1
    }
}

/// Lets the tiles of the strip vote.
///
/// A tile's vote is the likelihood of its grey differences, their mean taken out, at each height; half of the tiles may
/// show anything at all, so that what stands on the road, rides ahead or casts a shadow has no majority: it agrees with
/// no plane under the camera, or only over a few rows.
///
/// # Inputs
/// * `range`: heights over the expected one that are tried.
///
/// # Errors
/// [`RoadProblem::TooFewPixels`] when too few tiles have texture.
///
/// # Source
/// Own: maximum of a product of mixtures, as in robust voting.
pub(super) fn elect(
    simd: SimdLevel,
    strip: &Strip<'_>,
    pair: &RoadPair<'_, '_>,
    range: [f64; 2],
) -> Result<Election, RoadProblem> {
    let lowest = range[0] / MARGIN;
    let n_heights = libm::ceil(libm::log(range[1] * MARGIN / lowest) / libm::log(FACTOR)) as usize + 1;
    let n_heights = n_heights.min(MAX_HEIGHTS);
    let mut planes = [Vector3::zeros(); MAX_HEIGHTS];
    let mut ratio = lowest;
    for plane in planes.iter_mut().take(n_heights) {
        *plane = pair.expected_normal / (pair.expected_height_m * ratio);
        ratio *= FACTOR;
    }
    let planes = planes.get(..n_heights).unwrap_or(&[]);
    let mut least_of = Leasts([[NO_VOTE; MAX_TILES[0]]; MAX_TILES[1]]);
    let (mut opinion, mut n_votes) = ([0.0; MAX_HEIGHTS], 0);
    let tiles = || tiles(strip, pair);
    for (place, tile) in tiles() {
        if let Some(least) = vote(simd, &tile, planes, &mut opinion) {
            least_of.note(place, least);
            n_votes += 1;
        }
    }
    let n_pixels = n_votes * TILE_PX[0] * TILE_PX[1];
    if n_pixels < strip.settings.min_pixels {
        return Err(RoadProblem::TooFewPixels { found: n_pixels, needed: strip.settings.min_pixels });
    }
    let (elected, first, second) =
        peaks(opinion.get(..n_heights).unwrap_or(&[])).ok_or(RoadProblem::Ambiguous { margin: 0.0 })?;
    let near = planes.get(elected - 1..elected + 2).unwrap_or(&[]);
    let first_row_z1 = strip.y_z1(first_row(strip)) - 0.5 / strip.camera.fy;
    let mut mask = RoadMask::of_everything(strip, first_row_z1);
    let mut n_agreeing = n_votes;
    for (place, tile) in tiles() {
        let least = least_of.at(place);
        let mut variances = [f64::INFINITY; MAX_HEIGHTS];
        tile.variances(simd, near, &mut variances);
        let found = variances.iter().take(near.len()).copied().fold(f64::INFINITY, f64::min);
        if least != NO_VOTE && excess(found, f64::from(least)) > MAX_EXCESS {
            n_agreeing -= 1;
            mask.exclude(place);
        }
    }
    if (n_agreeing as f64) < CLEAR_SHARE * n_votes as f64 {
        tiles().filter(|(place, _)| least_of.at(*place) == NO_VOTE).for_each(|(place, _)| mask.exclude(place));
    }
    let height_ratio = lowest * libm::pow(FACTOR, elected as f64);
    Ok(Election { height_ratio, margin: first - second, n_votes, n_agreeing, mask })
}

/// The least variance of every tile.
struct Leasts([[f32; MAX_TILES[0]]; MAX_TILES[1]]);

impl Leasts {
    fn at(&self, [column, row]: [usize; 2]) -> f32 {
        self.0.get(row).and_then(|tiles| tiles.get(column)).copied().unwrap_or(NO_VOTE)
    }

    fn note(&mut self, [column, row]: [usize; 2], least: f64) {
        if let Some(slot) = self.0.get_mut(row).and_then(|tiles| tiles.get_mut(column)) {
            *slot = least as f32;
        }
    }
}

/// The first row of the strip; the image's height when there is none.
fn first_row(strip: &Strip<'_>) -> usize {
    let height = strip.later.height();
    let is_road = |row: &usize| strip.columns(strip.y_z1(*row)).is_some();
    (0..height).find(is_road).unwrap_or(height)
}

/// The tiles of the strip, with their columns and rows among the tiles.
fn tiles<'a, 's>(strip: &'s Strip<'a>, pair: &'s RoadPair<'_, '_>) -> impl Iterator<Item = ([usize; 2], Tile<'a, 's>)> {
    let rotation = *pair.earlier_from_later.rotation.to_rotation_matrix().matrix();
    let translation = pair.earlier_from_later.translation.vector;
    let first_row = first_row(strip);
    (0..MAX_TILES[1]).flat_map(move |tile_row| {
        let row = first_row + tile_row * TILE_PX[1];
        let ends = strip.columns(strip.y_z1(row));
        let (first, end) = ends.map_or((0, 0), |(first, end)| (first.div_ceil(TILE_PX[0]), end / TILE_PX[0]));
        (first..end.min(MAX_TILES[0])).map(move |tile_column| {
            let corner = [tile_column * TILE_PX[0], row];
            ([tile_column, tile_row], Tile::new(strip, &rotation, translation, corner))
        })
    })
}

/// Adds one tile's opinion of the heights; returns its least variance, or `None` when the tile has no texture.
///
/// The ends of the row have no vote: what fits there best is beyond the heights that are tried.
fn vote(
    simd: SimdLevel,
    tile: &Tile<'_, '_>,
    planes: &[Vector3<f64>],
    opinion: &mut [f64; MAX_HEIGHTS],
) -> Option<f64> {
    if tile.texture()? < MIN_TEXTURE_GREY * MIN_TEXTURE_GREY {
        return None;
    }
    let mut variances = [f64::INFINITY; MAX_HEIGHTS];
    tile.variances(simd, planes, &mut variances);
    let (best, &least) = variances.iter().take(planes.len()).enumerate().min_by(|a, b| a.1.total_cmp(b.1))?;
    if !least.is_finite() {
        return None;
    }
    if best > 0 && best + 1 < planes.len() {
        let mut likelihoods = [0.0; MAX_HEIGHTS];
        for (likelihood, &variance) in likelihoods.iter_mut().zip(&variances).take(planes.len()) {
            *likelihood = libm::exp(-excess(variance, least));
        }
        let total: f64 = likelihoods.iter().take(planes.len()).sum();
        for (o, likelihood) in opinion.iter_mut().zip(likelihoods).take(planes.len()) {
            *o += libm::log((1.0 - STRANGE_SHARE) * likelihood / total + STRANGE_SHARE / planes.len() as f64);
        }
    }
    Some(least)
}

/// Logarithm of how much likelier the least variance of a tile is than another one.
fn excess(variance: f64, least: f64) -> f64 {
    let n = (TILE_PX[0] * TILE_PX[1]) as f64;
    (variance - least) * n / (2.0 * PIXELS_PER_INDEPENDENT * least.max(NOISE_GREY * NOISE_GREY))
}

/// A rectangle of the later image, with what the heights that are tried have in common.
struct Tile<'a, 's> {
    strip: &'s Strip<'a>,
    translation: Vector3<f64>,
    pixels: [TilePixel; TILE_PX[0] * TILE_PX[1]],
}

#[derive(Clone, Copy, Default)]
struct TilePixel {
    ray: Vector3<f64>,
    /// The ray in the earlier camera's axes.
    turned: Vector3<f64>,
    /// Grey value in the later image.
    later: Option<f64>,
}

impl<'a, 's> Tile<'a, 's> {
    fn new(strip: &'s Strip<'a>, rotation: &Matrix3<f64>, translation: Vector3<f64>, corner: [usize; 2]) -> Self {
        let mut pixels = [TilePixel::default(); TILE_PX[0] * TILE_PX[1]];
        for (i, pixel) in pixels.iter_mut().enumerate() {
            let (x, y) = (corner[0] + i % TILE_PX[0], corner[1] + i / TILE_PX[0]);
            let ray = strip.ray(x, y);
            *pixel = TilePixel { ray, turned: rotation * ray, later: strip.later_at(x, y) };
        }
        Self { strip, translation, pixels }
    }

    /// Variances of the differences between the two images when the road is one of these planes; infinite where it is not seen.
    fn variances(&self, simd: SimdLevel, planes: &[Vector3<f64>], variances: &mut [f64]) {
        simd.run(Variances { tile: self, planes, variances });
    }

    /// Variance of its grey values.
    fn texture(&self) -> Option<f64> {
        variance(self.pixels.iter().map(|p| p.later))
    }
}

struct Variances<'a, 's, 't> {
    tile: &'t Tile<'a, 's>,
    planes: &'t [Vector3<f64>],
    variances: &'t mut [f64],
}

impl KernelTask for Variances<'_, '_, '_> {
    #[inline(always)]
    fn run<K: Kernel>(self, kernel: K) {
        let Some(&last) = self.planes.last() else { return };
        for (planes, variances) in self.planes.chunks(FOUR).zip(self.variances.chunks_mut(FOUR)) {
            let [mut x, mut y, mut z] = [[last.x; FOUR], [last.y; FOUR], [last.z; FOUR]];
            for (i, plane) in planes.iter().enumerate() {
                (x[i], y[i], z[i]) = (plane.x, plane.y, plane.z);
            }
            let four = [kernel.doubles(x), kernel.doubles(y), kernel.doubles(z)];
            let found = self.tile.variances_of_four(kernel, four);
            variances.iter_mut().zip(found).take(planes.len()).for_each(|(slot, found)| *slot = found);
        }
    }
}

impl Tile<'_, '_> {
    /// As [`variances`](Self::variances), of four planes by their components.
    #[inline(always)]
    fn variances_of_four<K: Kernel>(&self, kernel: K, planes: [K::Doubles; 3]) -> [f64; FOUR] {
        let (c, image) = (&self.strip.camera, &self.strip.earlier);
        let (cx, cy, fx, fy) = (kernel.all(c.cx), kernel.all(c.cy), kernel.all(c.fx), kernel.all(c.fy));
        let [tx, ty, tz] = all_of(kernel, &self.translation);
        let half = kernel.all(0.5);
        let (mut sum, mut squares, mut is_seen) = (kernel.all(0.0), kernel.all(0.0), [true; FOUR]);
        for TilePixel { ray, turned, later } in &self.pixels {
            let &Some(later) = later else { return [f64::INFINITY; FOUR] };
            let shift = planes[0] * kernel.all(ray.x) + planes[1] * kernel.all(ray.y) + planes[2] * kernel.all(ray.z);
            let z = kernel.all(turned.z) + tz * shift;
            // Pixel i is centred at i + 0.5.
            let x = fx * (kernel.all(turned.x) + tx * shift) / z + cx - half;
            let y = fy * (kernel.all(turned.y) + ty * shift) / z + cy - half;
            let seen = interpolate(kernel, image, [x, y], &mut is_seen);
            if is_seen == [false; FOUR] {
                return [f64::INFINITY; FOUR];
            }
            let difference = seen - kernel.all(later);
            sum = sum + difference;
            squares = squares + difference * difference;
        }
        let n = self.pixels.len() as f64;
        let mut variances = (squares / kernel.all(n) - sum * sum / kernel.all(n * n)).values();
        for (variance, _) in variances.iter_mut().zip(is_seen).filter(|(_, is_seen)| !is_seen) {
            *variance = f64::INFINITY;
        }
        variances
    }
}

/// Grey values between the pixels, whose centres have whole coordinates here; those outside are no longer seen.
#[inline(always)]
fn interpolate<K: Kernel>(
    kernel: K,
    image: &ImageView<'_>,
    [x, y]: [K::Doubles; 2],
    is_seen: &mut [bool; FOUR],
) -> K::Doubles {
    let last = [image.width() as f64 - 1.0, image.height() as f64 - 1.0];
    let (x, y) = (x.values(), y.values());
    let [mut fx, mut fy] = [[0.0; FOUR]; 2];
    // Pairs of pixels of two rows, a byte each.
    let mut rows = [[0u32; FOUR]; 2];
    for i in 0..FOUR {
        is_seen[i] &= (x[i] >= 0.0) & (y[i] >= 0.0) & (x[i] < last[0]) & (y[i] < last[1]);
        if !is_seen[i] {
            continue;
        }
        let (column, row) = (x[i] as u32, y[i] as u32);
        (fx[i], fy[i]) = (x[i] - f64::from(column), y[i] - f64::from(row));
        let bytes = image.bytes_from(column as usize, row as usize);
        let pair = |start: usize| bytes.get(start..).and_then(|bytes| bytes.first_chunk()).unwrap_or(&[0; 2]);
        rows[0][i] = u16::from_le_bytes(*pair(0)).into();
        rows[1][i] = u16::from_le_bytes(*pair(image.stride())).into();
    }
    let (fx, fy) = (kernel.doubles(fx), kernel.doubles(fy));
    let above = blend(kernel.bytes::<0>(rows[0]), kernel.bytes::<8>(rows[0]), fx);
    let below = blend(kernel.bytes::<0>(rows[1]), kernel.bytes::<8>(rows[1]), fx);
    blend(above, below, fy)
}

/// Variance of as many values as a tile has pixels; `None` when one is missing.
fn variance(values: impl Iterator<Item = Option<f64>>) -> Option<f64> {
    let n = (TILE_PX[0] * TILE_PX[1]) as f64;
    let (mut sum, mut squares) = (0.0, 0.0);
    for value in values {
        let value = value?;
        sum += value;
        squares += value * value;
    }
    Some(squares / n - sum * sum / (n * n))
}

/// The highest local maximum of a row with its place, and the value of the highest one of another opinion.
fn peaks(values: &[f64]) -> Option<(usize, f64, f64)> {
    let maxima = || {
        values.windows(3).enumerate().filter_map(|(k, w)| match w {
            &[left, value, right] if value > left && value >= right => Some((k + 1, value)),
            _ => None,
        })
    };
    let (elected, first) = maxima().max_by(|a, b| a.1.total_cmp(&b.1))?;
    let others = maxima().filter(|(k, _)| k.abs_diff(elected) > SAME_OPINION);
    Some((elected, first, others.fold(f64::NEG_INFINITY, |most, (_, value)| most.max(value))))
}
