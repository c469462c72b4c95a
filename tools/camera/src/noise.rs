//! Band-limited value noise: every surface has detail at the scale of the pixels that see it, and none below.

/// 32 well-mixed bits of a lattice point.
///
/// # Source
/// The finaliser of MurmurHash3 (Appleby 2011, public domain), on coordinates spread by large odd constants.
pub fn hash(x: i32, y: i32, seed: u32) -> u32 {
    let mut h =
        (x as u32).wrapping_mul(0x85eb_ca6b) ^ (y as u32).wrapping_mul(0xc2b2_ae35) ^ seed.wrapping_mul(0x27d4_eb2f);
    h ^= h >> 16;
    h = h.wrapping_mul(0x85eb_ca6b);
    h ^= h >> 13;
    h = h.wrapping_mul(0xc2b2_ae35);
    h ^ (h >> 16)
}

/// The hash as a number in [0, 1).
pub fn hash_unit(x: i32, y: i32, seed: u32) -> f32 {
    (hash(x, y, seed) >> 8) as f32 / (1u32 << 24) as f32
}

/// Smooth noise in [-1, 1] with wavelength about 1.
pub fn smooth_noise(x: f32, y: f32, seed: u32) -> f32 {
    let (fx, fy) = (x.floor(), y.floor());
    let (ix, iy) = (fx as i32, fy as i32);
    let smooth = |t: f32| t * t * (3.0 - 2.0 * t);
    let (tx, ty) = (smooth(x - fx), smooth(y - fy));
    let corner = |dx: i32, dy: i32| hash_unit(ix.wrapping_add(dx), iy.wrapping_add(dy), seed);
    let top = corner(0, 0) + (corner(1, 0) - corner(0, 0)) * tx;
    let bottom = corner(0, 1) + (corner(1, 1) - corner(0, 1)) * tx;
    2.0 * (top + (bottom - top) * ty) - 1.0
}

/// Wavelengths of the octaves, m: from paving stones to grains of asphalt.
const WAVELENGTHS_M: [f32; 6] = [2.3, 0.9, 0.36, 0.14, 0.055, 0.022];
/// An octave is full above this many pixels per wavelength and gone below half of it (Nyquist with a margin).
const FULL_PX_PER_WAVELENGTH: f32 = 4.0;

/// Sum of the octaves that pixels `footprint_m` wide can show, about [-1, 1].
pub fn detail(x_m: f32, y_m: f32, seed: u32, footprint_m: f32) -> f32 {
    let mut sum = 0.0;
    for (octave, wavelength_m) in WAVELENGTHS_M.iter().enumerate() {
        let visible = (2.0 * wavelength_m / (FULL_PX_PER_WAVELENGTH * footprint_m) - 1.0).clamp(0.0, 1.0);
        if visible == 0.0 {
            break;
        }
        sum += visible * smooth_noise(x_m / wavelength_m, y_m / wavelength_m, seed.wrapping_add(octave as u32));
    }
    0.6 * sum
}

/// Share of a pixel `footprint` wide, centred at `x`, that lies in `low..high`: an anti-aliased stripe.
pub fn stripe(x: f32, low: f32, high: f32, footprint: f32) -> f32 {
    let half = 0.5 * footprint;
    let covered = (x + half).min(high) - (x - half).max(low);
    (covered / footprint).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn detail_finer_than_a_pixel_is_left_out() {
        let spread = |footprint_m: f32| {
            let samples: Vec<f32> =
                (0..400).map(|i| detail(0.37 * i as f32, 0.11 * i as f32, 5, footprint_m)).collect();
            let mean = samples.iter().sum::<f32>() / samples.len() as f32;
            (samples.iter().map(|s| (s - mean).powi(2)).sum::<f32>() / samples.len() as f32).sqrt()
        };
        assert!(spread(0.001) > 0.3, "near: {}", spread(0.001));
        assert_eq!(spread(3.0), 0.0, "a pixel wider than every octave");
    }

    #[test]
    fn a_stripe_covers_its_share_of_a_pixel() {
        for (x, share) in [(0.0, 0.0), (1.0, 0.5), (1.5, 1.0), (2.0, 0.5), (3.0, 0.0)] {
            assert_eq!(stripe(x, 1.0, 2.0, 0.5), share, "x = {x}");
        }
    }
}
