//! Which stored places share words with a view: an inverted index of fixed capacity.
//!
//! A keyframe takes a slot with room for 64 postings; the postings of a word form a list. Keyframes also form a chain in
//! the order in which they came. When all slots are taken, the keyframe that is most like its two neighbours in the chain
//! gives way (`evict-worst`): streets that were driven slowly thin out first, and no street is forgotten.

use super::signature::{Signature, WORDS_PER_PLACE, WeightedWord, similarity};
use core::fmt;

/// End of a list.
const NONE: u32 = u32::MAX;

/// Fewest keyframes that an index can hold: one that gives way, and its neighbours.
const FEWEST_SLOTS: usize = 3;

/// A word of a keyframe, and the next keyframe with it.
#[derive(Clone, Copy, Debug)]
pub struct Posting {
    next: u32,
    word: WeightedWord,
}

/// A keyframe in the index.
#[derive(Clone, Copy, Debug)]
pub struct PlaceSlot {
    ordinal: u32,
    n_words: u32,
    earlier: u32,
    later: u32,
    /// Similarity with the later one.
    like_later: u32,
    /// Similarity with the view that was asked about last.
    score: u32,
}

impl Posting {
    /// Fills storage that is still to be written.
    pub const UNUSED: Self = Self { next: NONE, word: WeightedWord { word: 0, weight: 0 } };
}

impl PlaceSlot {
    /// Fills storage that is still to be written.
    pub const UNUSED: Self = Self { ordinal: 0, n_words: 0, earlier: NONE, later: NONE, like_later: 0, score: 0 };
}

/// Memory of a [`PlaceIndex`].
#[derive(Debug)]
pub struct PlaceStorage<'m> {
    /// Bounds how many keyframes are remembered; at least three.
    pub slots: &'m mut [PlaceSlot],
    /// [`WORDS_PER_PLACE`] for every slot.
    pub postings: &'m mut [Posting],
    /// One for every word of the vocabulary.
    pub first_of_word: &'m mut [u32],
}

/// Bytes per keyframe of a [`PlaceStorage`].
pub const BYTES_PER_PLACE: usize = size_of::<PlaceSlot>() + WORDS_PER_PLACE * size_of::<Posting>();
const _: () = assert!(BYTES_PER_PLACE == 536);

/// Bytes of all slices of a [`PlaceStorage`].
pub const fn index_bytes(n_places: usize, n_words: usize) -> usize {
    n_places * BYTES_PER_PLACE + n_words * size_of::<u32>()
}

/// A slice of a [`PlaceStorage`] is too short: a mistake of the caller, to be mended there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PlaceStorageTooSmall {
    /// Elements that are there.
    pub found: u32,
    /// Elements that are needed.
    pub needed: u32,
}

impl fmt::Display for PlaceStorageTooSmall {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "a slice of the index of places has {} elements, {} needed", self.found, self.needed)
    }
}

impl core::error::Error for PlaceStorageTooSmall {}

/// A keyframe that looks like a view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PlaceHit {
    /// Which keyframe.
    pub ordinal: u32,
    /// How alike they are, of [`super::WHOLE`].
    pub score: u32,
}

/// What became of a keyframe that was to be remembered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Remembered {
    /// There was room.
    Added,
    /// Another keyframe gave way: its record is no longer needed.
    Instead {
        /// Which one.
        of: u32,
    },
    /// Ordinals ascend, and this one does not: nothing was changed.
    NotLater {
        /// The newest one.
        newest: u32,
    },
}

/// Keyframes by their words.
#[derive(Debug)]
pub struct PlaceIndex<'m> {
    storage: PlaceStorage<'m>,
    n_used: usize,
    newest: u32,
}

impl<'m> PlaceIndex<'m> {
    /// An index that has seen nothing, for vocabularies of up to as many words as `first_of_word` is long.
    ///
    /// # Errors
    /// [`PlaceStorageTooSmall`] when the slices do not fit each other.
    pub fn new(storage: PlaceStorage<'m>) -> Result<Self, PlaceStorageTooSmall> {
        let n = storage.slots.len();
        for (found, needed) in [(n, FEWEST_SLOTS), (storage.postings.len(), n * WORDS_PER_PLACE)] {
            if found < needed {
                return Err(PlaceStorageTooSmall { found: found as u32, needed: needed as u32 });
            }
        }
        storage.first_of_word.fill(NONE);
        Ok(Self { storage, n_used: 0, newest: NONE })
    }

    /// Keyframes that are remembered.
    pub fn len(&self) -> usize {
        self.n_used
    }

    /// Whether nothing is remembered.
    pub fn is_empty(&self) -> bool {
        self.n_used == 0
    }

    /// The newest keyframe and how alike it is to a view.
    pub fn like_newest(&self, view: &Signature) -> Option<PlaceHit> {
        let slot = self.storage.slots.get(self.newest as usize)?;
        let score = similarity(view.words().iter().copied(), self.words(self.newest));
        Some(PlaceHit { ordinal: slot.ordinal, score })
    }

