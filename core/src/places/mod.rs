//! Recognition of places: which keyframes may show where the camera is again, and whether one really does.
//!
//! Features become words of a [`Vocabulary`], the 64 that say most become the [`Signature`] of a keyframe, and the
//! [`PlaceIndex`] finds keyframes with the same words. A [`PlaceRecognizer`] asks it keyframe after keyframe and keeps the
//! places to which several in a row lead. A recognized place is a guess; [`verify_loop`] measures the one view against the
//! other and is hard to convince.

mod index;
mod recognizer;
mod signature;
mod verification;
mod view;
mod vocabulary;

pub use index::{
    BYTES_PER_PLACE, PlaceHit, PlaceIndex, PlaceSlot, PlaceStorage, PlaceStorageTooSmall, Posting, Remembered,
    index_bytes,
};
pub use recognizer::{Candidates, MAX_CANDIDATES, PlaceCandidate, PlaceRecognizer, RecognizerSettings};
pub use signature::{Signature, Tally, WHOLE, WORDS_PER_PLACE, WeightedWord, similarity};
pub use verification::{
    LoopEvidence, LoopScratch, LoopVerdict, VerificationSettings, VerifiedLoop, bytes_per_point, verify_loop,
};
pub use view::{BYTES_PER_PLACE_POINT, PlaceView, PointDepth, describe_points};
pub use vocabulary::{
    Below, RARITY_STEPS, VOCABULARY_VERSION, Vocabulary, VocabularyNode, VocabularyProblem, Word, encode_vocabulary,
    vocabulary_bytes,
};
