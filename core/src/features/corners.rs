//! Corners, evenly spread: at most one new corner per cell of a grid, none where a track already is.

mod everywhere;

pub use everywhere::detect_everywhere;

use super::lanes::{Kernel, KernelTask, SimdLevel};
use super::lk::squared_distance;
use crate::frame::ImageView;

/// Constants of the detector.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CornerSettings {
    /// Side of a grid cell, px at [`REFERENCE_WIDTH_PX`]; it is scaled with the image's width and kept within 8..=48.
    /// Range [8, 48]; ours: 20 gives about 1100 cells at 1241 x 376.
    pub cell_px: f32,
    /// Smallest distance to a track or another new corner, px. Range [0, 48]; ours.
    pub min_distance_px: f32,
    /// Smallest eigenvalue of the mean gradient matrix over 5 x 5 px below which a pixel is no corner, squared grey
    /// values per squared pixel. Range [0, 10000]; ours.
    pub min_eigenvalue: f32,
    /// How close to the border a corner may lie, px. Range [4, 100]: less than 4 is taken as 4. Ours.
    pub border_px: f32,
}

/// Width of the images that lengths in px are stated for: KITTI's.
pub const REFERENCE_WIDTH_PX: f32 = 1241.0;

impl CornerSettings {
    /// The values that the documentation of the fields explains.
    pub const STANDARD: Self = Self { cell_px: 20.0, min_distance_px: 7.0, min_eigenvalue: 4.0, border_px: 11.0 };
}

/// A point that can be told from its neighbourhood in both directions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Corner {
    /// Centre of the pixel, px.
    pub pixel: [f32; 2],
    /// Smallest eigenvalue of the mean gradient matrix over 5 x 5 px, squared grey values per squared pixel.
    pub min_eigenvalue: f32,
}

impl Corner {
    /// Fills storage that is still to be written.
    pub const NONE: Self = Self { pixel: [0.0; 2], min_eigenvalue: 0.0 };
}

/// What [`detect`] found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CornerReport {
    /// Corners written to the front of the output.
    pub n_found: usize,
    /// Corners that gave way to stronger ones because the output was full.
    pub n_refused: usize,
    /// Cells without a track in them.
    pub n_empty_cells: usize,
}

/// Finds at most one corner in every grid cell that holds none of the `existing` points.
///
/// The maxima are those of `λ1 λ2 / (λ1 + λ2)`, which needs no root and lies within a factor of two of the smallest
/// eigenvalue; the smallest eigenvalue decides and is reported.
///
/// # Inputs
/// * `existing_px`: pixels of live tracks; those that are no numbers are ignored.
/// * `corners`: bounds how many are found; when it is full the weakest gives way (`evict-worst`).
///
/// # Output
/// The front of `corners`, in raster order of their cells; the rest of `corners` is left as it was.
///
/// # Cost
/// O(pixels of the empty cells + corners * existing); 7 KiB of stack; no allocation. Same bits on every SIMD level.
///
/// # Source
/// Shi & Tomasi 1994, eq. 24 (verdict); Noble 1988 (maxima).
pub fn detect(
    simd: SimdLevel,
    image: ImageView<'_>,
    settings: &CornerSettings,
    existing_px: impl Iterator<Item = [f32; 2]> + Clone,
    corners: &mut [Corner],
) -> CornerReport {
    let mut report = CornerReport { n_found: 0, n_refused: 0, n_empty_cells: 0 };
    simd.run(Detect { image, settings, existing_px, corners, report: &mut report });
    report
}

/// Cells per row of the grid; wider images get wider cells.
const MAX_COLUMNS: usize = 512;

/// Largest cell and its halo of eight pixels fit into these lanes.
const MAX_CELL_PX: usize = 48;
const LANES: usize = 64;
/// As the standard cell does with its halo.
const FEW_LANES: usize = 32;

/// Side of the block that gradients are averaged over, px.
const BLOCK: usize = 5;

/// Pixels around a candidate that its response and its neighbours' need.
const HALO: usize = BLOCK / 2 + 2;

/// A second or third maximum is taken when the first lies too close to a track.
const CANDIDATES: usize = 4;

/// Side of a grid cell for images of this width, px.
pub fn cell_side_px(settings: &CornerSettings, width: usize) -> usize {
    let scaled = settings.cell_px * width as f32 / REFERENCE_WIDTH_PX;
    (libm::roundf(scaled) as usize).clamp(8, MAX_CELL_PX).max(width.div_ceil(MAX_COLUMNS)).min(MAX_CELL_PX)
}

