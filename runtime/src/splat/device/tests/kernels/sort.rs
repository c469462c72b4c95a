//! Candidates by depth.

use super::{Case, counters, exact, picture, words_of};
use crate::splat::kernel_constants::{DIGITS, SORT_PIECES};
use crate::splat::kernels::Kernel;
use crate::splat::program::Buffer;

pub fn cases() -> Vec<Case> {
    vec![sort_count(), sort_scan(), sort_scatter()]
}

/// Counts of all pieces and digits, 0 but for these `(piece, digit, count)`.
fn counts(nonzero: &[(u32, u32, u32)]) -> Vec<u32> {
    let mut all = vec![0; (SORT_PIECES * DIGITS) as usize];
    for &(piece, digit, count) in nonzero {
        all[(piece * DIGITS + digit) as usize] = count;
    }
    all
}

fn sort_count() -> Case {
    // 1025 keys are two to a piece, and the piece in the middle has one. The second digit counts.
    let keys = (0..1025).map(|i| if i < 4 { [0x0511, 0x05ff, 0x0711, 0x12_0511][i] } else { 0x22 });
    let mut expected = vec![(0, 5, 2), (1, 7, 1), (1, 5, 1)];
    expected.extend((2..512).map(|piece| (piece, 0, 2)));
    expected.push((512, 0, 1));
    Case {
        kernel: Kernel::SortCount,
        nth_stage: 1,
        view: picture(16, 16),
        before: vec![(Buffer::Counters, words_of(&[counters(1025)])), (Buffer::KeysScratch, exact(keys))],
        after: vec![(Buffer::DigitCounts, exact(counts(&expected)))],
        mutation: ["keys[i] >> (digit * DIGIT_BITS)", "keys[i] << (digit * DIGIT_BITS)"],
    }
}

fn sort_scan() -> Case {
    let mut expected = counts(&[]);
    for piece in 0..SORT_PIECES {
        let at = (piece * DIGITS) as usize;
        expected[at + 3] = [0, 2, 3][usize::from(piece > 0) + usize::from(piece > 5)];
        expected[at] = if piece > 7 { 4 } else { 0 };
    }
    let total = |digit| match digit {
        0 => 4,
        3 => 3,
        _ => 0,
    };
    Case {
        kernel: Kernel::SortScan,
        nth_stage: 0,
        view: picture(16, 16),
        before: vec![(Buffer::DigitCounts, exact(counts(&[(0, 3, 2), (5, 3, 1), (7, 0, 4)])))],
        after: vec![(Buffer::DigitCounts, exact(expected)), (Buffer::DigitTotals, exact((0..DIGITS).map(total)))],
        mutation: ["next += here", "next -= here"],
    }
}

fn sort_scatter() -> Case {
    let total = |digit| match digit {
        0 | 1 => 1,
        5 => 2,
        _ => 0,
    };
    Case {
        kernel: Kernel::SortScatter,
        nth_stage: 0,
        view: picture(16, 16),
        before: vec![
            (Buffer::Counters, words_of(&[counters(4)])),
            (Buffer::Keys, exact([0x105, 0x201, 0x305, 0x400])),
            (Buffer::Order, exact([10, 11, 12, 13])),
            // The second five comes after the first.
            (Buffer::DigitCounts, exact(counts(&[(2, 5, 1)]))),
            (Buffer::DigitTotals, exact((0..DIGITS).map(total))),
        ],
        after: vec![
            (Buffer::KeysScratch, exact([0x400, 0x201, 0x105, 0x305])),
            (Buffer::OrderScratch, exact([13, 11, 10, 12])),
        ],
        mutation: ["digit_starts[d] + at", "digit_starts[d] - at"],
    }
}
