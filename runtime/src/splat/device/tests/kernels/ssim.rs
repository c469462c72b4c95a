//! Structural similarity, on pictures so small that a window has one or two pixels.

use super::loss::piece_sums;
use super::{Case, Word, picture, reals};
use crate::splat::kernel_constants::SUM_SSIM;
use crate::splat::kernels::Kernel;
use crate::splat::layout::ViewBlock;
use crate::splat::program::Buffer;

pub fn cases() -> Vec<Case> {
    vec![ssim_rows(), ssim_compare(), ssim_columns(), ssim_collect()]
}

/// Weight of a window's middle.
const W0: f32 = 0.266_011_72;
/// Weight of the pixels beside it.
const W1: f32 = 0.213_005_54;

fn view(width: u32, height: u32) -> ViewBlock {
    ViewBlock { ssim_weight: 1.2, ..picture(width, height) }
}

fn ssim_rows() -> Case {
    let both = W0 + W1;
    // x = 1, 0 and y = 0.5, 0.5 in the second channel.
    let expected = [W0, W1, 0.5 * both, 0.5 * both, W0, W1, 0.25 * both, 0.25 * both, 0.5 * W0, 0.5 * W1];
    Case {
        kernel: Kernel::SsimRows,
        nth_stage: 1,
        view: view(2, 1),
        before: vec![
            (Buffer::ExposedPlanes, reals([9.0, 9.0, 1.0, 0.0, 9.0, 9.0])),
            (Buffer::TargetPlanes, reals([9.0, 9.0, 0.5, 0.5, 9.0, 9.0])),
        ],
        after: vec![(Buffer::WindowSums, reals(expected))],
        mutation: ["wx * y", "wx + y"],
    }
}

fn ssim_compare() -> Case {
    // Means 0.5 and 0.4, variances 0.09 and 0.04, covariance 0.03. SSIM is (0.4 + C1) (0.06 + C2) / (0.41 + C1) /
    // (0.13 + C2) with C1 = 1e-4, C2 = 9e-4; slopes by central differences in f64.
    let sums = [0.5, 0.4, 0.34, 0.2, 0.23].map(|v| v / W0);
    Case {
        kernel: Kernel::SsimCompare,
        nth_stage: 0,
        view: view(1, 1),
        before: vec![
            (Buffer::WindowSums, reals(sums)),
            (Buffer::LossSums, piece_sums(SUM_SSIM + 1, Word::U(0), &[(SUM_SSIM, 0, 0.25), (SUM_SSIM, 5, 1.0)])),
        ],
        after: vec![
            (Buffer::WindowSlopes, reals([-2.694_235_9, -3.467_502_5, 14.906_275])),
            (
                Buffer::LossSums,
                piece_sums(SUM_SSIM + 1, Word::U(0), &[(SUM_SSIM, 0, 0.25 + 0.453_896_1), (SUM_SSIM, 5, 1.0)]),
            ),
        ],
        mutation: ["2.0 * covariance + SSIM_C2", "2.0 * covariance - SSIM_C2"],
    }
}

fn ssim_columns() -> Case {
    let sums = |[a, b]: [f32; 2]| [W0 * a + W1 * b, W1 * a + W0 * b];
    Case {
        kernel: Kernel::SsimColumns,
        nth_stage: 0,
        view: view(1, 2),
        before: vec![(Buffer::WindowSlopes, reals([1.0, 2.0, 3.0, 0.0, 0.0, 4.0]))],
        after: vec![(Buffer::WindowSums, reals([[1.0, 2.0], [3.0, 0.0], [0.0, 4.0]].map(sums).into_iter().flatten()))],
        mutation: ["weight * window_slopes[n + at]", "weight + window_slopes[n + at]"],
    }
}

fn ssim_collect() -> Case {
    // -1.2 / 6 (by mean + 2 x by variance + y by covariance), with x = 1, 0 and y = 0.5, 0.25 in the second channel; the
    // slopes are 1, 0 by the mean, 0, 2 by the variance and 3, 0 by the covariance.
    let expected = [-0.2 * (W0 + 2.0 * 2.0 * W1 + 0.5 * 3.0 * W0), -0.2 * (W1 + 0.25 * 3.0 * W1)];
    Case {
        kernel: Kernel::SsimCollect,
        nth_stage: 1,
        view: view(2, 1),
        before: vec![
            (Buffer::ExposedPlanes, reals([9.0, 9.0, 1.0, 0.0, 9.0, 9.0])),
            (Buffer::TargetPlanes, reals([9.0, 9.0, 0.5, 0.25, 9.0, 9.0])),
            (Buffer::WindowSums, reals([1.0, 0.0, 0.0, 2.0, 3.0, 0.0])),
            (Buffer::Upstream, reals([5.0, 5.0, 10.0, 20.0, 5.0, 5.0])),
        ],
        after: vec![(Buffer::Upstream, reals([5.0, 5.0, 10.0 + expected[0], 20.0 + expected[1], 5.0, 5.0]))],
        mutation: ["2.0 * x * by_xx", "2.0 + x * by_xx"],
    }
}
