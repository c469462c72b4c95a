//! The background and its gradient.

use super::loss::piece_sums;
use super::{Case, SENTINEL, Word, exact, picture, reals};
use crate::splat::kernel_constants::{BACKGROUND_COLUMNS, SUM_SKY_TURN, TEXEL_NUMBERS};
use crate::splat::kernels::Kernel;
use crate::splat::layout::ViewBlock;
use crate::splat::program::Buffer;

pub fn cases() -> Vec<Case> {
    vec![compose_sky(), spread_sky(), turn_sky(), collect_sky()]
}

/// One pixel that looks along the map's forward axis: halfway between the last and the first column, and at row
/// 15 degrees / (75 degrees / 32) - 0.5 = 5.9. Texels of row 5 weigh 0.05, those of row 6 weigh 0.45.
fn forward() -> ViewBlock {
    ViewBlock { ray_corner: [0.0, 0.0, 1.0, 0.0], ..picture(1, 1) }
}

/// Position of a texel's number within a table.
fn at(column: u32, row: u32, channel: u32) -> usize {
    (3 * (row * BACKGROUND_COLUMNS + column) + channel) as usize
}

const LAST: u32 = BACKGROUND_COLUMNS - 1;

/// The table of the second chunk row has a few colors.
fn texels() -> Vec<f32> {
    let table = TEXEL_NUMBERS as usize;
    let mut texels = vec![0.0; 2 * table];
    for (at, value) in [(at(LAST, 5, 0), 1.0), (at(0, 6, 0), 0.5), (at(0, 5, 1), 1.0), (at(LAST, 6, 2), 1.0)] {
        texels[table + at] = value;
    }
    texels
}

fn compose_sky() -> Case {
    Case {
        kernel: Kernel::ComposeSky,
        nth_stage: 0,
        view: ViewBlock { first_texel: TEXEL_NUMBERS / 3, ..forward() },
        before: vec![(Buffer::Texels, reals(texels())), (Buffer::Planes, reals([0.1, 0.2, 0.3, 7.0, 0.5]))],
        // Half of the background shows: 0.05 + 0.45 0.5, 0.05, 0.45.
        after: vec![(Buffer::Planes, reals([0.2375, 0.225, 0.525, 7.0, 0.5]))],
        mutation: ["planes[channel * n + at] += sum", "planes[channel * n + at] -= sum"],
    }
}

fn spread_sky() -> Case {
    let mut sums = vec![Word::U(0); 2 * TEXEL_NUMBERS as usize];
    // The unit is the bound 2 over 2^30; half of the background shows, so that a texel of row 6 gets 0.45 of a half of 2.
    let unit = f64::from(1 << 29);
    for (column, row, share) in [(LAST, 5, 0.05), (0, 5, 0.05), (LAST, 6, 0.45), (0, 6, 0.45)] {
        sums[2 * at(column, row, 0)] = Word::I((share * unit) as i32);
        sums[2 * at(column, row, 1)] = Word::I((-share * unit) as i32);
    }
    Case {
        kernel: Kernel::SpreadSky,
        nth_stage: 0,
        view: forward(),
        before: vec![
            (Buffer::Planes, reals([0.0, 0.0, 0.0, 0.0, 0.5])),
            (Buffer::Upstream, reals([2.0, -2.0, 0.0, 0.0, 0.0])),
            (Buffer::Bounds, reals([2.0, 0.0, 0.0, 0.0])),
            (Buffer::TexelSums, exact(vec![0; sums.len()])),
        ],
        after: vec![(Buffer::TexelSums, sums)],
        mutation: ["weight[i] * grad", "weight[i] + grad"],
    }
}

fn turn_sky() -> Case {
    // Half of the background shows: gradients 1, -1, 0.5, so that the texels count 1, -1 above and 0.5, 0.5 below. Per
    // column that is 0.1 -2, per row half of -0.5 and of 1.5; a radian has 128 / tau columns and 32 / 75 degrees rows.
    let mut sums = piece_sums(SUM_SKY_TURN, Word::U(SENTINEL), &[]);
    sums.extend(piece_sums(3, Word::U(0), &[(0, 0, 12.223_1), (1, 0, -4.074_366_5), (2, 0, 0.0)]));
    Case {
        kernel: Kernel::TurnSky,
        nth_stage: 0,
        view: ViewBlock { first_texel: TEXEL_NUMBERS / 3, ..forward() },
        before: vec![
            (Buffer::Planes, reals([0.0, 0.0, 0.0, 0.0, 0.5])),
            (Buffer::Upstream, reals([2.0, -2.0, 1.0, 0.0, 0.0])),
            (Buffer::Texels, reals(texels())),
        ],
        after: vec![(Buffer::LossSums, sums)],
        mutation: ["let by_azimuth = per_column", "let by_azimuth = -per_column"],
    }
}

fn collect_sky() -> Case {
    let n = TEXEL_NUMBERS as usize;
    let mut sums = vec![0; 2 * n];
    sums[..4].copy_from_slice(&[3, 128, -1_i32 as u32, 64]);
    let mut grads = vec![0.0; n];
    grads[..2].copy_from_slice(&[3.5, -0.75]);
    Case {
        kernel: Kernel::CollectSky,
        nth_stage: 0,
        view: forward(),
        // With this bound the unit is 1.
        before: vec![(Buffer::Bounds, reals([1_073_741_824.0, 0.0, 0.0, 0.0])), (Buffer::TexelSums, exact(sums))],
        after: vec![(Buffer::TexelSums, exact(vec![0; 2 * n])), (Buffer::TexelGrads, reals(grads))],
        mutation: ["whole + rest", "whole - rest"],
    }
}
