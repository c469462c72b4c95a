//! Corners of a whole image, one per small cell, found in one pass.

use super::{
    BlockSums, Corner, CornerReport, CornerSettings, HALO, LANES, RowsAround, insert, is_maximum, min_eigenvalue,
    product_row, response_row,
};
use crate::features::lanes::{Kernel, KernelTask, SimdLevel};
use crate::frame::ImageView;

/// Columns of a strip that are searched.
const STRIP: usize = LANES - 2 * HALO;

/// Side of the cells, px: the least that [`super::detect`] takes, and strips hold a whole number of them.
const CELL: usize = 8;
const CELLS_PER_STRIP: usize = STRIP / CELL;

/// Finds the strongest corner of every cell of 8 x 8 px, as [`super::detect`] but without regard to existing points: in a
/// quarter of its time, because gradients of neighbouring cells are computed once.
///
/// # Inputs
/// * `settings`: cells and distances of it are not looked at.
/// * `corners`: bounds how many are found; when it is full the weakest gives way (`evict-worst`).
///
/// # Output
/// The front of `corners`.
///
/// # Cost
/// O(pixels + refused corners * corners); 7 KiB of stack; no allocation. Same bits on every SIMD level.
pub fn detect_everywhere(
    simd: SimdLevel,
    image: ImageView<'_>,
    settings: &CornerSettings,
    corners: &mut [Corner],
) -> CornerReport {
    let mut report = CornerReport { n_found: 0, n_refused: 0, n_empty_cells: 0 };
    simd.run(DetectEverywhere { image, settings, corners, report: &mut report });
    report
}

struct DetectEverywhere<'a> {
    image: ImageView<'a>,
    settings: &'a CornerSettings,
    corners: &'a mut [Corner],
    report: &'a mut CornerReport,
}

impl KernelTask for DetectEverywhere<'_> {
    #[inline(always)]
    fn run<K: Kernel>(self, kernel: K) {
        let Self { image, settings, corners, report } = self;
        let border = settings.border_px.clamp(HALO as f32, 1e4) as usize;
        let end = [image.width(), image.height()].map(|side| side.saturating_sub(border));
        for left in (border..end[0]).step_by(STRIP) {
            let columns = [left, (left + STRIP).min(end[0])];
            scan_strip(kernel, image, columns, [border, end[1]], |corner| {
                if corner.min_eigenvalue >= settings.min_eigenvalue.max(f32::MIN_POSITIVE) {
                    insert(corner, corners, report);
                }
            });
        }
    }
}

/// Calls `found` for the strongest maximum of the response in every cell of a strip.
#[inline(always)]
fn scan_strip<K: Kernel>(
    kernel: K,
    image: ImageView<'_>,
    [first, end]: [usize; 2],
    [top, bottom]: [usize; 2],
    mut found: impl FnMut(Corner),
) {
    let n_lanes = end - first + 2 * HALO;
    let mut sums = BlockSums::<LANES>::NONE;
    let mut middle_block = sums.block;
    let mut responses = [[0.0f32; LANES]; 3];
    let mut strongest = [(0.0f32, Corner::NONE); CELLS_PER_STRIP];
    let mut rows = RowsAround::new(image, first - HALO, top + 1 - HALO, n_lanes);
    for y in top + 1 - HALO..bottom + HALO - 1 {
        sums.slide(y, product_row(rows.slide(image, first - HALO, y, n_lanes)));
        responses = [responses[1], responses[2], response_row(&sums.block)];
        // The block ends with row y, so it is centred two rows above; the middle responses lie one row higher still.
        let center_y = y + 1 - HALO;
        if center_y >= top {
            for i in HALO..n_lanes - HALO {
                let strongest = &mut strongest[(i - HALO) / CELL];
                if responses[1][i] > strongest.0 && is_maximum(&responses, i) {
                    let pixel = [(first + i - HALO) as f32 + 0.5, center_y as f32 + 0.5];
                    let min_eigenvalue = min_eigenvalue(kernel, &middle_block, i);
                    *strongest = (responses[1][i], Corner { pixel, min_eigenvalue });
                }
            }
            if (center_y + 1 - top).is_multiple_of(CELL) || center_y + 1 == bottom {
                for (response, corner) in core::mem::replace(&mut strongest, [(0.0, Corner::NONE); CELLS_PER_STRIP]) {
                    if response > 0.0 {
                        found(corner);
                    }
                }
            }
        }
        middle_block = sums.block;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::features::corners::detect;
    use crate::features::testing::Scene;
    use std::vec;
    use std::vec::Vec;

    #[test]
    fn one_pass_finds_what_cell_by_cell_is_found() {
        // Cells of both begin at the border, a whole number of cells from the corner of the image.
        let settings =
            CornerSettings { cell_px: 8.0, min_distance_px: 0.0, min_eigenvalue: 0.0, border_px: CELL as f32 };
        for (width, height) in [(400, 120), (163, 97), (80, 64), (16, 16), (20, 9)] {
            let pixels = Scene::textured(width, height).image([0.0, 0.0]);
            let image = ImageView::new(&pixels, width, height, width).expect("sized");
            let sorted = |mut corners: Vec<Corner>, n: usize| {
                corners.truncate(n);
                corners.sort_by(|a, b| a.pixel[1].total_cmp(&b.pixel[1]).then(a.pixel[0].total_cmp(&b.pixel[0])));
                corners
            };
            let mut by_cell = vec![Corner::NONE; 1000];
            let report = detect(SimdLevel::new(), image, &settings, core::iter::empty(), &mut by_cell);
            let by_cell = sorted(by_cell, report.n_found);
            for simd in [SimdLevel::new(), SimdLevel::Scalar] {
                let mut corners = vec![Corner::NONE; 1000];
                let report = detect_everywhere(simd, image, &settings, &mut corners);
                assert_eq!(sorted(corners, report.n_found), by_cell, "{width}x{height}");
            }
            assert!(width < 100 || by_cell.len() > 10, "{width}x{height}: {}", by_cell.len());
        }
    }
}
