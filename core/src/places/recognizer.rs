//! Which earlier places a drive may have come back to.

use super::index::{PlaceHit, PlaceIndex, Remembered};
use super::signature::Signature;
use heapless::Vec;

/// Candidates of one keyframe at most.
pub const MAX_CANDIDATES: usize = 4;

/// Hits that are looked at.
const MAX_HITS: usize = 64;

/// Constants of the [`PlaceRecognizer`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RecognizerSettings {
    /// A candidate is at least this many keyframes older than the view. Peers: 50.
    pub min_gap_keyframes: u32,
    /// A hit counts from this share of the similarity of the view with the keyframe before it. Range (0, 1]; Galvez-Lopez &
    /// Tardos 2012: 0.3.
    pub min_relative_score: f32,
    /// Similarity with the keyframe before that is assumed at least: in a sharp turn everything looks more alike than that.
    /// Share of [`super::WHOLE`], range [0, 1].
    pub min_expected: f32,
    /// Hits this many keyframes from a better one are the same place.
    pub same_place_keyframes: u32,
    /// Keyframes in a row that have to lead to neighbouring places, the view included. Galvez-Lopez & Tardos 2012: 3.
    pub n_consecutive: u32,
}

impl RecognizerSettings {
    /// The values that the documentation of the fields explains.
    pub const STANDARD: Self = Self {
        min_gap_keyframes: 50,
        min_relative_score: 0.3,
        min_expected: 0.02,
        same_place_keyframes: 8,
        n_consecutive: 3,
    };
}

/// A place that a view may show.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PlaceCandidate {
    /// The keyframe of this place that looks most like the view.
    pub ordinal: u32,
    /// How alike they are, share of the whole.
    pub score: f32,
    /// That over the similarity of the view with the keyframe before it.
    pub relative_score: f32,
    /// Sum of the scores of all hits in this place.
    pub place_score: f32,
    /// Keyframes in a row that led here, the view included.
    pub n_consecutive: u32,
}

/// Candidates of one view.
pub type Candidates = Vec<PlaceCandidate, MAX_CANDIDATES>;

/// Remembers the keyframes of a drive, and says which of them a new one looks like.
#[derive(Debug)]
pub struct PlaceRecognizer<'m> {
    index: PlaceIndex<'m>,
    settings: RecognizerSettings,
    /// Candidates of the keyframe before.
    earlier: Candidates,
    /// Keyframes below are of earlier drives, or of before the drive was lost: candidates, however few keyframes have passed.
    first_of_drive: u32,
}

impl<'m> PlaceRecognizer<'m> {
    /// A recognizer that goes on from what is in `index`.
    pub fn new(index: PlaceIndex<'m>, settings: RecognizerSettings) -> Self {
        Self { index, settings, earlier: Vec::new(), first_of_drive: 0 }
    }

    /// The keyframes that are remembered.
    pub fn index(&self) -> &PlaceIndex<'m> {
        &self.index
    }

    /// Looks for the places that a new keyframe may show, then remembers it.
    ///
    /// # Output
    /// All candidates, best place first; [`is_consistent`](Self::is_consistent) says which are worth verifying. And what
    /// became of the keyframe in the index.
    ///
    /// # Source
    /// Galvez-Lopez & Tardos 2012, sec. V.A to V.C (normalized score, islands, temporal consistency). Differs: several
    /// places are followed at once.
    pub fn observe(&mut self, ordinal: u32, view: &Signature) -> (Candidates, Remembered) {
        let of_this_drive = ordinal.checked_sub(self.settings.min_gap_keyframes);
        let of_earlier_drives = self.first_of_drive.checked_sub(1).filter(|last| *last < ordinal);
        let found = match of_this_drive.max(of_earlier_drives) {
            Some(last) => {
                let expected = self.index.like_newest(view).map_or(0, |hit| hit.score);
                self.candidates(view, last, expected)
            }
            None => Vec::new(),
        };
        self.earlier = found;
        (self.earlier.clone(), self.index.remember(ordinal, view))
    }

    /// Remembers a keyframe of an earlier drive.
    pub fn recall(&mut self, ordinal: u32, view: &Signature) -> Remembered {
        self.first_of_drive = ordinal.saturating_add(1);
        self.index.remember(ordinal, view)
    }

    /// The drive was lost: from this keyframe on, the next to come, it may be in any place of before.
    pub fn begin_anew(&mut self, ordinal: u32) {
        self.first_of_drive = ordinal;
        self.earlier.clear();
    }

    /// Places that a view may show of which nothing is known: after tracking was lost, or in a stored map.
    ///
    /// Scores are relative to `expected`, the similarity of two views of one place; nothing is remembered.
    pub fn relocalize(&mut self, view: &Signature, expected: f32) -> Candidates {
        self.candidates(view, u32::MAX, (expected * super::WHOLE as f32) as u32)
    }

    /// Whether enough keyframes in a row led to this place.
    pub fn is_consistent(&self, candidate: &PlaceCandidate) -> bool {
        candidate.n_consecutive >= self.settings.n_consecutive
    }

    fn candidates(&mut self, view: &Signature, last_ordinal: u32, expected: u32) -> Candidates {
        let whole = super::WHOLE as f32;
        let expected = (expected as f32).max(self.settings.min_expected * whole);
        let mut hits = [PlaceHit::default(); MAX_HITS];
        let n = self.index.find(view, last_ordinal, &mut hits);
        let hits = hits.get_mut(..n).unwrap_or(&mut []);
        let n = hits.partition_point(|hit| hit.score as f32 >= self.settings.min_relative_score * expected);
        let mut places: Vec<PlaceCandidate, MAX_HITS> = Vec::new();
        let is_near = |a: u32, b: u32| a.abs_diff(b) <= self.settings.same_place_keyframes;
        for hit in hits.iter().take(n) {
            let score = hit.score as f32 / whole;
            if let Some(place) = places.iter_mut().find(|place| is_near(place.ordinal, hit.ordinal)) {
                place.place_score += score;
                continue;
            }
            let before = self.earlier.iter().filter(|c| is_near(c.ordinal, hit.ordinal));
            let place = PlaceCandidate {
                ordinal: hit.ordinal,
                score,
                relative_score: hit.score as f32 / expected,
                place_score: score,
                n_consecutive: 1 + before.map(|c| c.n_consecutive).max().unwrap_or(0),
            };
            // There is room for a place of every hit.
            let _ = places.push(place);
        }
        places.sort_unstable_by(|a, b| b.place_score.total_cmp(&a.place_score).then(a.ordinal.cmp(&b.ordinal)));
        places.into_iter().take(MAX_CANDIDATES).collect()
    }
}

#[cfg(test)]
mod tests;
