//! The loss as its equations say, in f64, pixel by pixel.

/// Mean SSIM of two planes with 11x11 windows of sigma 1.5 px that reach over the border onto zeros
/// (Wang et al. 2004, eq. 13).
pub fn ssim(x: &[f64], y: &[f64], width: usize) -> f64 {
    let height = x.len() / width;
    let mut weights: [f64; 11] = core::array::from_fn(|i| (-(i as f64 - 5.0).powi(2) / (2.0 * 1.5 * 1.5)).exp());
    let norm: f64 = weights.iter().sum();
    weights.iter_mut().for_each(|w| *w /= norm);
    let mut total = 0.0;
    for row in 0..height as isize {
        for column in 0..width as isize {
            let (mut mx, mut my, mut xx, mut yy, mut xy) = (0.0, 0.0, 0.0, 0.0, 0.0);
            for (dr, dc) in (-5..=5).flat_map(|dr| (-5..=5).map(move |dc| (dr, dc))) {
                let (r, c) = (row + dr, column + dc);
                if r < 0 || c < 0 || r >= height as isize || c >= width as isize {
                    continue;
                }
                let w = weights[(dr + 5) as usize] * weights[(dc + 5) as usize];
                let (a, b) = (x[r as usize * width + c as usize], y[r as usize * width + c as usize]);
                mx += w * a;
                my += w * b;
                xx += w * a * a;
                yy += w * b * b;
                xy += w * a * b;
            }
            let (c1, c2) = (0.01f64.powi(2), 0.03f64.powi(2));
            total += (2.0 * mx * my + c1) * (2.0 * (xy - mx * my) + c2)
                / ((mx * mx + my * my + c1) * (xx - mx * mx + yy - my * my + c2));
        }
    }
    total / x.len() as f64
}

#[test]
fn equal_pictures_score_one_and_inverted_ones_less_than_zero() {
    let x: Vec<f64> = (0..20 * 15).map(|i| if i % 3 == 0 { 0.9 } else { 0.1 }).collect();
    let inverted: Vec<f64> = x.iter().map(|v| 1.0 - v).collect();
    assert!((ssim(&x, &x, 20) - 1.0).abs() < 1e-12);
    assert!(ssim(&inverted, &x, 20) < 0.0);
}
