//! Random numbers that depend on nothing but their seed.

/// PCG32 (XSH-RR), seeded by run seed, frame number and purpose, so that no draw depends on an earlier frame.
///
/// # Source
/// O'Neill 2014, "PCG: a family of simple fast space-efficient statistically good algorithms for random
/// number generation", section 6.3. Own implementation.
#[derive(Clone, Debug)]
pub struct Rng {
    state: u64,
    increment: u64,
}

const MULTIPLIER: u64 = 6_364_136_223_846_793_005;

/// SplitMix64 finaliser: spreads neighbouring seeds over all bits (Steele, Lea & Flood 2014).
const fn spread(mut z: u64) -> u64 {
    z = z.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

impl Rng {
    /// Generator for one purpose within one frame of one run.
    pub const fn new(run_seed: u64, frame: u64, purpose: u64) -> Self {
        let mut rng = Self { state: 0, increment: spread(purpose ^ spread(frame)) | 1 };
        rng.state = spread(run_seed ^ spread(frame.wrapping_add(spread(purpose))));
        rng.next_u32();
        rng
    }

    /// Next 32 uniformly distributed bits.
    pub const fn next_u32(&mut self) -> u32 {
        let old = self.state;
        self.state = old.wrapping_mul(MULTIPLIER).wrapping_add(self.increment);
        let xorshifted = (((old >> 18) ^ old) >> 27) as u32;
        xorshifted.rotate_right((old >> 59) as u32)
    }

    /// Uniform integer in `0..bound`; 0 when `bound` is 0.
    pub const fn below(&mut self, bound: usize) -> usize {
        ((self.next_u32() as u64 * bound as u64) >> 32) as usize
    }

    /// Uniform number in [0, 1).
    pub fn unit_f64(&mut self) -> f64 {
        let bits = (u64::from(self.next_u32()) << 21) ^ u64::from(self.next_u32() >> 11);
        bits as f64 / (1u64 << 53) as f64
    }

    /// Uniform number in [0, 1).
    pub fn unit_f32(&mut self) -> f32 {
        (self.next_u32() >> 8) as f32 / (1u32 << 24) as f32
    }

    /// `N` distinct indices below `bound`, or `None` when there are not that many.
    pub fn draw_distinct<const N: usize>(&mut self, bound: usize) -> Option<[usize; N]> {
        if bound < N {
            return None;
        }
        let mut drawn = [usize::MAX; N];
        for i in 0..N {
            let mut candidate = self.below(bound);
            while drawn.iter().take(i).any(|&d| d == candidate) {
                candidate = self.below(bound);
            }
            if let Some(slot) = drawn.get_mut(i) {
                *slot = candidate;
            }
        }
        Some(drawn)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_seed_gives_the_same_draws_and_another_purpose_others() {
        let draw = |frame, purpose| Rng::new(7, frame, purpose).draw_distinct::<5>(1000);
        assert_eq!(draw(3, 1), draw(3, 1));
        assert_ne!(draw(3, 1), draw(4, 1));
        assert_ne!(draw(3, 1), draw(3, 2));
    }

    #[test]
    fn distinct_draws_are_distinct_even_when_they_are_all() {
        let mut drawn = Rng::new(1, 2, 3).draw_distinct::<5>(5).expect("five of five");
        drawn.sort_unstable();
        assert_eq!(drawn, [0, 1, 2, 3, 4]);
        assert_eq!(Rng::new(1, 2, 3).draw_distinct::<5>(4), None);
    }

    #[test]
    fn uniform_numbers_fill_the_unit_interval_evenly() {
        let mut rng = Rng::new(42, 0, 0);
        let mut histogram = [0u32; 10];
        for _ in 0..10_000 {
            histogram[(rng.unit_f64() * 10.0) as usize] += 1;
        }
        // Binomial with n = 10^4, p = 0.1: the standard deviation is 30.
        assert!(histogram.iter().all(|&n| n.abs_diff(1000) < 150), "{histogram:?}");
    }
}
