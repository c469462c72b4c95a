//! From sums over pixels to gradients of what is trained.

use super::cull::{anchor, keyframe};
use super::project::{camera, round_splat};
use super::{Case, Word, counters, exact, fixed, picture, reals, words_of};
use crate::splat::kernels::Kernel;
use crate::splat::layout::{DeviceAnchor, Splat, ViewBlock};
use crate::splat::program::Buffer;

pub fn cases() -> Vec<Case> {
    vec![bound_gradients(), splatting_backward()]
}

fn bound_gradients() -> Case {
    let upstream = [1.0, 0.0, -2.0, 0.0, 3.0, -5.0, 0.5, -0.25, 0.1, -4.0];
    // Mean depths 12 m and 8 m: 1 + 2 + 3 + 4 0.5 12 + 0.1 and 5 + 4 0.25 8 + 4.
    let planes = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 6.0, 8.0, 0.5, 0.0];
    Case {
        kernel: Kernel::BoundGradients,
        nth_stage: 0,
        view: picture(2, 1),
        before: vec![
            (Buffer::Planes, reals(planes)),
            (Buffer::Upstream, reals(upstream)),
            (Buffer::Bounds, exact([0; 4])),
        ],
        after: vec![(Buffer::Bounds, [reals([5.0, 0.5, 30.1]), exact([0])].concat())],
        mutation: ["max(1.0 - planes", "max(1.0 + planes"],
    }
}

/// Sums of one splat: unit 2^-22 and 1024ths of it.
fn sums() -> Vec<Word> {
    let mut sums = [[0; 2]; 10];
    // The second integer counts too.
    sums[0] = [(-3 << 22) - 1, 1024];
    sums[1] = [1 << 22, 0];
    sums[3] = [1 << 19, 0];
    sums[6] = [2 << 22, 0];
    sums[9] = [1 << 22, 0];
    fixed(sums.into_iter().chain([[0; 2]; 10]).flatten())
}

fn splatting_backward() -> Case {
    // Twice as deep as wide, which does not show from the front.
    let deep = DeviceAnchor { extent_z: 2.0, ..anchor(4.0, 0, 1, 1.0) };
    let numbers = [0.0, 0.0, 0.0, 0.0, 0.0, 2.0_f32.ln(), 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0];
    // Of the mean on the picture -r^2 / half = -1.50164 px; of the root of the variance -2 r^2 / 8 / 4.3 = -0.563734,
    // with r^2 = 2 ln(255 / 2). A pixel is half a metre here: twice them with respect to metres. With the depth the root
    // shrinks by 2 / 4 per m. Opacity: 3 / 0.5, times 0.25 for its logit, as for the color. Isotropy: scales 1, 1, 2 are 4/3
    // from their mean in sum; its weight is 0.3 over 2 visible ones.
    let gradients = [
        -3.003_290_1,
        0.0,
        2.0 * (1.0 + 0.281_867_2),
        -1.127_469 - 0.1,
        -0.1,
        0.4,
        0.0,
        0.0,
        0.0,
        0.0,
        1.5,
        0.5,
        0.0,
        0.0,
    ];
    Case {
        kernel: Kernel::SplattingBackward,
        nth_stage: 0,
        view: ViewBlock { candidate_capacity: 2, isotropy_weight: 0.3, finds_pose: 1, ..camera() },
        before: vec![
            (Buffer::Anchors, words_of(&[deep])),
            (Buffer::Keyframes, words_of(&[keyframe(1.0)])),
            (Buffer::Candidates, exact([0, 0])),
            (Buffer::Counters, words_of(&[counters(2)])),
            (Buffer::Splats, words_of(&[round_splat(), Splat { columns_px: u32::MAX, ..round_splat() }])),
            // 2^30 over 16 blocks of 16 pixels of at most 1.
            (Buffer::Bounds, reals([1.0, 1.0, 1.0, 0.0])),
            (Buffer::SplatSums, sums()),
            (Buffer::Effective, reals(numbers.into_iter().flat_map(|v| [v, v]))),
        ],
        after: vec![
            (Buffer::SplatSums, exact([0; 40])),
            // Nothing is learnt of the candidate that does not meet the picture.
            (Buffer::Effective, reals(gradients.into_iter().flat_map(|v| [v, 0.0]))),
            // The camera's turning moves the mean, 4 m ahead, to the side; the root is not turned by stretching it.
            (Buffer::CandidateSums, reals([4.0 / 3.0, 0.0, 4.0 * -3.003_290_1, 0.0, -3.003_290_1, 0.0, 1.281_867_2])),
        ],
        mutation: ["-total / opacity", "total / opacity"],
    }
}