    /// Keyframes up to `last_ordinal` that share words with a view.
    ///
    /// # Output
    /// The front of `hits`, best first, at equal scores the older first; their number. What does not fit is left out.
    ///
    /// # Cost
    /// O(slots + postings of the view's words); no allocation.
    ///
    /// # Source
    /// Galvez-Lopez & Tardos 2012, sec. IV; scores as in [`similarity`].
    pub fn find(&mut self, view: &Signature, last_ordinal: u32, hits: &mut [PlaceHit]) -> usize {
        let PlaceStorage { slots, postings, first_of_word } = &mut self.storage;
        let slots = slots.get_mut(..self.n_used).unwrap_or(&mut []);
        slots.iter_mut().for_each(|slot| slot.score = 0);
        for wanted in view.words() {
            let mut at = first_of_word.get(usize::from(wanted.word)).copied().unwrap_or(NONE);
            while let Some(posting) = postings.get(at as usize) {
                if let Some(slot) = slots.get_mut(at as usize / WORDS_PER_PLACE) {
                    slot.score += u32::from(posting.word.weight.min(wanted.weight));
                }
                at = posting.next;
            }
        }
        let mut n = 0;
        for slot in slots.iter().filter(|slot| slot.score > 0 && slot.ordinal <= last_ordinal) {
            let hit = PlaceHit { ordinal: slot.ordinal, score: slot.score };
            let is_better = |kept: &PlaceHit| (kept.score, hit.ordinal) > (hit.score, kept.ordinal);
            let place = hits.get(..n).unwrap_or(&[]).partition_point(is_better);
            if place < hits.len() {
                n = (n + 1).min(hits.len());
                hits[place..n].rotate_right(1);
                hits[place] = hit;
            }
        }
        n
    }

    /// Remembers a keyframe that is later than all before it.
    ///
    /// # Cost
    /// O(64), and O(slots + postings of the words of what gives way) when all slots are taken.
    pub fn remember(&mut self, ordinal: u32, view: &Signature) -> Remembered {
        if let Some(newest) = self.storage.slots.get(self.newest as usize)
            && newest.ordinal >= ordinal
        {
            return Remembered::NotLater { newest: newest.ordinal };
        }
        let (slot_idx, outcome) = if self.n_used < self.storage.slots.len() {
            self.n_used += 1;
            (self.n_used as u32 - 1, Remembered::Added)
        } else {
            let worst = self.most_redundant();
            (worst, Remembered::Instead { of: self.forget(worst) })
        };
        let like_newest = self.like_newest(view).map_or(0, |hit| hit.score);
        let earlier = core::mem::replace(&mut self.newest, slot_idx);
        if let Some(slot) = self.storage.slots.get_mut(earlier as usize) {
            (slot.later, slot.like_later) = (slot_idx, like_newest);
        }
        let PlaceStorage { slots, postings, first_of_word } = &mut self.storage;
        let mut n_words = 0;
        for &word in view.words() {
            let at = slot_idx as usize * WORDS_PER_PLACE + n_words;
            if let (Some(first), Some(posting)) = (first_of_word.get_mut(usize::from(word.word)), postings.get_mut(at))
            {
                *posting = Posting { next: core::mem::replace(first, at as u32), word };
                n_words += 1;
            }
        }
        if let Some(slot) = slots.get_mut(slot_idx as usize) {
            *slot = PlaceSlot { ordinal, n_words: n_words as u32, earlier, ..PlaceSlot::UNUSED };
        }
        outcome
    }

    /// The slot whose keyframe is most like both neighbours, of several the first; ends of the chain have to stay.
    fn most_redundant(&self) -> u32 {
        let slots = &*self.storage.slots;
        let redundancy = |slot: &PlaceSlot| {
            let earlier = slots.get(slot.earlier as usize)?;
            (slot.later != NONE).then_some(earlier.like_later + slot.like_later)
        };
        let (mut worst, mut most) = (0, None);
        for (i, slot) in slots.iter().enumerate() {
            let redundancy = redundancy(slot);
            if redundancy > most {
                (worst, most) = (i as u32, redundancy);
            }
        }
        worst
    }

    /// Takes a keyframe out of its lists; its ordinal.
    fn forget(&mut self, slot_idx: u32) -> u32 {
        let Some(&slot) = self.storage.slots.get(slot_idx as usize) else { return NONE };
        let PlaceStorage { postings, first_of_word, .. } = &mut self.storage;
        let begin = slot_idx * WORDS_PER_PLACE as u32;
        for gone in begin..begin + slot.n_words {
            let Some(&Posting { next, word }) = postings.get(gone as usize) else { continue };
            let Some(first) = first_of_word.get_mut(usize::from(word.word)) else { continue };
            if *first == gone {
                *first = next;
                continue;
            }
            let mut at = *first;
            while let Some(posting) = postings.get_mut(at as usize) {
                if posting.next == gone {
                    posting.next = next;
                    break;
                }
                at = posting.next;
            }
        }
        let like_later = similarity(self.words(slot.earlier), self.words(slot.later));
        let slots = &mut *self.storage.slots;
        if let Some(earlier) = slots.get_mut(slot.earlier as usize) {
            (earlier.later, earlier.like_later) = (slot.later, like_later);
        }
        if let Some(later) = slots.get_mut(slot.later as usize) {
            later.earlier = slot.earlier;
        }
        slot.ordinal
    }

    /// Words of a slot; none of a slot that does not exist.
    fn words(&self, slot_idx: u32) -> impl Iterator<Item = WeightedWord> {
        let n = self.storage.slots.get(slot_idx as usize).map_or(0, |slot| slot.n_words as usize);
        let begin = (slot_idx as usize).saturating_mul(WORDS_PER_PLACE);
        self.storage.postings.get(begin..begin.saturating_add(n)).unwrap_or(&[]).iter().map(|posting| posting.word)
    }
}

#[cfg(test)]
mod tests;
