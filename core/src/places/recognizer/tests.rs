use super::super::index::{PlaceSlot, PlaceStorage, Posting};
use super::super::signature::{WORDS_PER_PLACE, WeightedWord};
use super::*;
use std::vec;
use std::vec::Vec;

const SETTINGS: RecognizerSettings = RecognizerSettings {
    min_gap_keyframes: 10,
    min_relative_score: 0.3,
    min_expected: 0.02,
    same_place_keyframes: 2,
    n_consecutive: 3,
};

/// What a street looks like at this keyframe: half of it is what the keyframe before saw.
fn view_at(place: u16) -> Signature {
    let words = [2 * place, 2 * place + 1, 2 * place + 2, 2 * place + 3];
    Signature::from_words(&words.map(|word| WeightedWord { word, weight: 16000 })).expect("ascending")
}

/// Drives through `places`; per keyframe the consistent candidate, if any.
fn drive(places: &[u16]) -> Vec<Option<u32>> {
    let storage = PlaceStorage {
        slots: &mut vec![PlaceSlot::UNUSED; 100],
        postings: &mut vec![Posting::UNUSED; 100 * WORDS_PER_PLACE],
        first_of_word: &mut [0; 1000],
    };
    let mut recognizer = PlaceRecognizer::new(PlaceIndex::new(storage).expect("long enough"), SETTINGS);
    (0..)
        .zip(places)
        .map(|(ordinal, &place)| {
            let (candidates, _) = recognizer.observe(ordinal, &view_at(place));
            candidates.iter().find(|c| recognizer.is_consistent(c)).map(|c| c.ordinal)
        })
        .collect()
}

fn check(places: impl IntoIterator<Item = u16>, expected: &[(usize, u32)]) {
    let places: Vec<_> = places.into_iter().collect();
    let found = drive(&places);
    let found: Vec<_> = found.iter().enumerate().filter_map(|(i, found)| Some((i, (*found)?))).collect();
    assert_eq!(found, expected, "{places:?}");
}

#[test]
fn a_street_that_is_driven_again_is_recognized_from_the_third_keyframe_on() {
    check((0..20).chain(4..8), &[(22, 6), (23, 7)]);
    check((0..20).chain((4..8).rev()), &[(22, 5), (23, 4)]);
}

#[test]
fn a_new_street_and_the_street_just_driven_are_not() {
    check(0..40, &[]);
    check((0..9).chain(4..9), &[]);
}

#[test]
fn a_single_view_that_looks_like_elsewhere_is_not() {
    check((0..20).chain([4, 5, 90, 91]), &[]);
    check((0..20).chain([4, 12, 4, 12, 4]), &[]);
}

#[test]
fn after_being_lost_the_street_just_driven_is_recognized_too() {
    let storage = PlaceStorage {
        slots: &mut vec![PlaceSlot::UNUSED; 100],
        postings: &mut vec![Posting::UNUSED; 100 * WORDS_PER_PLACE],
        first_of_word: &mut [0; 1000],
    };
    let mut recognizer = PlaceRecognizer::new(PlaceIndex::new(storage).expect("long enough"), SETTINGS);
    let mut found = Vec::new();
    for (ordinal, place) in (0..).zip((0..9).chain(4..9)) {
        if ordinal == 9 {
            recognizer.begin_anew(ordinal);
        }
        let (candidates, _) = recognizer.observe(ordinal, &view_at(place));
        found.extend(candidates.iter().find(|c| recognizer.is_consistent(c)).map(|c| (ordinal, c.ordinal)));
    }
    assert_eq!(found, [(11, 6), (12, 7), (13, 8)]);
}

#[test]
fn hits_beside_a_better_one_are_the_same_place() {
    let storage = PlaceStorage {
        slots: &mut vec![PlaceSlot::UNUSED; 100],
        postings: &mut vec![Posting::UNUSED; 100 * WORDS_PER_PLACE],
        first_of_word: &mut [0; 1000],
    };
    let mut recognizer = PlaceRecognizer::new(PlaceIndex::new(storage).expect("long enough"), SETTINGS);
    for (ordinal, place) in (0..10).chain(5..6).enumerate() {
        recognizer.observe(ordinal as u32, &view_at(place));
    }
    let found = recognizer.relocalize(&view_at(5), 0.5);
    let summary: Vec<_> = found.iter().map(|c| (c.ordinal, c.n_consecutive, (10.0 * c.place_score) as u32)).collect();
    // Keyframe 5 with its neighbours 4 and 6, and keyframe 10, which saw the same.
    assert_eq!(summary, [(5, 1, 19), (10, 1, 9)]);
}