struct Detect<'a, I> {
    image: ImageView<'a>,
    settings: &'a CornerSettings,
    existing_px: I,
    corners: &'a mut [Corner],
    report: &'a mut CornerReport,
}

impl<I: Iterator<Item = [f32; 2]> + Clone> KernelTask for Detect<'_, I> {
    #[inline(always)]
    fn run<K: Kernel>(self, kernel: K) {
        *self.report = detect_in_cells(kernel, self.image, self.settings, self.existing_px, self.corners);
    }
}

#[inline(always)]
fn detect_in_cells<K: Kernel>(
    kernel: K,
    image: ImageView<'_>,
    settings: &CornerSettings,
    existing_px: impl Iterator<Item = [f32; 2]> + Clone,
    corners: &mut [Corner],
) -> CornerReport {
    let mut report = CornerReport { n_found: 0, n_refused: 0, n_empty_cells: 0 };
    let side = cell_side_px(settings, image.width());
    let border = (settings.border_px.clamp(HALO as f32, 1e4)) as usize;
    let (columns, rows) = (image.width() / side + 1, image.height() / side + 1);
    for row in 0..rows {
        let mut occupied = [false; MAX_COLUMNS + 1];
        for [x, y] in existing_px.clone().filter(|[x, y]| *x >= 0.0 && *y >= 0.0) {
            if y as usize / side == row
                && let Some(cell) = occupied.get_mut(x as usize / side)
            {
                *cell = true;
            }
        }
        let Some((top, bottom)) = overlap(row * side, side, border, image.height()) else { continue };
        let nearby = Nearby::new(existing_px.clone(), [top, bottom], settings.min_distance_px);
        for (column, _) in occupied.iter().enumerate().take(columns).filter(|(_, occupied)| !**occupied) {
            let Some((left, right)) = overlap(column * side, side, border, image.width()) else { continue };
            report.n_empty_cells += 1;
            let candidates = match right - left + 2 * HALO {
                0..=FEW_LANES => strongest_in_cell::<K, FEW_LANES>(kernel, image, [left, top], [right, bottom]),
                _ => strongest_in_cell::<K, LANES>(kernel, image, [left, top], [right, bottom]),
            };
            let nearest_px2 = settings.min_distance_px * settings.min_distance_px;
            let far_from = |pixel, other| squared_distance(pixel, other) >= nearest_px2;
            let accepted = candidates.iter().find(|corner| {
                corner.min_eigenvalue >= settings.min_eigenvalue.max(f32::MIN_POSITIVE)
                    && nearby.all(existing_px.clone(), |px| far_from(corner.pixel, px))
                    && corners.iter().take(report.n_found).all(|other| far_from(corner.pixel, other.pixel))
            });
            if let Some(corner) = accepted {
                insert(*corner, corners, &mut report);
            }
        }
    }
    let found = corners.get_mut(..report.n_found).unwrap_or(&mut []);
    let cell_of = |corner: &Corner| (corner.pixel[1] as usize / side, corner.pixel[0] as usize / side);
    found.sort_unstable_by_key(cell_of);
    report
}

/// Points near a row of cells, as many as there is room for.
struct Nearby {
    points_px: heapless::Vec<[f32; 2], MAX_NEARBY>,
    is_complete: bool,
}

const MAX_NEARBY: usize = 256;

impl Nearby {
    /// Those of `existing_px` that can lie within `distance_px` of rows `top..bottom`.
    fn new(existing_px: impl Iterator<Item = [f32; 2]>, [top, bottom]: [usize; 2], distance_px: f32) -> Self {
        // A pixel more, for rounding.
        let rows = (top as f32 - distance_px - 1.0)..=(bottom as f32 + distance_px + 1.0);
        let mut points_px = heapless::Vec::new();
        let is_complete = existing_px
            .filter(|[x, y]| x.is_finite() && rows.contains(y))
            .all(|point_px| points_px.push(point_px).is_ok());
        Self { points_px, is_complete }
    }

    /// Whether all of them are as `is_fine` wants; `existing_px` is asked where there was no room.
    fn all(&self, mut existing_px: impl Iterator<Item = [f32; 2]>, is_fine: impl Fn([f32; 2]) -> bool) -> bool {
        if self.is_complete {
            return self.points_px.iter().all(|&px| is_fine(px));
        }
        existing_px.all(|px| !px.iter().all(|c| c.is_finite()) || is_fine(px))
    }
}

