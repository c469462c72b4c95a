//! A tree of medians over binary descriptors.

use kilogs_core::features::Descriptor;
use kilogs_core::features::hamming::distance;
use kilogs_core::math::Rng;
use kilogs_core::places::{Below, VocabularyNode, Word};

/// Shape of a vocabulary tree, and how it is grown.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TreeShape {
    /// Children of a node at most.
    pub branching: usize,
    /// Levels below the root.
    pub depth: usize,
    /// Rounds of a clustering at most.
    pub rounds: usize,
    /// Of the first medians.
    pub seed: u64,
}

/// A branch of a tree that is still being cut.
struct Bough {
    median: Descriptor,
    level: usize,
    descriptors: Vec<Descriptor>,
}

/// Grows the tree level by level, so that children stand together behind their parent. Words are as rare as
/// `rarity_of_word` is told later: 0 for now.
///
/// # Source
/// Nister & Stewenius 2006 (hierarchy); Grana et al. 2013, "A fast approach for integrating ORB descriptors in the bag of
/// words model" (k-majority: the median of a bit is what most have). First medians: Arthur & Vassilvitskii 2007.
pub(crate) fn grow(descriptors: Vec<Descriptor>, shape: &TreeShape) -> Vec<VocabularyNode> {
    let root = Descriptor([0; 4]);
    let mut boughs = std::collections::VecDeque::from([Bough { median: root, level: 0, descriptors }]);
    let (mut nodes, mut n_known, mut next_word) = (Vec::new(), 1_u32, 0);
    while let Some(bough) = boughs.pop_front() {
        let mut rng = Rng::new(shape.seed, nodes.len() as u64, 0);
        let children = if bough.level < shape.depth { split(&bough.descriptors, shape, &mut rng) } else { vec![] };
        let below = if children.len() > 1 {
            let first = n_known;
            n_known += children.len() as u32;
            Below::Children { first, n: children.len() as u16 }
        } else {
            next_word += 1;
            Below::Word { word: (next_word - 1) as Word, rarity: 0 }
        };
        if children.len() > 1 {
            let level = bough.level + 1;
            boughs.extend(children.into_iter().map(|(median, descriptors)| Bough { median, level, descriptors }));
        }
        nodes.push(VocabularyNode { median: bough.median, below });
    }
    nodes
}

/// Groups of descriptors that are alike, with their medians; empty groups are left out.
fn split(descriptors: &[Descriptor], shape: &TreeShape, rng: &mut Rng) -> Vec<(Descriptor, Vec<Descriptor>)> {
    let mut medians = first_medians(descriptors, shape.branching, rng);
    let mut group_of = vec![usize::MAX; descriptors.len()];
    for _ in 0..shape.rounds {
        let mut n_moved = 0;
        for (group, descriptor) in group_of.iter_mut().zip(descriptors) {
            let nearest = nearest(descriptor, &medians);
            n_moved += usize::from(*group != nearest);
            *group = nearest;
        }
        if n_moved == 0 {
            break;
        }
        for (k, median) in medians.iter_mut().enumerate() {
            let members = descriptors.iter().zip(&group_of).filter(|&(_, &group)| group == k).map(|(d, _)| d);
            *median = majority(members, median);
        }
    }
    let mut groups: Vec<_> = medians.into_iter().map(|median| (median, Vec::new())).collect();
    for (&group, descriptor) in group_of.iter().zip(descriptors) {
        groups[group].1.push(*descriptor);
    }
    groups.retain(|(_, members)| !members.is_empty());
    groups
}

/// Descriptors that are far from each other, more likely the farther.
fn first_medians(descriptors: &[Descriptor], n: usize, rng: &mut Rng) -> Vec<Descriptor> {
    let Some(first) = descriptors.get(rng.below(descriptors.len())) else { return vec![] };
    let mut medians = vec![*first];
    let mut away: Vec<u64> = descriptors.iter().map(|d| squared(d, first)).collect();
    while medians.len() < n {
        let total: u64 = away.iter().sum();
        if total == 0 {
            break;
        }
        let mut at = (rng.unit_f64() * total as f64) as u64;
        let drawn = away.iter().position(|&d| {
            let is_here = at < d;
            at = at.saturating_sub(d);
            is_here
        });
        let next = descriptors[drawn.unwrap_or(0)];
        for (away, descriptor) in away.iter_mut().zip(descriptors) {
            *away = (*away).min(squared(descriptor, &next));
        }
        medians.push(next);
    }
    medians
}

fn squared(a: &Descriptor, b: &Descriptor) -> u64 {
    u64::from(distance(a, b)).pow(2)
}

fn nearest(descriptor: &Descriptor, medians: &[Descriptor]) -> usize {
    (0..medians.len()).min_by_key(|&k| distance(descriptor, &medians[k])).unwrap_or(0)
}

/// What most descriptors have; of a tie, or of nothing, what `before` has.
fn majority<'d>(descriptors: impl Iterator<Item = &'d Descriptor>, before: &Descriptor) -> Descriptor {
    let mut balance = [[0_i32; 64]; 4];
    for descriptor in descriptors {
        for (balance, word) in balance.iter_mut().zip(descriptor.0) {
            for (bit, balance) in balance.iter_mut().enumerate() {
                *balance += 2 * (word >> bit & 1) as i32 - 1;
            }
        }
    }
    let mut median = *before;
    for (word, balance) in median.0.iter_mut().zip(balance) {
        for (bit, balance) in balance.into_iter().enumerate() {
            let mask = 1 << bit;
            match balance.signum() {
                1 => *word |= mask,
                -1 => *word &= !mask,
                _ => (),
            }
        }
    }
    median
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn alike_descriptors_share_a_word_and_others_do_not() {
        let mut rng = Rng::new(3, 0, 0);
        let mut draw = || Descriptor([0; 4].map(|_: u64| u64::from(rng.next_u32()) << 32 | u64::from(rng.next_u32())));
        let kinds: Vec<Descriptor> = (0..9).map(|_| draw()).collect();
        let copies = |kind: &Descriptor| (0..6).map(|bit| Descriptor(kind.0.map(|w| w ^ 1 << bit))).collect::<Vec<_>>();
        let shape = TreeShape { branching: 3, depth: 2, rounds: 10, seed: 1 };
        let nodes = grow(kinds.iter().flat_map(copies).collect(), &shape);
        let words: Vec<_> = nodes.iter().filter(|n| matches!(n.below, Below::Word { .. })).collect();
        let as_nearest = |d: &Descriptor| words.iter().map(|w| distance(d, &w.median)).min();
        assert!(words.len() <= 9 && words.len() >= 7, "{}", words.len());
        assert!(kinds.iter().filter(|kind| as_nearest(kind) == Some(0)).count() >= 5, "most kinds are a word");
    }

    #[test]
    fn the_median_has_what_most_have() {
        let of = |bits: [u64; 3]| bits.map(|bits| Descriptor([bits; 4]));
        let before = Descriptor([0b1000; 4]);
        assert_eq!(majority(of([0b011, 0b010, 0b110]).iter(), &before), Descriptor([0b010; 4]));
        assert_eq!(majority(of([0b1001, 0b0, 0]).iter().take(2), &before), Descriptor([0b1000; 4]));
        assert_eq!(majority([].iter(), &before), before);
    }
}
