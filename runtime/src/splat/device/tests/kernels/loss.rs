//! Terms of the loss that look at one pixel, and the sums.

use super::{Case, SENTINEL, Word, counters, exact, picture, reals, words_of};
use crate::splat::kernel_constants::{
    LOSS_PIECES, N_LOSS_SUMS, SUM_ABSOLUTE, SUM_ANISOTROPY, SUM_BIAS, SUM_DEPTH, SUM_GAIN, SUM_POSE, SUM_SQUARE,
    SUM_SSIM,
};
use crate::splat::kernels::Kernel;
use crate::splat::layout::ViewBlock;
use crate::splat::program::Buffer;

pub fn cases() -> Vec<Case> {
    vec![compare_pixels(), through_exposure(), reduce_loss()]
}

/// Sums `0..n` of all pieces, each `otherwise` but for these `(sum, piece, value)`.
pub fn piece_sums(n: u32, otherwise: Word, given: &[(u32, u32, f32)]) -> Vec<Word> {
    let mut all = vec![otherwise; (n * LOSS_PIECES) as usize];
    for &(sum, piece, value) in given {
        all[(sum * LOSS_PIECES + piece) as usize] = Word::F(value);
    }
    all
}

fn compare_pixels() -> Case {
    let (gain, bias) = ([2.0, 2.0, 2.0, 0.0], [0.1, 0.1, 0.1, 0.0]);
    let planes = [0.5, 0.2, 0.1, 0.4, 0.2, 0.0, 3.0, 5.0];
    // Red 1 and 0.4, green 0 and 1, blue 0.2 and 0.
    let bytes = u32::from_le_bytes([255, 0, 51, 102]);
    // Differences 0.1, 0.3, 0.3 and 0.1, -0.1, 0.1. The second pixel's depth has no confidence.
    let sums = [
        (SUM_ABSOLUTE, 0, 0.7),
        (SUM_ABSOLUTE, 1, 0.3),
        (SUM_SQUARE, 0, 0.19),
        (SUM_SQUARE, 1, 0.03),
        (SUM_DEPTH, 0, 0.25),
    ];
    Case {
        kernel: Kernel::ComparePixels,
        nth_stage: 0,
        view: ViewBlock {
            gain,
            bias,
            l1_weight: 0.6,
            has_depth: 1,
            depth_weight: 0.2,
            confidence_sum: 0.5,
            ..picture(2, 1)
        },
        before: vec![
            (Buffer::TargetWords, exact([bytes, 255])),
            (Buffer::TargetDepth, reals([2.5, 9.0, 0.5, -1.0])),
            (Buffer::Planes, reals(planes)),
        ],
        after: vec![
            (Buffer::TargetPlanes, reals([1.0, 0.4, 0.0, 1.0, 0.2, 0.0])),
            (Buffer::ExposedPlanes, reals([1.1, 0.5, 0.3, 0.9, 0.5, 0.1])),
            (Buffer::Upstream, reals([0.1, 0.1, 0.1, -0.1, 0.1, 0.1, 0.2, 0.0, 0.0, 0.0])),
            (Buffer::LossSums, piece_sums(SUM_SSIM + 1, Word::U(0), &sums)),
        ],
        mutation: ["view.gain.xyz * drawn + view.bias.xyz", "view.gain.xyz * drawn - view.bias.xyz"],
    }
}

fn through_exposure() -> Case {
    let mut sums = piece_sums(SUM_GAIN, Word::U(SENTINEL), &[]);
    sums.extend(piece_sums(
        6,
        Word::U(0),
        &[(0, 0, 0.5), (0, 1, 0.5), (SUM_BIAS - SUM_GAIN, 0, 1.0), (SUM_BIAS - SUM_GAIN, 1, 2.0)],
    ));
    Case {
        kernel: Kernel::ThroughExposure,
        nth_stage: 0,
        view: ViewBlock { gain: [3.0, 1.0, 1.0, 0.0], ..picture(2, 1) },
        before: vec![
            (Buffer::Planes, reals([0.5, 0.25, 0.0, 0.0, 0.0, 0.0])),
            (Buffer::Upstream, reals([1.0, 2.0, 0.0, 0.0, 0.0, 0.0])),
        ],
        after: vec![(Buffer::Upstream, reals([3.0, 6.0, 0.0, 0.0, 0.0, 0.0])), (Buffer::LossSums, sums)],
        mutation: ["grad * view.gain[i]", "grad + view.gain[i]"],
    }
}

fn reduce_loss() -> Case {
    let given = [(SUM_ABSOLUTE, 3, 1.5), (SUM_ABSOLUTE, 300, 2.0), (SUM_BIAS, LOSS_PIECES - 1, -4.0)];
    let mut report = [0.0; N_LOSS_SUMS as usize];
    for (sum, value) in [(SUM_ABSOLUTE, 3.5), (SUM_BIAS, -4.0), (SUM_ANISOTROPY, 3.5), (SUM_POSE + 5, 0.75)] {
        report[sum as usize] = value;
    }
    Case {
        kernel: Kernel::ReduceLoss,
        nth_stage: 0,
        view: picture(16, 16),
        before: vec![
            // Two workgroups of candidates.
            (Buffer::Counters, words_of(&[counters(300)])),
            (Buffer::LossSums, piece_sums(SUM_ANISOTROPY, Word::U(0), &given)),
            (Buffer::CandidateSums, reals([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 2.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.25])),
        ],
        after: vec![(Buffer::LossReport, reals(report))],
        mutation: ["part += loss_sums", "part -= loss_sums"],
    }
}
