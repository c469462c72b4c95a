use super::*;
use crate::features::Feature;
use std::vec;
use std::vec::Vec;

/// Two inner nodes of two words each. Descriptors of word `w` have `w` in their lowest bits eight times over; words are as
/// rare as their number.
fn nodes() -> [VocabularyNode; 7] {
    let node = |bits: u64, below| VocabularyNode { median: Descriptor([bits; 4]), below };
    let word = |word: Word| node(bits_of(u64::from(word)), Below::Word { word, rarity: word });
    [
        node(0, Below::Children { first: 1, n: 2 }),
        node(bits_of(0), Below::Children { first: 3, n: 2 }),
        node(bits_of(2), Below::Children { first: 5, n: 2 }),
        word(0),
        word(1),
        word(2),
        word(3),
    ]
}

fn bits_of(word: u64) -> u64 {
    0xff * (word & 1) + 0xffff_0000 * (word >> 1)
}

/// The bytes of the tests' vocabulary.
#[expect(non_snake_case, reason = "a constant of the tests that is too long to write down")]
pub(in super::super) fn VOCABULARY() -> Vec<u8> {
    let nodes = nodes();
    let mut bytes = vec![0; vocabulary_bytes(nodes.len())];
    encode_vocabulary(&nodes, &mut bytes).expect("as long as it has to be");
    bytes
}

pub(in super::super) fn open(bytes: &[u8]) -> Vocabulary<'_> {
    Vocabulary::open(bytes).expect("a whole vocabulary")
}

/// A feature whose word is this one, not exactly the median.
pub(in super::super) fn feature_of(word: u64) -> Feature {
    Feature { descriptor: Descriptor([bits_of(word) ^ 0x8000_0000_0000_0001; 4]), ..Feature::NONE }
}

#[test]
fn a_descriptor_goes_down_to_the_nearest_word() {
    // Files lie at any address.
    let bytes = [&[0][..], &VOCABULARY()].concat();
    let vocabulary = open(&bytes[1..]);
    assert_eq!(vocabulary.n_words(), 4);
    for word in 0..4 {
        assert_eq!(vocabulary.word_of(&feature_of(word).descriptor), (word as Word, word as u16));
    }
}

#[test]
fn every_damage_is_noticed() {
    let whole = VOCABULARY();
    let mut bytes = whole.clone();
    for byte in 0..bytes.len() {
        bytes[byte] ^= 4;
        assert!(Vocabulary::open(&bytes).is_err(), "byte {byte}");
        bytes[byte] ^= 4;
    }
    for length in 0..bytes.len() {
        assert!(Vocabulary::open(&bytes[..length]).is_err(), "cut to {length}");
    }
    bytes.push(0);
    let (found, needed) = (bytes.len() as u32, whole.len() as u32);
    assert_eq!(Vocabulary::open(&bytes).err(), Some(VocabularyProblem::Length { found, needed }));
    assert_eq!(
        Vocabulary::open(b"ply\nformat binary_little_endian 1.0\n").err(),
        Some(VocabularyProblem::NotAVocabulary)
    );
}

#[test]
fn trees_that_would_mislead_are_refused() {
    let check = |change: &dyn Fn(&mut [VocabularyNode]), node: u32| {
        let mut nodes = nodes();
        change(&mut nodes);
        let mut bytes = vec![0; vocabulary_bytes(nodes.len())];
        encode_vocabulary(&nodes, &mut bytes).expect("as long as it has to be");
        assert_eq!(Vocabulary::open(&bytes).err(), Some(VocabularyProblem::Inconsistent { node }));
    };
    check(&|nodes| nodes[2].below = Below::Children { first: 0, n: 2 }, 2);
    check(&|nodes| nodes[2].below = Below::Children { first: 4, n: 2 }, 2);
    check(&|nodes| nodes[2].below = Below::Children { first: 5, n: 3 }, 7);
    check(&|nodes| nodes[4].below = Below::Word { word: 9, rarity: 0 }, 4);
    check(&|nodes| nodes[0].below = Below::Children { first: 1, n: 0 }, 0);
    assert_eq!(encode_vocabulary(&nodes(), &mut [0; 100]), None);
}
