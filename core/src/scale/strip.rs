//! The road strip in two images, and the equations of its alignment.

use super::ground_plane::{RoadPair, RoadProblem, RoadSettings};
use super::tiles::RoadMask;
use crate::camera::{Mounting, Pinhole};
use crate::frame::ImageView;
use nalgebra::{SMatrix, SVector, Unit, Vector3};

/// Width of Tukey's kernel in standard deviations (95 % efficiency).
const TUKEY_SIGMAS: f64 = 4.685;
/// Standard deviation over mean absolute deviation of Gaussian noise.
const SIGMA_PER_MEAN_ABSOLUTE: f64 = 1.2533;
/// Camera noise and rounding, grey values: a residual is never weighed as if it were smaller.
const MIN_NOISE_GREY: f64 = 1.0;
/// Neighbouring pixels and the interpolation share noise: one in this many counts as independent.
const PIXELS_PER_INDEPENDENT: f64 = 16.0;
/// A step that moves the nearest road by less than this many pixels ends the iteration.
const NEGLIGIBLE_STEP_PX: f64 = 0.005;
pub(super) type Normal5 = SMatrix<f64, 5, 5>;
pub(super) type Vector5 = SVector<f64, 5>;

/// Rows and columns of the strip in one level, and the maps between its pixels and rays.
pub(super) struct Strip<'a> {
    pub(super) later: ImageView<'a>,
    earlier: ImageView<'a>,
    pub(super) camera: Pinhole,
}

impl<'a> Strip<'a> {
    pub(super) fn new(pair: &RoadPair<'a, '_>, level: usize) -> Option<Self> {
        let (later, earlier) = (pair.later.level(level)?.image(), pair.earlier.level(level)?.image());
        // Levels drop odd columns, so the factor is exactly a power of two and not the ratio of the widths.
        let factor = 1.0 / f64::from(1u32 << level);
        let c = pair.camera;
        let camera = Pinhole {
            width: u32::try_from(later.width()).ok()?,
            height: u32::try_from(later.height()).ok()?,
            fx: c.fx * factor,
            fy: c.fy * factor,
            cx: c.cx * factor,
            cy: c.cy * factor,
        };
        Some(Self { later, earlier, camera })
    }

    /// Height of a row's centre on the plane z = 1.
    pub(super) fn y_z1(&self, row: usize) -> f64 {
        (row as f64 + 0.5 - self.camera.cy) / self.camera.fy
    }

    /// Ray of a pixel's centre, with z = 1.
    pub(super) fn ray(&self, column: usize, row: usize) -> Vector3<f64> {
        Vector3::new((column as f64 + 0.5 - self.camera.cx) / self.camera.fx, self.y_z1(row), 1.0)
    }

    /// Grey value of the later image.
    pub(super) fn later_at(&self, column: usize, row: usize) -> Option<f64> {
        (row < self.later.height()).then(|| self.later.row(row).get(column).map(|&grey| f64::from(grey))).flatten()
    }

    /// Grey value of the earlier image where it sees a point, between the pixels.
    pub(super) fn earlier_grey(&self, in_earlier: &Vector3<f64>) -> Option<f64> {
        let c = &self.camera;
        // Pixel i is centred at i + 0.5.
        let x = c.fx * in_earlier.x / in_earlier.z + c.cx - 0.5;
        let y = c.fy * in_earlier.y / in_earlier.z + c.cy - 0.5;
        let (column, row) = (x as usize, y as usize);
        if !(x >= 0.0 && y >= 0.0 && row + 1 < self.earlier.height()) {
            return None;
        }
        let upper = self.earlier.row(row).get(column..column + 2)?;
        let lower = self.earlier.row(row + 1).get(column..column + 2)?;
        let (fx, fy) = (x - column as f64, y - row as f64);
        let mix = |pixels: &[u8]| f64::from(pixels[0]) + fx * (f64::from(pixels[1]) - f64::from(pixels[0]));
        let (above, below) = (mix(upper), mix(lower));
        Some(above + fy * (below - above))
    }
}

/// Value and gradient of an image at a sub-pixel position whose 4x4 neighbourhood is inside.
fn sample(image: &ImageView<'_>, x_px: f64, y_px: f64) -> Option<(f64, f64, f64)> {
    // Pixel i is centred at i + 0.5.
    let (x, y) = (x_px - 0.5, y_px - 0.5);
    let (x0, y0) = (libm::floor(x), libm::floor(y));
    if !(x0 >= 1.0 && y0 >= 1.0 && x0 + 2.0 < image.width() as f64 && y0 + 2.0 < image.height() as f64) {
        return None;
    }
    let (fx, fy) = (x - x0, y - y0);
    let (column, row) = (x0 as usize, y0 as usize);
    let at = |dy: usize| -> Option<[f64; 4]> {
        let r = image.row(row + dy - 1).get(column - 1..column + 3)?;
        Some([f64::from(r[0]), f64::from(r[1]), f64::from(r[2]), f64::from(r[3])])
    };
    let (above, upper, lower, below) = (at(0)?, at(1)?, at(2)?, at(3)?);
    let mix = |r: &[f64; 4], i: usize| r[i] + fx * (r[i + 1] - r[i]);
    let value = mix(&upper, 1) + fy * (mix(&lower, 1) - mix(&upper, 1));
    let dx = |r: &[f64; 4]| 0.5 * ((r[2] - r[0]) * (1.0 - fx) + (r[3] - r[1]) * fx);
    let gradient_x = dx(&upper) + fy * (dx(&lower) - dx(&upper));
    let gradient_y = 0.5 * ((mix(&lower, 1) - mix(&above, 1)) * (1.0 - fy) + (mix(&below, 1) - mix(&upper, 1)) * fy);
    Some((value, gradient_x, gradient_y))
}

