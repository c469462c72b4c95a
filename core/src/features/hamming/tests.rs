use super::*;

/// A feature whose first `bits` bits are set.
fn feature(bits: u32, pixel: [f32; 2]) -> Feature {
    let word = |k: u32| match bits.saturating_sub(64 * k).min(64) {
        64 => u64::MAX,
        n => (1 << n) - 1,
    };
    Feature { pixel, descriptor: Descriptor([word(0), word(1), word(2), word(3)]), ..Feature::NONE }
}

fn check(first: &[(u32, f32)], second: &[(u32, f32)], expected: &[(u32, u32, u16, u16)]) {
    let features =
        |of: &[(u32, f32)]| -> std::vec::Vec<Feature> { of.iter().map(|&(bits, x)| feature(bits, [x, 0.0])).collect() };
    for simd in [SimdLevel::Scalar, SimdLevel::new()] {
        let mut nearest = [Nearest::NONE; 16];
        let mut matches = [FeatureMatch::default(); 8];
        let (first, second) = (features(first), features(second));
        let settings = HammingSettings::STANDARD;
        let n = match_mutually(simd, &first, &second, &settings, &mut nearest, &mut matches);
        let found: std::vec::Vec<_> =
            matches[..n].iter().map(|m| (m.first, m.second, m.distance, m.next_distance)).collect();
        assert_eq!(found, expected);
    }
}

#[test]
fn only_clear_mutual_pairs_match() {
    // Alone, with the rival that nothing is, 128 bits away.
    check(&[(10, 0.0)], &[(20, 0.0)], &[(0, 0, 10, 128)]);
    // Too different, or no one there.
    check(&[(0, 0.0)], &[(81, 0.0)], &[]);
    check(&[(0, 0.0)], &[], &[]);
    // The second of the first set prefers the same one, which prefers the first.
    check(&[(10, 0.0), (30, 50.0)], &[(12, 0.0)], &[(0, 0, 2, 128)]);
    // A rival elsewhere has to be clearly worse; one at the same place is the same thing.
    check(&[(10, 0.0)], &[(30, 0.0), (33, 100.0)], &[]);
    check(&[(10, 0.0)], &[(30, 0.0), (34, 100.0)], &[(0, 0, 20, 24)]);
    check(&[(10, 0.0)], &[(30, 0.0), (33, 5.0), (60, 100.0)], &[(0, 0, 20, 50)]);
    // Every one finds its own.
    let all = [(0, 0.0), (60, 100.0), (120, 200.0), (180, 300.0)];
    check(&all, &[all[3], all[1], all[0], all[2]], &[(0, 2, 0, 60), (1, 1, 0, 60), (2, 3, 0, 60), (3, 0, 0, 60)]);
}
