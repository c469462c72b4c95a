//! From slots to candidates.

use super::{Case, counters, exact, picture, reals, words_of};
use crate::splat::kernels::Kernel;
use crate::splat::layout::{Counters, DeviceAnchor, KeyframeBlock, ViewBlock};
use crate::splat::program::Buffer;

pub fn cases() -> Vec<Case> {
    vec![cull(), scan_candidates(), list_candidates(), gather_params()]
}

/// An anchor on the optical axis.
pub fn anchor(z_m: f32, level: u32, n_gaussians: u32, extent_m: f32) -> DeviceAnchor {
    DeviceAnchor {
        position_z: z_m,
        extent_x: extent_m,
        extent_y: extent_m,
        extent_z: extent_m,
        packed: level | (n_gaussians << 8),
        ..DeviceAnchor::default()
    }
}

/// A keyframe where the camera is, of this scale.
pub fn keyframe(scale: f32) -> KeyframeBlock {
    KeyframeBlock { row_x: [scale, 0.0, 0.0, 0.0], row_y: [0.0, scale, 0.0, 0.0], row_z: [0.0, 0.0, scale, 0.0] }
}

/// Numbers of a Gaussian that is shifted to the side.
fn shifted(offset_x: f32) -> [f32; 14] {
    let mut numbers = [0.0; 14];
    numbers[0] = offset_x;
    numbers
}

fn cull() -> Case {
    let view = ViewBlock {
        n_slots: 6,
        k: 2,
        focal_px: [10.0; 2],
        center_px: [10.0; 2],
        stretch_px: [10.0; 2],
        ..picture(20, 20)
    };
    let anchors = [
        anchor(5.0, 0, 2, 1.0),
        anchor(5.0, 0, 0, 1.0),
        anchor(-1.0, 0, 2, 1.0),
        // The second level begins at 20 m.
        anchor(5.0, 1, 2, 1.0),
        anchor(5.0, 0, 2, 1.0),
        DeviceAnchor { keyframe_row: 1, ..anchor(2.5, 0, 2, 0.5) },
    ];
    // At 5 m, 1 m is 2 px. A standard deviation of 1 m reaches 3.33 sqrt(4.3) + 1 = 7.9 px beyond the border: the
    // Gaussian at column -7 may be seen, that at column -8 not. The last keyframe's metres are twice as long.
    let params = [
        shifted(0.0),
        shifted(100.0),
        shifted(0.0),
        shifted(0.0),
        shifted(0.0),
        shifted(0.0),
        shifted(0.0),
        shifted(0.0),
        shifted(0.0),
        shifted(-8.5),
        shifted(-8.5),
        shifted(-9.0),
    ];
    Case {
        kernel: Kernel::Cull,
        nth_stage: 0,
        view,
        before: vec![
            (Buffer::Anchors, words_of(&anchors)),
            (Buffer::Params, reals(params.as_flattened().iter().copied())),
            (Buffer::Keyframes, words_of(&[keyframe(1.0), keyframe(2.0)])),
        ],
        after: vec![(Buffer::VisibleBits, exact([0b01, 0, 0, 0, 0b11, 0b01])), (Buffer::GroupTotals, exact([4]))],
        mutation: ["MAX_SIGMAS * sigma_px + 1.0", "MAX_SIGMAS * sigma_px - 1.0"],
    }
}

fn scan_candidates() -> Case {
    // More groups than invocations, so that some invocations have two.
    Case {
        kernel: Kernel::ScanCandidates,
        nth_stage: 0,
        view: ViewBlock { n_slots: 258 * 256, candidate_capacity: 300, ..picture(16, 16) },
        before: vec![
            (Buffer::GroupTotals, exact([2; 258])),
            (Buffer::Counters, words_of(&[Counters { visible: 7, ..Counters::default() }])),
        ],
        after: vec![
            (Buffer::GroupTotals, exact((0..258).map(|group| 2 * group))),
            (
                Buffer::Counters,
                words_of(&[Counters { candidates_needed: 516, candidates: 300, visible: 7, ..Counters::default() }]),
            ),
            (Buffer::Dispatch, exact([2, 1, 1])),
        ],
        mutation: ["min(needed, view.candidate_capacity)", "max(needed, view.candidate_capacity)"],
    }
}

fn list_candidates() -> Case {
    let bits = |slot: u32| match slot {
        0 => 0b101,
        2 => 0b010,
        299 => 0b011,
        _ => 0,
    };
    // The fifth candidate does not fit.
    Case {
        kernel: Kernel::ListCandidates,
        nth_stage: 0,
        view: ViewBlock { n_slots: 300, k: 3, candidate_capacity: 4, ..picture(16, 16) },
        before: vec![(Buffer::VisibleBits, exact((0..300).map(bits))), (Buffer::GroupTotals, exact([0, 3]))],
        after: vec![(Buffer::Candidates, exact([0, 2, 7, 897]))],
        mutation: ["id.x * view.k + firstTrailingBit(bits)", "id.x * view.k - firstTrailingBit(bits)"],
    }
}

fn gather_params() -> Case {
    let number = |gaussian: usize, i: usize| (14 * gaussian + i) as f32;
    Case {
        kernel: Kernel::GatherParams,
        nth_stage: 0,
        view: ViewBlock { candidate_capacity: 2, ..picture(16, 16) },
        before: vec![
            (Buffer::Params, reals((0..3 * 14).map(|i| number(0, i)))),
            (Buffer::Candidates, exact([2, 0])),
            (Buffer::Counters, words_of(&[counters(2)])),
        ],
        after: vec![(Buffer::Effective, reals((0..14).flat_map(|i| [number(2, i), number(0, i)])))],
        mutation: ["params[first_number + i]", "params[first_number - i]"],
    }
}
