//! How the surroundings of a point move: a shift and a linear map of offsets, from what its neighbours do.

/// One point of the scene in both images, px.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    pub(super) keyframe_px: [f32; 2],
    pub(super) current_px: [f32; 2],
}

/// Where `others` expect `start`, and the linear map of offsets around it.
///
/// Least squares of  q' = p' + d + (S + G) (q - p)  over the shift d and the change G of the shape S, with a prior on G, so
/// that two neighbours in a row give no wild shape; those that fit badly weigh less the second time. `sigma_px` is the
/// standard deviation of the others.
pub(super) fn fit(
    start: &Place,
    shape: [[f32; 2]; 2],
    sigma_px: f32,
    others: impl Iterator<Item = Place> + Clone,
) -> ([f32; 2], [[f32; 2]; 2]) {
    /// Standard deviation of G. Ours.
    const CHANGE_SIGMA: f32 = 0.2;
    let prior = (sigma_px / CHANGE_SIGMA) * (sigma_px / CHANGE_SIGMA);
    let mut shift = [0.0f32; 2];
    let mut change = [[0.0f32; 2]; 2];
    for pass in 0..2 {
        // Normal equations: 1, x, y, xx, xy, yy and the right sides for both components.
        let mut m = [0.0f32, 0.0, 0.0, prior, 0.0, prior];
        let mut b = [[0.0f32; 3]; 2];
        for other in others.clone() {
            let [x, y] = [0, 1].map(|k: usize| other.keyframe_px[k] - start.keyframe_px[k]);
            let d =
                [0, 1].map(|k: usize| other.current_px[k] - start.current_px[k] - shape[k][0] * x - shape[k][1] * y);
            let residual = |k: usize| d[k] - shift[k] - change[k][0] * x - change[k][1] * y;
            let residual2 = if pass == 0 { 0.0 } else { residual(0) * residual(0) + residual(1) * residual(1) };
            let weight = 1.0 / (1.0 + residual2 / (sigma_px * sigma_px));
            for (sum, term) in m.iter_mut().zip([1.0, x, y, x * x, x * y, y * y]) {
                *sum += weight * term;
            }
            for k in 0..2 {
                for (sum, term) in b[k].iter_mut().zip([1.0, x, y]) {
                    *sum += weight * term * d[k];
                }
            }
        }
        for k in 0..2 {
            if let Some([d, gx, gy]) = solve(m, b[k]) {
                (shift[k], change[k]) = (d, [gx, gy]);
            }
        }
    }
    let moved = |k: usize| [shape[k][0] + change[k][0], shape[k][1] + change[k][1]];
    ([start.current_px[0] + shift[0], start.current_px[1] + shift[1]], [moved(0), moved(1)])
}

/// Symmetric 3 x 3 system by cofactors; `None` when it is singular.
fn solve([n, x, y, xx, xy, yy]: [f32; 6], b: [f32; 3]) -> Option<[f32; 3]> {
    let (c00, c01, c02) = (xx * yy - xy * xy, xy * y - x * yy, x * xy - xx * y);
    let (c11, c12, c22) = (n * yy - y * y, x * y - n * xy, n * xx - x * x);
    let determinant = n * c00 + x * c01 + y * c02;
    if determinant.is_nan() || determinant <= 0.0 {
        return None;
    }
    let row = |c: [f32; 3]| (c[0] * b[0] + c[1] * b[1] + c[2] * b[2]) / determinant;
    Some([row([c00, c01, c02]), row([c01, c11, c12]), row([c02, c12, c22])])
}