#[derive(Clone, Copy)]
pub(super) struct Alignment {
    /// Normal over height, 1/m.
    pub(super) plane: Vector3<f64>,
    gain: f64,
    bias: f64,
}

/// How well the strips agree.
pub(super) struct Fit {
    pub(super) n_pixels: usize,
    pub(super) correlation: f64,
    noise: f64,
}

/// Sums for the correlation of two strips.
#[derive(Default)]
struct Moments {
    n: f64,
    a: f64,
    b: f64,
    aa: f64,
    bb: f64,
    ab: f64,
    absolute: f64,
}

impl Moments {
    fn add(&mut self, a: f64, b: f64, weight: f64, absolute: f64) {
        self.n += weight;
        self.a += weight * a;
        self.b += weight * b;
        self.aa += weight * a * a;
        self.bb += weight * b * b;
        self.ab += weight * a * b;
        self.absolute += weight * absolute;
    }

    fn correlation(&self) -> f64 {
        let covariance = self.ab - self.a * self.b / self.n;
        let (va, vb) = (self.aa - self.a * self.a / self.n, self.bb - self.b * self.b / self.n);
        covariance / libm::sqrt(va * vb).max(f64::MIN_POSITIVE)
    }
}

impl Alignment {
    /// The road at this plane, equally bright in both images.
    pub(super) fn at(plane: Vector3<f64>) -> Self {
        Self { plane, gain: 1.0, bias: 0.0 }
    }

    /// Gauss-Newton on one level; returns the last normal equations and the fit.
    pub(super) fn iterate(
        &mut self,
        strip: &Strip<'_>,
        pair: &RoadPair<'_, '_>,
        mask: &RoadMask,
        mounting: &Mounting,
        settings: &RoadSettings,
    ) -> Result<(Normal5, Fit), RoadProblem> {
        let nearest_z1 = Vector3::new(0.0, mounting.height_m / settings.distance_m[0], 1.0);
        let px_per_plane = strip.camera.fy * pair.earlier_from_later.translation.vector.norm() * nearest_z1.y;
        let mut noise = f64::INFINITY;
        let mut last = None;
        for _ in 0..settings.max_iterations {
            let (mut hessian, mut gradient, fit) =
                self.equations(strip, pair, mask, [mounting.height_m, noise], settings);
            if fit.n_pixels < settings.min_pixels {
                return Err(RoadProblem::TooFewPixels { found: fit.n_pixels, needed: settings.min_pixels });
            }
            noise = fit.noise;
            let independent = 1.0 / (noise * noise * PIXELS_PER_INDEPENDENT);
            hessian *= independent;
            gradient *= independent;
            self.add_prior(pair, settings, &mut hessian, &mut gradient);
            let Some(step) = hessian.cholesky().map(|c| -c.solve(&gradient)) else {
                return Err(RoadProblem::TooFewPixels { found: 0, needed: settings.min_pixels });
            };
            let plane_step = step.fixed_rows::<3>(0).into_owned();
            self.plane += plane_step;
            self.gain += step[3];
            self.bias += step[4];
            last = Some((hessian, fit));
            if plane_step.dot(&nearest_z1).abs() * px_per_plane < NEGLIGIBLE_STEP_PX {
                break;
            }
        }
        last.ok_or(RoadProblem::TooFewPixels { found: 0, needed: settings.min_pixels })
    }

    /// The direction of the plane vector should be the expected normal's, within its uncertainty.
    fn add_prior(
        &self,
        pair: &RoadPair<'_, '_>,
        settings: &RoadSettings,
        hessian: &mut Normal5,
        gradient: &mut Vector5,
    ) {
        let normal = pair.expected_normal;
        let pitch_axis = Unit::new_normalize(Vector3::z() - normal * normal.z).into_inner();
        let roll_axis = normal.cross(&pitch_axis);
        for (axis, sigma_rad) in [(pitch_axis, settings.normal_sigma_rad[0]), (roll_axis, settings.normal_sigma_rad[1])]
        {
            let sigma = sigma_rad / pair.expected_height_m;
            let weight = 1.0 / (sigma * sigma);
            let off = axis.dot(&self.plane);
            for i in 0..3 {
                gradient[i] += weight * off * axis[i];
                for j in 0..3 {
                    hessian[(i, j)] += weight * axis[i] * axis[j];
                }
            }
        }
    }

