use super::*;
use crate::math::Rng;
use std::vec;
use std::vec::Vec;

const N_WORDS: usize = 40;

/// A place of these words, all of the same weight.
fn place(words: &[u16]) -> Signature {
    let words: Vec<_> = words.iter().map(|&word| WeightedWord { word, weight: 1000 }).collect();
    Signature::from_words(&words).expect("ascending")
}

/// Runs `check` on an index of so many slots.
fn with_index(n_slots: usize, check: impl FnOnce(&mut PlaceIndex<'_>)) {
    let mut postings = vec![Posting::UNUSED; n_slots * WORDS_PER_PLACE];
    let storage = PlaceStorage {
        slots: &mut vec![PlaceSlot::UNUSED; n_slots],
        postings: &mut postings,
        first_of_word: &mut [7; N_WORDS],
    };
    check(&mut PlaceIndex::new(storage).expect("long enough"));
}

fn found(index: &mut PlaceIndex<'_>, view: &Signature, last: u32, n_hits: usize) -> Vec<(u32, u32)> {
    let mut hits = vec![PlaceHit::default(); n_hits];
    let n = index.find(view, last, &mut hits);
    hits[..n].iter().map(|hit| (hit.ordinal, hit.score)).collect()
}

#[test]
fn what_shares_more_words_comes_first() {
    with_index(4, |index| {
        assert_eq!(found(index, &place(&[1, 2, 3]), 99, 4), []);
        for (ordinal, words) in [(10, [1, 2, 3]), (20, [3, 4, 5]), (30, [2, 3, 4])] {
            assert_eq!(index.remember(ordinal, &place(&words)), Remembered::Added);
        }
        let view = place(&[2, 3, 9]);
        assert_eq!(found(index, &view, 99, 4), [(10, 2000), (30, 2000), (20, 1000)]);
        assert_eq!(found(index, &view, 99, 2), [(10, 2000), (30, 2000)]);
        assert_eq!(found(index, &view, 29, 4), [(10, 2000), (20, 1000)]);
        assert_eq!(found(index, &place(&[11]), 99, 4), []);
        assert_eq!(index.like_newest(&view), Some(PlaceHit { ordinal: 30, score: 2000 }));
        assert_eq!(index.remember(30, &view), Remembered::NotLater { newest: 30 });
        assert_eq!(index.len(), 3);
    });
}

#[test]
fn what_is_most_like_its_neighbours_gives_way() {
    with_index(4, |index| {
        for (ordinal, words) in [(0, [1, 2, 3]), (1, [1, 2, 4]), (2, [1, 2, 5]), (3, [7, 8, 9])] {
            index.remember(ordinal, &place(&words));
        }
        // Similarities of neighbours: 2, 2, 0: keyframe 1 has the most, and then 2 stands between 0 and 3.
        assert_eq!(index.remember(4, &place(&[7, 8, 10])), Remembered::Instead { of: 1 });
        assert_eq!(found(index, &place(&[1, 2, 4]), 99, 4), [(0, 2000), (2, 2000)]);
        // Now 2, 0, 2: 2 and 3 are equal, and 2 has the lower slot.
        assert_eq!(index.remember(5, &place(&[20])), Remembered::Instead { of: 2 });
        // 0, 2, 0: 3 is like 4, and so is 4.
        assert_eq!(index.remember(6, &place(&[20])), Remembered::Instead { of: 4 });
        assert_eq!(found(index, &place(&[1, 7, 20]), 99, 4), [(0, 1000), (3, 1000), (5, 1000), (6, 1000)]);
    });
}

/// The index against a list that is searched from end to end, over many evictions.
#[test]
fn the_lists_stay_whole_when_keyframes_come_and_go() {
    let mut rng = Rng::new(5, 0, 0);
    with_index(16, |index| {
        let mut kept: Vec<(u32, Signature)> = Vec::new();
        for ordinal in 0..400 {
            let words: Vec<u16> = (0..N_WORDS as u16).filter(|_| rng.below(3) == 0).collect();
            let view = place(&words);
            let mut expected: Vec<_> = kept
                .iter()
                .map(|(o, s)| (*o, similarity(view.words().iter().copied(), s.words().iter().copied())))
                .filter(|&(o, score)| score > 0 && o + 5 <= ordinal)
                .collect();
            expected.sort_by_key(|&(o, score)| (core::cmp::Reverse(score), o));
            expected.truncate(6);
            let last = ordinal.saturating_sub(5);
            let expected = if ordinal < 5 { Vec::new() } else { expected };
            if ordinal >= 5 {
                assert_eq!(found(index, &view, last, 6), expected, "keyframe {ordinal}");
            }
            if let Remembered::Instead { of } = index.remember(ordinal, &view) {
                kept.retain(|(o, _)| *o != of);
            }
            kept.push((ordinal, view));
            assert_eq!(index.len(), kept.len());
        }
        assert_eq!(index.len(), 16);
    });
}

#[test]
fn words_that_the_vocabulary_does_not_have_are_left_out() {
    with_index(3, |index| {
        index.remember(1, &place(&[3, N_WORDS as u16, 900]));
        assert_eq!(found(index, &place(&[3, N_WORDS as u16, 900]), 9, 3), [(1, 1000)]);
        for ordinal in 2..9 {
            index.remember(ordinal, &place(&[3, 900]));
        }
        assert_eq!(found(index, &place(&[3]), 99, 9).len(), 3);
    });
}

#[test]
fn slices_that_do_not_fit_are_named() {
    for (n_slots, n_postings, error) in [
        (2, 999, PlaceStorageTooSmall { found: 2, needed: 3 }),
        (3, 191, PlaceStorageTooSmall { found: 191, needed: 192 }),
    ] {
        let storage = PlaceStorage {
            slots: &mut vec![PlaceSlot::UNUSED; n_slots],
            postings: &mut vec![Posting::UNUSED; n_postings],
            first_of_word: &mut [],
        };
        assert_eq!(PlaceIndex::new(storage).err(), Some(error));
    }
}
