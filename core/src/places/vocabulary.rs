//! A tree of descriptors that sorts what a descriptor shows into one of about ten thousand words.
//!
//! The file is a header and the nodes, read where they lie: little endian, any alignment, checked once when it is opened.
//! Nodes stand level by level, so that children stand together, behind their parent; node 0 is the root.

use crate::features::Descriptor;
use crate::features::hamming::distance;
use core::fmt;
use zerocopy::little_endian::{U16, U32, U64};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

/// Number of a word: the ordinal of its leaf.
pub type Word = u16;

/// How often a word is rare: `ln(images / images with the word)` in steps of 1 / [`RARITY_STEPS`].
pub const RARITY_STEPS: u16 = 4096;

/// Version of the file format.
pub const VOCABULARY_VERSION: u32 = 1;

const MAGIC: [u8; 4] = *b"KGSv";

#[derive(Clone, Copy, FromBytes, IntoBytes, Immutable, KnownLayout, Unaligned)]
#[repr(C)]
struct Header {
    magic: [u8; 4],
    version: U32,
    n_nodes: U32,
    n_words: U32,
    nodes_crc: U32,
    /// Checksum of the fields above, so that a number is believed only when it was written so.
    header_crc: U32,
}
const HEADER_CHECKED_BYTES: usize = size_of::<Header>() - size_of::<U32>();

#[derive(Clone, Copy, FromBytes, IntoBytes, Immutable, KnownLayout, Unaligned)]
#[repr(C)]
struct StoredNode {
    median: [U64; 4],
    /// Of a leaf: its word.
    first_child: U32,
    n_children: U16,
    rarity: U16,
}
const _: () = assert!(size_of::<StoredNode>() == 40 && size_of::<Header>() == 24);

/// A node as a trainer hands it over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct VocabularyNode {
    /// Bits that most descriptors below this node have.
    pub median: Descriptor,
    /// What is below it.
    pub below: Below,
}

/// What is below a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Below {
    /// Finer nodes.
    Children {
        /// Index of the first, larger than the node's own.
        first: u32,
        /// How many stand there.
        n: u16,
    },
    /// A word.
    Word {
        /// Its number; words are numbered in the order of their nodes, from 0.
        word: Word,
        /// How rare it is, in steps of 1 / [`RARITY_STEPS`].
        rarity: u16,
    },
}

/// Why bytes are not a vocabulary. Recognition of places stays off; say which file, and where to get another one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum VocabularyProblem {
    /// The file does not begin like a vocabulary: it is something else.
    NotAVocabulary,
    /// Written by another version of the program: train it anew, or take the file that came with this one.
    Version {
        /// Version of the file.
        found: u32,
    },
    /// The file is shorter or longer than it says: it was not copied completely.
    Length {
        /// Bytes that are there.
        found: u32,
        /// Bytes that belong there.
        needed: u32,
    },
    /// Bytes differ from what was written: the medium or a program changed them.
    Changed,
    /// The checksum is right and the tree contradicts itself: a defect of the program that wrote it.
    Inconsistent {
        /// Index of the node that is wrong.
        node: u32,
    },
}

impl fmt::Display for VocabularyProblem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotAVocabulary => write!(f, "does not begin like a vocabulary"),
            Self::Version { found } => {
                write!(f, "is a vocabulary of version {found}, this program reads {VOCABULARY_VERSION}")
            }
            Self::Length { found, needed } => write!(f, "has {found} bytes, {needed} belong to it"),
            Self::Changed => write!(f, "bytes were changed: a checksum is wrong"),
            Self::Inconsistent { node } => write!(f, "the tree contradicts itself at node {node}"),
        }
    }
}

impl core::error::Error for VocabularyProblem {}

/// A vocabulary over the bytes of its file.
#[derive(Clone, Copy)]
pub struct Vocabulary<'b> {
    nodes: &'b [StoredNode],
    n_words: usize,
}

impl fmt::Debug for Vocabulary<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Vocabulary {{ n_nodes: {}, n_words: {} }}", self.nodes.len(), self.n_words)
    }
}

