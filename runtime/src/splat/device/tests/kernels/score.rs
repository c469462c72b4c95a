//! Scores of the anchors.

use super::blend::flat;
use super::project::round_splat;
use super::{Case, counters, exact, picture, reals, words_of};
use crate::splat::kernels::Kernel;
use crate::splat::layout::{Counters, Splat, ViewBlock};
use crate::splat::program::Buffer;

pub fn cases() -> Vec<Case> {
    vec![score_anchors(), measure_anchors()]
}

fn score_anchors() -> Case {
    let splats = [
        flat(-1.0, [0.0; 3], 1.0),
        // 1/128: enough to be seen, but not through the first one's half.
        flat(-7.0, [0.0; 3], 2.0),
        // 0.96, the second time through 0.04 of it and the third time through too little.
        flat(-0.058_893_69, [0.0; 3], 3.0),
    ];
    let (left, right) = (1, 2);
    let pairs = [0, left, 1, left, 1, right, 2, right, 2, right, 2, right];
    // Off by 0.9 and 0.5 in sum; the last two of eight columns are wrong.
    let row = [0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.9, 0.9];
    let exposed: Vec<f32> = row.into_iter().cycle().take(32).chain([0.25; 64]).collect();
    let target = [[0.0; 32], [0.25; 32], [0.25; 32]].concat();
    Case {
        kernel: Kernel::ScoreAnchors,
        nth_stage: 0,
        view: ViewBlock { error_threshold: 0.2, k: 2, ..picture(8, 4) },
        before: vec![
            (Buffer::Splats, words_of(&splats)),
            (Buffer::TileStarts, exact([0, 6])),
            (Buffer::Pairs, exact(pairs)),
            // Of slots 0, 1 and 2.
            (Buffer::Candidates, exact([0, 3, 5])),
            (Buffer::ExposedPlanes, reals(exposed)),
            (Buffer::TargetPlanes, reals(target)),
            (Buffer::Counters, words_of(&[counters(3)])),
            (Buffer::AnchorScores, exact([0; 9])),
        ],
        after: vec![
            (Buffer::AnchorScores, exact([16, 0, 0, 16, 8, 0, 32, 16, 0])),
            (Buffer::Counters, words_of(&[Counters { masked_pixels: 8, ..counters(3) }])),
        ],
        mutation: ["error > 3.0 *", "error < 3.0 *"],
    }
}

fn measure_anchors() -> Case {
    let upright = Splat { extent_x: 3.0, extent_y: 9.0, ..round_splat() };
    let unseen = Splat { extent_x: 50.0, columns_px: u32::MAX, ..round_splat() };
    Case {
        kernel: Kernel::MeasureAnchors,
        nth_stage: 0,
        view: ViewBlock { k: 2, ..picture(16, 16) },
        before: vec![
            (Buffer::Counters, words_of(&[counters(4)])),
            // Of slots 0, 1, 1 and 0.
            (Buffer::Candidates, exact([0, 2, 3, 1])),
            (Buffer::Splats, words_of(&[round_splat(), upright, unseen, Splat { extent_x: 1.0, ..upright }])),
            (Buffer::AnchorScores, exact([0; 6])),
        ],
        after: vec![(Buffer::AnchorScores, [exact([0, 0]), reals([9.0]), exact([0, 0]), reals([9.0])].concat())],
        mutation: ["max(splats[id.x].extent_x", "min(splats[id.x].extent_x"],
    }
}
