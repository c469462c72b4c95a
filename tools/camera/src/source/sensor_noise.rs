//! Noise of a sensor.

use kilogs_core::math::Rng;

/// Adds sensor noise whose sum of four uniform draws is close to a normal distribution. `sigma` is in steps of 8 bits.
pub fn add_noise(pixels: &mut [u8], sigma: f64, rng: &mut Rng) {
    if sigma == 0.0 {
        return;
    }
    // Four bytes, each uniform on 0..=255, have a standard deviation of 2 * 73.9.
    let gain = (sigma / 147.8) as f32;
    for byte in pixels {
        let bits = rng.next_u32();
        let sum: u32 = bits.to_le_bytes().iter().map(|&b| u32::from(b)).sum();
        let noisy = f32::from(*byte) + gain * (sum as f32 - 510.0);
        *byte = (noisy + 0.5).clamp(0.0, 255.0) as u8;
    }
}