/// The part of `start..start + side` that is at least `border` away from both ends of the image.
fn overlap(start: usize, side: usize, border: usize, size: usize) -> Option<(usize, usize)> {
    let (first, end) = (start.max(border), (start + side).min(size.saturating_sub(border)));
    (first < end).then_some((first, end))
}

fn insert(corner: Corner, corners: &mut [Corner], report: &mut CornerReport) {
    if let Some(slot) = corners.get_mut(report.n_found) {
        *slot = corner;
        report.n_found += 1;
        return;
    }
    report.n_refused += 1;
    let weakest = corners.iter_mut().reduce(|a, b| if b.min_eigenvalue < a.min_eigenvalue { b } else { a });
    if let Some(weakest) = weakest.filter(|weakest| weakest.min_eigenvalue < corner.min_eigenvalue) {
        *weakest = corner;
    }
}

/// Sums over a row of pixels of the products of gradients: xx, xy, yy.
type ProductRow<const N: usize> = [[i32; N]; 3];

/// The strongest local maxima of the response in `first..end`, strongest first; missing ones are [`Corner::NONE`].
#[inline(always)]
fn strongest_in_cell<K: Kernel, const N: usize>(
    kernel: K,
    image: ImageView<'_>,
    first: [usize; 2],
    end: [usize; 2],
) -> [Corner; CANDIDATES] {
    let mut strongest = [(0.0f32, Corner::NONE); CANDIDATES];
    let (left, top) = (first[0] - HALO, first[1] - HALO);
    let n_lanes = end[0] - first[0] + 2 * HALO;
    let mut sums = BlockSums::<N>::NONE;
    // Three rows of responses and of the sums that they came from; the middle one is searched for maxima.
    let mut responses = [[0.0f32; N]; 3];
    let mut middle_block = sums.block;
    let mut rows = RowsAround::new(image, left, top + 1, n_lanes);
    for y in top + 1..end[1] + HALO - 1 {
        sums.slide(y, product_row(rows.slide(image, left, y, n_lanes)));
        responses = [responses[1], responses[2], response_row(&sums.block)];
        // The block ends with row y, so it is centred two rows above; the middle responses lie one row higher still.
        let center_y = y + 1 - HALO;
        if center_y >= first[1] && any_above(&responses[1], strongest[CANDIDATES - 1].0) {
            for i in HALO..n_lanes - HALO {
                let response = responses[1][i];
                if response > strongest[CANDIDATES - 1].0 && is_maximum(&responses, i) {
                    let pixel = [(left + i) as f32 + 0.5, center_y as f32 + 0.5];
                    let corner = Corner { pixel, min_eigenvalue: min_eigenvalue(kernel, &middle_block, i) };
                    keep_strongest(&mut strongest, response, corner);
                }
            }
        }
        middle_block = sums.block;
    }
    strongest.map(|(_, corner)| corner)
}

/// Whether any response is larger than `least`: most rows have none.
#[inline(always)]
fn any_above<const N: usize>(responses: &[f32; N], least: f32) -> bool {
    let mut is_above = false;
    for &response in responses {
        is_above |= response > least;
    }
    is_above
}

/// Sums over the last rows of products.
struct BlockSums<const N: usize> {
    ring: [ProductRow<N>; BLOCK],
    block: ProductRow<N>,
}

impl<const N: usize> BlockSums<N> {
    const NONE: Self = Self { ring: [[[0; N]; 3]; BLOCK], block: [[0; N]; 3] };

    /// Takes row `y` in and drops the row that is [`BLOCK`] rows above.
    #[inline(always)]
    fn slide(&mut self, y: usize, entering: ProductRow<N>) {
        let leaving = core::mem::replace(&mut self.ring[y % BLOCK], entering);
        for ((block, entering), leaving) in self.block.iter_mut().zip(&entering).zip(&leaving) {
            for i in 0..N {
                block[i] += entering[i] - leaving[i];
            }
        }
    }
}

fn keep_strongest(strongest: &mut [(f32, Corner); CANDIDATES], response: f32, corner: Corner) {
    let mut entering = (response, corner);
    for slot in strongest {
        if entering.0 > slot.0 {
            core::mem::swap(slot, &mut entering);
        }
    }
}

