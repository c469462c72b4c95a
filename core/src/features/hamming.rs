//! Which features look most alike, by the bits in which their descriptors differ.

use super::descriptors::{Descriptor, Feature};
use super::lanes::{Kernel, KernelTask, SimdLevel};
use super::lk::squared_distance;

/// Constants of the matching.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HammingSettings {
    /// Bits in which a pair may differ. Range 0..=256; ours: different things differ in 128 +- 20.
    pub max_distance: u16,
    /// A pair has to differ in fewer bits than this share of what the next best pair differs in. Range (0, 1]; ours.
    pub max_ratio: f32,
    /// A feature this close to the best one is the same thing in another size and no rival, px at its size.
    /// Range [0, 50]; ours.
    pub same_px: f32,
}

impl HammingSettings {
    /// The values that the documentation of the fields explains.
    pub const STANDARD: Self = Self { max_distance: 80, max_ratio: 0.85, same_px: 6.0 };
}

/// The feature that looks most like another one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Nearest {
    index: u32,
    distance: u16,
}

impl Nearest {
    /// Fills storage that is still to be written.
    pub const NONE: Self = Self { index: u32::MAX, distance: u16::MAX };
}

/// Two features that look most like each other.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FeatureMatch {
    /// Index of the first.
    pub first: u32,
    /// Index of the second.
    pub second: u32,
    /// Bits in which they differ.
    pub distance: u16,
    /// Bits in which the next best second, elsewhere in the image, differs from the first.
    pub next_distance: u16,
}

/// Bits in which two descriptors differ.
#[inline(always)]
pub fn distance(a: &Descriptor, b: &Descriptor) -> u16 {
    let mut bits = 0;
    for (a, b) in a.0.iter().zip(&b.0) {
        bits += (a ^ b).count_ones();
    }
    bits as u16
}

/// Pairs of which each is the other's best, and clearly so.
///
/// # Inputs
/// * `nearest`: scratch, as long as both sets together; what is beyond is not looked at.
///
/// # Output
/// The front of `matches`, in the order of `first`; their number. What does not fit is left out.
///
/// # Cost
/// O(first * second); no allocation. Same result on every SIMD level.
pub fn match_mutually(
    simd: SimdLevel,
    first: &[Feature],
    second: &[Feature],
    settings: &HammingSettings,
    nearest: &mut [Nearest],
    matches: &mut [FeatureMatch],
) -> usize {
    let first = &first[..first.len().min(nearest.len())];
    let (of_first, rest) = nearest.split_at_mut(first.len());
    let second = &second[..second.len().min(rest.len())];
    let of_second = &mut rest[..second.len()];
    let mut n = 0;
    simd.run(MatchMutually { first, second, settings, of_first, of_second, matches, n: &mut n });
    n
}

struct MatchMutually<'a> {
    first: &'a [Feature],
    second: &'a [Feature],
    settings: &'a HammingSettings,
    of_first: &'a mut [Nearest],
    of_second: &'a mut [Nearest],
    matches: &'a mut [FeatureMatch],
    n: &'a mut usize,
}

impl KernelTask for MatchMutually<'_> {
    #[inline(always)]
    fn run<K: Kernel>(self, _kernel: K) {
        let Self { first, second, settings, of_first, of_second, matches, n } = self;
        of_second.fill(Nearest::NONE);
        for (i, (feature, best)) in (0u32..).zip(first.iter().zip(of_first.iter_mut())) {
            *best = Nearest::NONE;
            for (j, (other, best_of_other)) in (0u32..).zip(second.iter().zip(of_second.iter_mut())) {
                let distance = distance(&feature.descriptor, &other.descriptor);
                if distance < best.distance {
                    *best = Nearest { index: j, distance };
                }
                if distance < best_of_other.distance {
                    *best_of_other = Nearest { index: i, distance };
                }
            }
        }
        let mut slots = matches.iter_mut();
        for (i, (feature, best)) in (0u32..).zip(first.iter().zip(of_first.iter())) {
            let is_mutual = of_second.get(best.index as usize).is_some_and(|back| back.index == i);
            if !is_mutual || best.distance > settings.max_distance {
                continue;
            }
            let next_distance = distance_of_rival(feature, best, second, settings);
            if f32::from(best.distance) >= settings.max_ratio * f32::from(next_distance) {
                continue;
            }
            let Some(slot) = slots.next() else { break };
            *slot = FeatureMatch { first: i, second: best.index, distance: best.distance, next_distance };
            *n += 1;
        }
    }
}

/// Distance of the best feature that is not the same thing as the best one.
#[inline(always)]
fn distance_of_rival(feature: &Feature, best: &Nearest, second: &[Feature], settings: &HammingSettings) -> u16 {
    let Some(chosen) = second.get(best.index as usize) else { return u16::MAX };
    let near_px = settings.same_px * chosen.scale;
    let mut next = PAIRS_APART;
    for other in second {
        let distance = distance(&feature.descriptor, &other.descriptor);
        if distance < next && squared_distance(other.pixel, chosen.pixel) > near_px * near_px {
            next = distance;
        }
    }
    next
}

/// What descriptors of different things differ in, where there is no rival at all.
const PAIRS_APART: u16 = 128;

#[cfg(test)]
mod tests;
