//! What a place looks like, in at most 64 weighted words.

use super::vocabulary::{Vocabulary, Word};
use crate::features::Feature;
use heapless::Vec;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

/// Words that describe a place.
pub const WORDS_PER_PLACE: usize = 64;

/// Weights of one place add up to no more than this.
pub const WHOLE: u32 = u16::MAX as u32;

/// A word and how much of a place it is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct WeightedWord {
    /// The word.
    pub word: Word,
    /// Its share of the place, of [`WHOLE`].
    pub weight: u16,
}

/// The words of a place in ascending order, each once.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Signature {
    words: Vec<WeightedWord, WORDS_PER_PLACE>,
}

impl Signature {
    /// The words of the strongest corners among `features`, weighted by how often they are here and how rare elsewhere.
    ///
    /// # Inputs
    /// * `tally`: scratch; what of `features` is beyond its length is not looked at.
    ///
    /// # Cost
    /// O(features * (branching * depth + 64)).
    ///
    /// # Source
    /// Sivic & Zisserman 2003 (tf-idf). The choice of words is ours: of the strongest corners, more are found again in another
    /// image than of the rarest or of the most frequent words (docs/loop_closure.md).
    pub fn of(vocabulary: &Vocabulary<'_>, features: &[Feature], tally: &mut [Tally]) -> Self {
        let n = features.len().min(tally.len());
        let Some(tally) = tally.get_mut(..n) else { return Self::default() };
        for (tally, (i, feature)) in tally.iter_mut().zip((0..).zip(features)) {
            let (word, rarity) = vocabulary.word_of(&feature.descriptor);
            *tally = Tally { word, weight: u32::from(rarity), strength: feature.min_eigenvalue, feature: i };
        }
        tally.sort_unstable_by(|a, b| b.strength.total_cmp(&a.strength).then(a.feature.cmp(&b.feature)));
        let mut n_words = 0;
        for i in 0..n {
            let next = tally[i];
            if let Some(known) = tally[..n_words].iter_mut().find(|known| known.word == next.word) {
                known.weight += next.weight;
            } else if n_words < WORDS_PER_PLACE && next.weight > 0 {
                tally[n_words] = next;
                n_words += 1;
            }
        }
        Self::normalized(&mut tally[..n_words])
    }

    fn normalized(tally: &mut [Tally]) -> Self {
        let sum: u64 = tally.iter().map(|t| u64::from(t.weight)).sum();
        tally.sort_unstable_by_key(|t| t.word);
        let share = |t: &Tally| (u64::from(WHOLE) * u64::from(t.weight)).checked_div(sum).unwrap_or(0) as u16;
        let words = tally.iter().map(|t| WeightedWord { word: t.word, weight: share(t) });
        Self { words: words.filter(|w| w.weight > 0).collect() }
    }

    /// Words that were stored; `None` when they are too many, out of order or weigh too much.
    pub fn from_words(words: &[WeightedWord]) -> Option<Self> {
        let sum: u32 = words.iter().map(|w| u32::from(w.weight)).sum();
        let ascends = words.windows(2).all(|pair| matches!(pair, [a, b] if a.word < b.word));
        let words = Vec::from_slice(words).ok()?;
        (ascends && sum <= WHOLE).then_some(Self { words })
    }

    /// Its words in ascending order.
    pub fn words(&self) -> &[WeightedWord] {
        &self.words
    }
}

/// Scratch of [`Signature::of`]: a word and its weight so far.
#[derive(Clone, Copy, Debug, Default)]
pub struct Tally {
    word: Word,
    weight: u32,
    strength: f32,
    feature: u32,
}

/// How alike two places are, of [`WHOLE`]; both in ascending order of words.
///
/// # Source
/// Galvez-Lopez & Tardos 2012, eq. 2: `1 - |a - b|_1 / 2`, which for weights that add up to one is the sum of the smaller
/// ones (Nister & Stewenius 2006).
pub fn similarity(a: impl IntoIterator<Item = WeightedWord>, b: impl IntoIterator<Item = WeightedWord>) -> u32 {
    let mut b = b.into_iter().peekable();
    let mut sum = 0;
    for a in a {
        while b.next_if(|b| b.word < a.word).is_some() {}
        if let Some(b) = b.next_if(|b| b.word == a.word) {
            sum += u32::from(a.weight.min(b.weight));
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::super::vocabulary::tests::{VOCABULARY, feature_of, open};
    use super::*;
    use std::vec;
    use std::vec::Vec;

    fn check(words: &[u64], expected: &[(Word, u16)]) {
        let bytes = VOCABULARY();
        let features: Vec<_> = words.iter().map(|&word| feature_of(word)).collect();
        let signature = Signature::of(&open(&bytes), &features, &mut vec![Tally::default(); words.len()]);
        let found: Vec<_> = signature.words().iter().map(|w| (w.word, w.weight)).collect();
        assert_eq!(found, expected, "{words:?}");
    }

    #[test]
    fn words_weigh_as_often_as_they_are_here_and_as_rare_as_they_are_elsewhere() {
        // The test's words are as rare as their number, and word 0 is in every image.
        check(&[], &[]);
        check(&[0, 0, 0], &[]);
        check(&[2], &[(2, 65535)]);
        check(&[3, 1], &[(1, 16383), (3, 49151)]);
        check(&[1, 0, 3, 1, 1], &[(1, 32767), (3, 32767)]);
    }

    #[test]
    fn several_corners_of_a_word_weigh_together() {
        let bytes = VOCABULARY();
        let feature = |word, min_eigenvalue| Feature { min_eigenvalue, ..feature_of(word) };
        let features = [feature(1, 1.0), feature(2, 5.0), feature(3, 3.0), feature(2, 2.0)];
        let signature = Signature::of(&open(&bytes), &features, &mut [Tally::default(); 4]);
        let found: Vec<_> = signature.words().iter().map(|w| (w.word, w.weight)).collect();
        assert_eq!(found, [(1, 8191), (2, 32767), (3, 24575)]);
    }

    #[test]
    fn similarity_is_what_is_common_to_both() {
        let words = |list: &[(Word, u16)]| -> Vec<_> {
            list.iter().map(|&(word, weight)| WeightedWord { word, weight }).collect()
        };
        for (a, b, expected) in [
            (&[][..], &[(1, 5)][..], 0),
            (&[(1, 5)], &[(1, 7)], 5),
            (&[(1, 5), (4, 9), (8, 2)], &[(0, 1), (4, 3), (7, 7), (8, 9)], 5),
        ] {
            assert_eq!(similarity(words(a), words(b)), expected, "{a:?} {b:?}");
            assert_eq!(similarity(words(b), words(a)), expected, "{b:?} {a:?}");
        }
    }

    #[test]
    fn words_out_of_order_are_refused() {
        let word = |word, weight| WeightedWord { word, weight };
        assert!(Signature::from_words(&[word(1, 5), word(2, 5)]).is_some());
        for words in [&[word(2, 5), word(1, 5)][..], &[word(1, 5); 2], &[word(1, 65000), word(2, 65000)]] {
            assert_eq!(Signature::from_words(words), None, "{words:?}");
        }
        let many: Vec<_> = (0..65).map(|i| word(i, 1)).collect();
        assert_eq!(Signature::from_words(&many), None);
    }
}
