//! From candidates to splats.

use super::cull::{anchor, keyframe};
use super::{Case, SENTINEL, Word, counters, exact, picture, reals, words_of};
use crate::splat::kernels::Kernel;
use crate::splat::layout::{Counters, Splat, ViewBlock};
use crate::splat::program::Buffer;
use zerocopy::IntoBytes;

pub fn cases() -> Vec<Case> {
    vec![make_splats()]
}

/// A camera that sees 1 m at 4 m as 2 px.
pub fn camera() -> ViewBlock {
    ViewBlock {
        focal_px: [8.0; 2],
        center_px: [8.0; 2],
        min_z1: [-2.0; 2],
        max_z1: [2.0; 2],
        candidate_capacity: 3,
        ..picture(16, 16)
    }
}

/// An opaque half, gray, at 4 m, 1 m to every side: its variance is 4.3 px^2.
pub fn round_splat() -> Splat {
    Splat {
        mean_x: 8.0,
        mean_y: 8.0,
        log2_opacity: -1.0,
        depth_m: 4.0,
        // -log2(e) / 2 / 4.3
        conic_xx: -0.167_755_24,
        conic_xy: 0.0,
        conic_yy: -0.167_755_24,
        rows_px: 2 | (13 << 16),
        red: 0.5,
        green: 0.5,
        blue: 0.5,
        columns_px: 2 | (13 << 16),
        // sqrt(2 ln(255 / 2) 4.3)
        extent_x: 6.457_073_7,
        extent_y: 6.457_073_7,
        slope: 0.0,
        half_px: 6.457_073_7,
    }
}

/// Compares pixels exactly and numbers as such.
fn splat_words(splat: &Splat) -> Vec<Word> {
    let words = splat.as_bytes().as_chunks().0.iter().map(|&bytes| u32::from_le_bytes(bytes));
    words
        .enumerate()
        .map(|(i, bits)| if [7, 11].contains(&i) { Word::U(bits) } else { Word::F(f32::from_bits(bits)) })
        .collect()
}

fn make_splats() -> Case {
    let identity = [0.0, 0.0, 0.0, 1.0];
    // Half as high as wide, turned by 45 degrees: (4 + 1) / 2 + 0.3 = 2.8 px^2 along the axes, (4 - 1) / 2 between them.
    let turned = [0.0, 0.0, 0.382_683_43, 0.923_879_5];
    let numbers: [[f32; 14]; 3] = [(identity, 0.0), (identity, 0.0), (turned, 0.5_f32.ln())]
        .map(|(q, log_scale_y)| [0.0, 0.0, 0.0, 0.0, log_scale_y, 0.0, q[0], q[1], q[2], q[3], 0.0, 0.0, 0.0, 0.0]);
    let turned_splat = Splat {
        // log2(e) / (2.8^2 - 1.5^2) times -2.8 / 2 and 1.5
        conic_xx: -0.361_318_97,
        conic_xy: 0.387_127_47,
        conic_yy: -0.361_318_97,
        rows_px: 3 | (12 << 16),
        columns_px: 3 | (12 << 16),
        extent_x: 5.210_513_6,
        extent_y: 5.210_513_6,
        slope: 1.5 / 2.8,
        half_px: 4.399_754,
        ..round_splat()
    };
    let mut behind = [SENTINEL; 16];
    behind[11] = u32::MAX;
    Case {
        kernel: Kernel::MakeSplats,
        nth_stage: 0,
        view: camera(),
        before: vec![
            (Buffer::Anchors, words_of(&[anchor(4.0, 0, 1, 1.0), anchor(-4.0, 0, 1, 1.0), anchor(4.0, 0, 1, 1.0)])),
            (Buffer::Keyframes, words_of(&[keyframe(1.0)])),
            (Buffer::Candidates, exact([0, 1, 2])),
            (Buffer::Effective, reals((0..14).flat_map(|i| numbers.map(|n| n[i])))),
            (Buffer::Counters, words_of(&[Counters { visible: 0, ..counters(3) }])),
        ],
        after: vec![
            (Buffer::Splats, [splat_words(&round_splat()), exact(behind), splat_words(&turned_splat)].concat()),
            (Buffer::Keys, exact([4.0_f32.to_bits(), u32::MAX, 4.0_f32.to_bits()])),
            (Buffer::Order, exact([0, 1, 2])),
            (Buffer::Counters, words_of(&[Counters { visible: 2, ..counters(3) }])),
        ],
        mutation: ["vec3<f32>(-0.5, -1.0, -0.5)", "vec3<f32>(-0.5, 1.0, -0.5)"],
    }
}
