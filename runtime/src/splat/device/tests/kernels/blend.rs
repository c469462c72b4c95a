//! Blending and its gradient.

use super::{Case, exact, fixed, picture, reals, words_of};
use crate::splat::kernels::Kernel;
use crate::splat::layout::Splat;
use crate::splat::program::Buffer;

pub fn cases() -> Vec<Case> {
    vec![blend(), blend_backward()]
}

/// The same opacity everywhere.
pub fn flat(log2_opacity: f32, color: [f32; 3], depth_m: f32) -> Splat {
    let [red, green, blue] = color;
    Splat { log2_opacity, red, green, blue, depth_m, ..Splat::default() }
}

fn blend() -> Case {
    let splats = [
        flat(-1.0, [1.0, 0.0, 0.0], 2.0),
        // Half its opacity a pixel beside its mean, a sixteenth two pixels beside it, and too little to see at three.
        Splat { conic_xx: -1.0, mean_x: 0.5, ..flat(-1.0, [0.0, 1.0, 0.0], 4.0) },
        // 0.96: the third one would leave less than 1e-4.
        flat(-0.058_893_69, [0.0, 0.0, 1.0], 1.0),
    ];
    let (left, right) = (1, 2);
    let pairs = [0, left, 1, left, 2, right, 2, right, 2, right];
    let in_each_row = |row: [f32; 8]| (0..4).flat_map(move |_| row);
    let (s, t) = (0.96, 0.0016);
    let planes = in_each_row([0.5, 0.5, 0.5, 0.5, 0.0, 0.0, 0.0, 0.0])
        .chain(in_each_row([0.25, 0.125, 1.0 / 64.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
        .chain(in_each_row([0.0, 0.0, 0.0, 0.0, s + 0.04 * s, s + 0.04 * s, s + 0.04 * s, s + 0.04 * s]))
        .chain(in_each_row([2.0, 1.5, 1.0625, 1.0, 1.0 - t, 1.0 - t, 1.0 - t, 1.0 - t]))
        .chain(in_each_row([0.25, 0.375, 0.5 - 1.0 / 64.0, 0.5, t, t, t, t]));
    Case {
        kernel: Kernel::Blend,
        nth_stage: 0,
        view: picture(8, 4),
        before: vec![
            (Buffer::Splats, words_of(&splats)),
            (Buffer::TileStarts, exact([0, 5])),
            (Buffer::Pairs, exact(pairs)),
        ],
        after: vec![(Buffer::Planes, reals(planes))],
        mutation: ["before - hit.alpha * before", "before + hit.alpha * before"],
    }
}

fn blend_backward() -> Case {
    // Two red halves, one behind the other, over one block; the gradient of red is 1 in each of the 16 pixels.
    let splat = Splat {
        mean_x: 0.5,
        mean_y: 0.5,
        rows_px: 3 << 16,
        columns_px: 3 << 16,
        extent_y: 1.0,
        half_px: 1.0,
        ..flat(-1.0, [1.0, 0.0, 0.0], 0.0)
    };
    let plane = |value: f32| [value; 16];
    let none = plane(0.0);
    // dL/dalpha of the first is 1 - 0.25 / 0.5, of the second 0.5: dL/dq is -1/4 for both. Pixels are 0, 1, 2, 3 px from
    // the mean: sums over a row 6 and 14, over the block 4 6, 4 14 and 6 6.
    let moments = [-4, -6, -6, -14, -9, -14];
    // The units follow from the bounds: 2^30 over 16 pixels of at most 16 (moments), 1 (colors).
    let sums = |red: i32| {
        let values = moments.map(|v| v << 22).into_iter().chain([red << 26, 0, 0, 0]);
        values.flat_map(|whole| [whole, 0])
    };
    Case {
        kernel: Kernel::BlendBackward,
        nth_stage: 0,
        view: picture(4, 4),
        before: vec![
            (Buffer::Splats, words_of(&[splat, splat])),
            (Buffer::TileStarts, exact([0, 2])),
            (Buffer::Pairs, exact([0, 1, 1, 1])),
            (Buffer::Planes, reals([plane(0.75), none, none, none, plane(0.25)].concat())),
            (Buffer::Upstream, reals([plane(1.0), none, none, none, none].concat())),
            (Buffer::Bounds, reals([1.0, 1.0, 16.0, 0.0])),
            (Buffer::SplatSums, exact([0; 40])),
        ],
        after: vec![(Buffer::SplatSums, fixed(sums(8).chain(sums(4))))],
        mutation: ["before * value - behind", "before * value + behind"],
    }
}