/// Ties go to the pixel that comes first.
#[inline(always)]
fn is_maximum<const N: usize>(responses: &[[f32; N]; 3], i: usize) -> bool {
    let [above, here, below] = responses;
    let response = here[i];
    let before = [above[i - 1], above[i], above[i + 1], here[i - 1]];
    let after = [here[i + 1], below[i - 1], below[i], below[i + 1]];
    before.iter().all(|&other| response > other) && after.iter().all(|&other| response >= other)
}

/// Grey values of a row, the one above and the one below, from a column on.
struct RowsAround<const N: usize> {
    rows: [[i16; N]; 3],
}

impl<const N: usize> RowsAround<N> {
    /// Rows that [`slide`](Self::slide) to `y` first.
    #[inline(always)]
    fn new(image: ImageView<'_>, left: usize, y: usize, n_lanes: usize) -> Self {
        Self { rows: [[0; N], load_row(image, left, y.wrapping_sub(1), n_lanes), load_row(image, left, y, n_lanes)] }
    }

    /// The rows around `y`, which follows the last one.
    #[inline(always)]
    fn slide(&mut self, image: ImageView<'_>, left: usize, y: usize, n_lanes: usize) -> &[[i16; N]; 3] {
        self.rows = [self.rows[1], self.rows[2], load_row(image, left, y + 1, n_lanes)];
        &self.rows
    }
}

/// Grey values of row `y` from column `left` on, `n_lanes` of them at least; 0 outside the image.
#[inline(always)]
fn load_row<const N: usize>(image: ImageView<'_>, left: usize, y: usize, n_lanes: usize) -> [i16; N] {
    let mut lanes = [0i16; N];
    let row = if y < image.height() { image.row(y).get(left..).unwrap_or(&[]) } else { &[] };
    match row.first_chunk::<N>() {
        Some(pixels) => {
            for i in 0..N {
                lanes[i] = i16::from(pixels[i]);
            }
        }
        None => lanes.iter_mut().zip(row).take(n_lanes).for_each(|(lane, &pixel)| *lane = i16::from(pixel)),
    }
    lanes
}

/// Gradient products of the middle row, summed over [`BLOCK`] columns; lane i is centred on column i.
#[inline(always)]
fn product_row<const N: usize>([above, here, below]: &[[i16; N]; 3]) -> ProductRow<N> {
    let mut products = [[0i32; N]; 3];
    for i in 1..N - 1 {
        let dx = |row: &[i16; N]| row[i + 1] - row[i - 1];
        let dy = |i: usize| below[i] - above[i];
        let gx = i32::from(dx(above) + 2 * dx(here) + dx(below));
        let gy = i32::from(dy(i - 1) + 2 * dy(i) + dy(i + 1));
        products[0][i] = gx * gx;
        products[1][i] = gx * gy;
        products[2][i] = gy * gy;
    }
    let mut sums = [[0i32; N]; 3];
    for (sums, row) in sums.iter_mut().zip(&products) {
        for i in BLOCK / 2..N - BLOCK / 2 {
            sums[i] = row[i - 2] + row[i - 1] + row[i] + row[i + 1] + row[i + 2];
        }
    }
    sums
}

/// `λ1 λ2 / (λ1 + λ2)` of the summed products; 0 where there is no gradient.
#[inline(always)]
fn response_row<const N: usize>([xx, xy, yy]: &[[i32; N]; 3]) -> [f32; N] {
    let mut responses = [0.0; N];
    for i in 0..N {
        let (xx, xy, yy) = (xx[i] as f32, xy[i] as f32, yy[i] as f32);
        // Products are integers: a trace of one is far below any threshold and keeps 0 / 0 away.
        responses[i] = (xx * yy - xy * xy) / (xx + yy).max(1.0);
    }
    responses
}

#[inline(always)]
fn min_eigenvalue<K: Kernel, const N: usize>(kernel: K, block: &[[i32; N]; 3], i: usize) -> f32 {
    /// A Sobel sum is eight times the gradient.
    const UNIT: f32 = (BLOCK * BLOCK * 64) as f32;
    let [xx, xy, yy] = [0, 1, 2].map(|k: usize| block[k][i] as f32 / UNIT);
    let half_difference = 0.5 * (xx - yy);
    0.5 * (xx + yy) - kernel.sqrt((half_difference * half_difference + xy * xy).into()) as f32
}

#[cfg(test)]
mod tests;
