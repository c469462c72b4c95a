//! Splats per row of tiles and per tile.

use super::{Case, Word, counters, exact, picture, words_of};
use crate::splat::kernels::Kernel;
use crate::splat::layout::{Counters, Splat, ViewBlock};
use crate::splat::program::Buffer;

pub fn cases() -> Vec<Case> {
    vec![count_entries(), scan_entries(), list_entries(), count_pairs(), scan_pairs(), list_pairs()]
}

/// A round splat, with the pixel rows of its box.
fn disc(mean_px: [f32; 2], radius_px: f32, rows_px: [u32; 2]) -> Splat {
    Splat {
        mean_x: mean_px[0],
        mean_y: mean_px[1],
        conic_xx: -1.0,
        conic_yy: -1.0,
        rows_px: rows_px[0] | (rows_px[1] << 16),
        extent_x: radius_px,
        extent_y: radius_px,
        half_px: radius_px,
        ..Splat::default()
    }
}

/// Two rows of tiles; the first splat is in the upper one, the second in both, the third begins with the lower one.
fn three_discs() -> Vec<Word> {
    words_of(&[disc([8.0, 8.0], 6.0, [2, 13]), disc([16.0, 16.0], 6.0, [10, 21]), disc([8.0, 22.0], 6.0, [16, 27])])
}

/// Numbers of pieces, the last of which goes on to the end.
fn pieces(first: &[u32], n: usize) -> impl Iterator<Item = u32> {
    let last = first[first.len() - 1];
    first.iter().copied().chain(core::iter::repeat(last)).take(n)
}

fn count_entries() -> Case {
    let offsets = pieces(&[0, 0, 1, 2], 256).chain(pieces(&[0, 1, 1, 2], 256));
    Case {
        kernel: Kernel::CountEntries,
        nth_stage: 0,
        view: picture(32, 32),
        before: vec![
            (Buffer::Counters, words_of(&[counters(3)])),
            (Buffer::Order, exact([2, 0, 1])),
            (Buffer::Splats, three_discs()),
        ],
        after: vec![(Buffer::EntryOffsets, exact(offsets)), (Buffer::EntryStarts, exact([2, 2]))],
        mutation: ["(rows & 0xffffu) < top + TILE_PX", "(rows & 0xffffu) <= top + TILE_PX"],
    }
}

fn scan_entries() -> Case {
    Case {
        kernel: Kernel::ScanEntries,
        nth_stage: 0,
        view: ViewBlock { entry_capacity: 5, ..picture(16, 48) },
        before: vec![(Buffer::EntryStarts, exact([4, 0, 3])), (Buffer::Counters, words_of(&[counters(1)]))],
        after: vec![
            (Buffer::EntryStarts, exact([0, 4, 4, 5])),
            (Buffer::Counters, words_of(&[Counters { entries_needed: 7, ..counters(1) }])),
        ],
        mutation: ["min(start, view.entry_capacity)", "max(start, view.entry_capacity)"],
    }
}

fn list_entries() -> Case {
    let offsets = pieces(&[0, 0, 1, 2], 256).chain(pieces(&[0, 1, 1, 2], 256));
    let both = 1 << 16;
    // The second disc reaches from column 10 to 21. The fourth entry does not fit.
    Case {
        kernel: Kernel::ListEntries,
        nth_stage: 0,
        view: ViewBlock { entry_capacity: 3, ..picture(32, 32) },
        before: vec![
            (Buffer::Counters, words_of(&[counters(3)])),
            (Buffer::Order, exact([2, 0, 1])),
            (Buffer::Splats, three_discs()),
            (Buffer::EntryOffsets, exact(offsets)),
            (Buffer::EntryStarts, exact([0, 2, 3])),
        ],
        after: vec![(Buffer::Entries, exact([0, 0, 1, both, 2, 0]))],
        mutation: ["((u32(columns.y) / TILE_PX) << 16u)", "((u32(columns.y) / TILE_PX) >> 16u)"],
    }
}

/// Entries over two columns of tiles: in both, in the second, in none.
const THREE_ENTRIES: [u32; 6] = [2, 1 << 16, 0, 1 | (1 << 16), 1, 1];

fn count_pairs() -> Case {
    Case {
        kernel: Kernel::CountPairs,
        nth_stage: 0,
        view: picture(32, 16),
        before: vec![(Buffer::EntryStarts, exact([0, 3])), (Buffer::Entries, exact(THREE_ENTRIES))],
        after: vec![
            (Buffer::PairOffsets, exact(pieces(&[0, 1], 64).chain(pieces(&[0, 1, 2], 64)))),
            (Buffer::TileStarts, exact([1, 2])),
        ],
        mutation: ["column <= last_tile(e)", "column < last_tile(e)"],
    }
}

fn scan_pairs() -> Case {
    // More tiles than invocations, so that some invocations have two.
    Case {
        kernel: Kernel::ScanPairs,
        nth_stage: 0,
        view: ViewBlock { pair_capacity: 500, ..picture(272, 272) },
        before: vec![(Buffer::TileStarts, exact([2; 289])), (Buffer::Counters, words_of(&[counters(1)]))],
        after: vec![
            (Buffer::TileStarts, exact((0..=289).map(|tile| 500.min(2 * tile)))),
            (Buffer::Counters, words_of(&[Counters { pairs_needed: 578, ..counters(1) }])),
        ],
        mutation: ["next += here", "next -= here"],
    }
}

fn list_pairs() -> Case {
    let splats = [disc([20.0, 8.0], 3.0, [5, 10]), disc([0.0, 0.0], 1.0, [0, 0]), disc([16.0, 8.0], 6.0, [2, 13])];
    // A digit per row of blocks, the lowest last. The large disc reaches from column 10 to 21, two blocks to each side; in
    // its first and last row of blocks, where it is narrower, from 12 to 19. The small one reaches from column 17 to 22.
    let pairs = [2, 0x8cc8, 2, 0x1331, 0, 0x0330];
    Case {
        kernel: Kernel::ListPairs,
        nth_stage: 0,
        view: ViewBlock { pair_capacity: 4, ..picture(32, 16) },
        before: vec![
            (Buffer::Splats, words_of(&splats)),
            (Buffer::EntryStarts, exact([0, 3])),
            (Buffer::Entries, exact(THREE_ENTRIES)),
            (Buffer::PairOffsets, exact(pieces(&[0, 1], 64).chain(pieces(&[0, 1, 2], 64)))),
            (Buffer::TileStarts, exact([0, 1, 3])),
            (Buffer::Counters, words_of(&[counters(3)])),
        ],
        after: vec![
            (Buffer::Pairs, exact(pairs)),
            (Buffer::Counters, words_of(&[Counters { pairs: 3, ..counters(3) }])),
        ],
        mutation: ["(2u << (u32(high) / BLOCK_PX))", "(1u << (u32(high) / BLOCK_PX))"],
    }
}
