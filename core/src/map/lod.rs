//! Level of detail: which voxel size describes a surface at which distance.

pub use super::numbers::{BAND_OVERLAP_RATIO, BAND_STARTS_M, N_LEVELS};

/// Edge of a voxel of each level, m. The paper, section 3.2 (its table's third
/// entry is a misprint for 1 m).
pub const VOXEL_SIZES_M: [f32; N_LEVELS] = [0.1, 0.25, 1.0, 5.0, 25.0];

/// The level whose band a distance falls into.
pub fn level_at(distance_m: f32) -> u8 {
    BAND_STARTS_M.iter().skip(1).filter(|&&start_m| distance_m >= start_m).count() as u8
}

/// The neighbouring level that overlaps at this distance, if any: a surface there is inserted at both.
pub fn overlapping_level_at(distance_m: f32) -> Option<u8> {
    let level = level_at(distance_m);
    let near = level_at(distance_m / (1.0 - BAND_OVERLAP_RATIO));
    let far = level_at(distance_m / (1.0 + BAND_OVERLAP_RATIO));
    [near, far].into_iter().find(|&other| other != level)
}

/// How much of its opacity an anchor of `level` keeps when seen from `distance_m`, in [0, 1].
///
/// One inside the level's band, zero outside, linear across the overlap, so that the weights of two
/// neighbouring levels add up to one everywhere and nothing pops as the camera moves.
pub fn band_opacity(level: u8, distance_m: f32) -> f32 {
    let level = level as usize;
    let rises = if level == 0 { 1.0 } else { border_weight(BAND_STARTS_M.get(level), distance_m) };
    let falls = border_weight(BAND_STARTS_M.get(level + 1), distance_m);
    rises * (1.0 - falls)
}

/// Change of [`band_opacity`] per metre of distance; 0 where it is constant.
pub fn band_opacity_slope(level: u8, distance_m: f32) -> f32 {
    let level = level as usize;
    let (near, far) = (BAND_STARTS_M.get(level), BAND_STARTS_M.get(level + 1));
    let (rises, rise) =
        if level == 0 { (1.0, 0.0) } else { (border_weight(near, distance_m), border_slope(near, distance_m)) };
    rise * (1.0 - border_weight(far, distance_m)) - rises * border_slope(far, distance_m)
}

/// Share of the coarser level across the border that starts at `border_m`; zero where there is no border.
fn border_weight(border_m: Option<&f32>, distance_m: f32) -> f32 {
    let Some(&border_m) = border_m else { return 0.0 };
    let half_width_m = border_m * BAND_OVERLAP_RATIO;
    (0.5 + 0.5 * (distance_m - border_m) / half_width_m).clamp(0.0, 1.0)
}

/// Change of [`border_weight`] per metre.
fn border_slope(border_m: Option<&f32>, distance_m: f32) -> f32 {
    let Some(&border_m) = border_m else { return 0.0 };
    let half_width_m = border_m * BAND_OVERLAP_RATIO;
    if (distance_m - border_m).abs() < half_width_m { 0.5 / half_width_m } else { 0.0 }
}

/// Distances at which a level has any opacity: `(nearest, farthest)`, m; the coarsest reaches to infinity.
pub fn visible_range_m(level: u8) -> (f32, f32) {
    let level = level as usize;
    let start_m = BAND_STARTS_M.get(level).copied().unwrap_or(f32::INFINITY);
    let end_m = BAND_STARTS_M.get(level + 1).copied().unwrap_or(f32::INFINITY);
    (start_m * (1.0 - BAND_OVERLAP_RATIO), end_m * (1.0 + BAND_OVERLAP_RATIO))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_distance_belongs_to_its_band_and_the_border_to_the_coarser_one() {
        let cases = [(0.0, 0), (19.9, 0), (20.0, 1), (39.0, 1), (40.0, 2), (79.0, 2), (80.0, 3), (160.0, 4), (9e9, 4)];
        for (distance_m, level) in cases {
            assert_eq!(level_at(distance_m), level, "{distance_m} m");
        }
    }

    #[test]
    fn neighbours_share_a_surface_only_around_the_border() {
        let cases = [(10.0, None), (19.1, Some(1)), (20.9, Some(0)), (21.2, None), (155.0, Some(4)), (300.0, None)];
        for (distance_m, other) in cases {
            assert_eq!(overlapping_level_at(distance_m), other, "{distance_m} m");
        }
    }

    #[test]
    fn the_weights_of_all_levels_add_up_to_one_at_every_distance() {
        for step in 0..4000 {
            let distance_m = step as f32 * 0.1;
            let sum: f32 = (0..N_LEVELS as u8).map(|level| band_opacity(level, distance_m)).sum();
            assert!((sum - 1.0).abs() < 1e-4, "{distance_m} m: {sum}");
        }
        assert_eq!(band_opacity(0, 18.9), 1.0);
        assert_eq!(band_opacity(0, 21.1), 0.0);
        assert!((band_opacity(1, 20.0) - 0.5).abs() < 1e-6);
        assert_eq!(band_opacity(7, 20.0), 0.0, "a level that does not exist is never seen");
    }

    #[test]
    fn slopes_agree_with_differences() {
        // A power of two, so that both ends are exact.
        const STEP_M: f32 = 1.0 / 128.0;
        for level in 0..=N_LEVELS as u8 {
            for distance_m in [5.0, 19.5, 20.5, 25.0, 39.0, 41.0, 78.0, 83.0, 100.0, 155.0, 166.0, 500.0] {
                let [up, down] = [STEP_M, -STEP_M].map(|step| band_opacity(level, distance_m + step));
                let (got, difference) = (band_opacity_slope(level, distance_m), (up - down) / (2.0 * STEP_M));
                assert!((got - difference).abs() < 1e-4, "level {level} at {distance_m} m: {got}, {difference}");
            }
        }
    }

    #[test]
    fn nothing_is_visible_outside_the_stated_range() {
        for level in 0..N_LEVELS as u8 {
            let (near_m, far_m) = visible_range_m(level);
            assert!(band_opacity(level, (near_m * 0.999).max(0.0)) == 0.0 || level == 0);
            assert!(band_opacity(level, far_m * 1.001) == 0.0 || far_m.is_infinite());
            assert!(band_opacity(level, near_m * 1.05 + 0.1) > 0.0);
        }
    }
}