    /// Normal equations (lower triangle) over the strip's pixels that show the road. An infinite `noise` weighs all pixels alike.
    pub(super) fn equations(
        &self,
        strip: &Strip<'_>,
        pair: &RoadPair<'_, '_>,
        mask: &RoadMask,
        [mounting_height_m, noise]: [f64; 2],
        settings: &RoadSettings,
    ) -> (Normal5, Vector5, Fit) {
        let (mut hessian, mut gradient, mut moments) = (Normal5::zeros(), Vector5::zeros(), Moments::default());
        let rotation = *pair.earlier_from_later.rotation.to_rotation_matrix().matrix();
        let t = pair.earlier_from_later.translation.vector;
        let c = &strip.camera;
        let mut n_pixels = 0;
        for row in 0..strip.later.height() {
            let y = strip.y_z1(row);
            let Some((first, end)) = columns(pair, mounting_height_m, settings, c, y) else {
                continue;
            };
            let pixels = strip.later.row(row);
            let standing = strip.earlier.row(row);
            for (column, &later) in pixels.iter().enumerate().take(end).skip(first) {
                let ray = Vector3::new((column as f64 + 0.5 - c.cx) / c.fx, y, 1.0);
                if mask.excludes(ray.x, y) {
                    continue;
                }
                let q = rotation * ray + t * self.plane.dot(&ray);
                let inverse_z = 1.0 / q.z;
                let (u, v) = (q.x * inverse_z, q.y * inverse_z);
                let Some((value, gx, gy)) = sample(&strip.earlier, c.fx * u + c.cx, c.fy * v + c.cy) else { continue };
                let later = f64::from(later);
                let r = self.gain * value + self.bias - later;
                let ratio = r / (TUKEY_SIGMAS * noise);
                let tukey = if ratio.abs() < 1.0 { (1.0 - ratio * ratio) * (1.0 - ratio * ratio) } else { 0.0 };
                // Zero where nothing changed, and symmetric in the two pixels that the residual compares: a weight
                // that knew only one of them would correlate its noise with the gradient and shorten the step.
                let still = standing.get(column).map_or(later, |&s| f64::from(s));
                let change2 = ((still - later) * (still - later - r)).max(0.0);
                let weight = tukey * (change2 + f64::EPSILON)
                    / (change2 + settings.standing_grey * settings.standing_grey + f64::EPSILON);
                n_pixels += 1;
                moments.add(value, later, weight, r.abs());
                let along = self.gain * inverse_z * (gx * c.fx * (t.x - u * t.z) + gy * c.fy * (t.y - v * t.z));
                let jacobian = Vector5::new(along * ray.x, along * ray.y, along, value, 1.0);
                add_lower(&mut hessian, weight, &jacobian);
                gradient.axpy(weight * r, &jacobian, 1.0);
            }
        }
        let absolute = moments.absolute / moments.n.max(f64::MIN_POSITIVE);
        let noise = (SIGMA_PER_MEAN_ABSOLUTE * absolute).max(MIN_NOISE_GREY);
        (hessian, gradient, Fit { n_pixels, correlation: moments.correlation(), noise })
    }
}

/// Adds a weighted square of a row to the lower triangle, which is all that its factorisation reads.
fn add_lower(hessian: &mut Normal5, weight: f64, row: &Vector5) {
    for j in 0..5 {
        let weighted = weight * row[j];
        for i in j..5 {
            hessian[(i, j)] += weighted * row[i];
        }
    }
}

/// Columns of a row that see the strip, which bends with the motion; `None` for rows above it or too near.
pub(super) fn columns(
    pair: &RoadPair<'_, '_>,
    height_m: f64,
    settings: &RoadSettings,
    camera: &Pinhole,
    y_z1: f64,
) -> Option<(usize, usize)> {
    let normal = pair.expected_normal;
    let depth_m = height_m / (normal.y * y_z1 + normal.z);
    if !(depth_m >= settings.distance_m[0] && depth_m <= settings.distance_m[1]) {
        return None;
    }
    // The vehicle goes on along the circle that it came on: x = curvature z^2 / 2.
    let curvature =
        pair.earlier_from_later.rotation.scaled_axis().y / pair.earlier_from_later.translation.vector.norm();
    let center_m = (0.5 * curvature * depth_m * depth_m).clamp(-depth_m, depth_m) * settings.bend;
    let (center_px, half_px) =
        (camera.cx + camera.fx * center_m / depth_m, camera.fx * settings.half_width_m / depth_m);
    let width_px = f64::from(camera.width);
    let first = libm::ceil(center_px - half_px - 0.5).clamp(0.0, width_px) as usize;
    let end = libm::ceil(center_px + half_px - 0.5).clamp(0.0, width_px) as usize;
    (first < end).then_some((first, end))
}