impl<'b> Vocabulary<'b> {
    /// Checks the bytes of a vocabulary file and reads them where they lie.
    ///
    /// # Errors
    /// [`VocabularyProblem`] says in what they are not one.
    pub fn open(bytes: &'b [u8]) -> Result<Self, VocabularyProblem> {
        let (header, body) = Header::ref_from_prefix(bytes).map_err(|_| VocabularyProblem::NotAVocabulary)?;
        if header.magic != MAGIC {
            return Err(VocabularyProblem::NotAVocabulary);
        }
        if header_crc(header) != header.header_crc.get() {
            return Err(VocabularyProblem::Changed);
        }
        if header.version.get() != VOCABULARY_VERSION {
            return Err(VocabularyProblem::Version { found: header.version.get() });
        }
        let (n_nodes, n_words) = (header.n_nodes.get() as usize, header.n_words.get() as usize);
        let needed = vocabulary_bytes(n_nodes);
        let saturate = |bytes: usize| u32::try_from(bytes).unwrap_or(u32::MAX);
        let nodes = <[StoredNode]>::ref_from_bytes(body)
            .ok()
            .filter(|nodes| nodes.len() == n_nodes)
            .ok_or(VocabularyProblem::Length { found: saturate(bytes.len()), needed: saturate(needed) })?;
        if crc32fast::hash(body) != header.nodes_crc.get() {
            return Err(VocabularyProblem::Changed);
        }
        check_tree(nodes, n_words)?;
        Ok(Self { nodes, n_words })
    }

    /// Words are numbered below this.
    pub fn n_words(&self) -> usize {
        self.n_words
    }

    /// The word of a descriptor and how rare it is, in steps of 1 / [`RARITY_STEPS`].
    ///
    /// # Cost
    /// O(branching * depth).
    pub fn word_of(&self, descriptor: &Descriptor) -> (Word, u16) {
        let mut node = self.nodes.first();
        while let Some(found) = node {
            let first = found.first_child.get() as usize;
            let children = self.nodes.get(first..first + usize::from(found.n_children.get())).unwrap_or(&[]);
            if children.is_empty() {
                return (found.first_child.get() as Word, found.rarity.get());
            }
            // The first of those that are equally near.
            node = children.iter().min_by_key(|child| distance(descriptor, &median(child)));
        }
        (0, 0)
    }
}

fn median(node: &StoredNode) -> Descriptor {
    Descriptor(node.median.map(U64::get))
}

fn header_crc(header: &Header) -> u32 {
    crc32fast::hash(header.as_bytes().get(..HEADER_CHECKED_BYTES).unwrap_or_default())
}

/// Every node but the root is the child of exactly one node before it, and words are numbered as they stand.
fn check_tree(nodes: &[StoredNode], n_words: usize) -> Result<(), VocabularyProblem> {
    let (mut next_child, mut next_word) = (1, 0);
    for (i, node) in nodes.iter().enumerate() {
        let (first, n) = (node.first_child.get() as usize, usize::from(node.n_children.get()));
        let is_right = if n > 0 { first == next_child && first > i } else { first == next_word && first < n_words };
        if !is_right {
            return Err(VocabularyProblem::Inconsistent { node: i as u32 });
        }
        if n > 0 { next_child += n } else { next_word += 1 }
    }
    if next_child != nodes.len() || next_word != n_words || n_words > usize::from(Word::MAX) {
        return Err(VocabularyProblem::Inconsistent { node: nodes.len() as u32 });
    }
    Ok(())
}

/// Bytes of the file of a vocabulary with so many nodes.
pub const fn vocabulary_bytes(n_nodes: usize) -> usize {
    size_of::<Header>() + n_nodes * size_of::<StoredNode>()
}

/// Writes a vocabulary file into `bytes`, which are [`vocabulary_bytes`] long; `None` when they are not.
///
/// What is written is not checked: [`Vocabulary::open`] does that.
pub fn encode_vocabulary(nodes: &[VocabularyNode], bytes: &mut [u8]) -> Option<()> {
    if bytes.len() != vocabulary_bytes(nodes.len()) {
        return None;
    }
    let (head, body) = bytes.split_at_mut_checked(size_of::<Header>())?;
    let mut n_words = 0;
    for (node, out) in nodes.iter().zip(body.chunks_exact_mut(size_of::<StoredNode>())) {
        let (first_child, n_children, rarity) = match node.below {
            Below::Children { first, n } => (first, n, 0),
            Below::Word { word, rarity } => (u32::from(word), 0, rarity),
        };
        n_words += u32::from(n_children == 0);
        let stored = StoredNode {
            median: node.median.0.map(U64::new),
            first_child: first_child.into(),
            n_children: n_children.into(),
            rarity: rarity.into(),
        };
        out.copy_from_slice(stored.as_bytes());
    }
    let mut header = Header {
        magic: MAGIC,
        version: VOCABULARY_VERSION.into(),
        n_nodes: u32::try_from(nodes.len()).ok()?.into(),
        n_words: n_words.into(),
        nodes_crc: crc32fast::hash(body).into(),
        header_crc: 0.into(),
    };
    header.header_crc = header_crc(&header).into();
    head.copy_from_slice(header.as_bytes());
    Some(())
}

#[cfg(test)]
pub(super) mod tests;
