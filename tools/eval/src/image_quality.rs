//! PSNR and SSIM of a rendered image against the camera's, on values in [0, 1] as the camera encoded them.
//!
//! One definition for every figure in reports: native resolution, no per-view correction, each image judged
//! on its own and the figures averaged over images. An `f32` image is clamped to [0, 1] first, as a display
//! would do.

use std::fmt;

/// A pixel value as a number in [0, 1].
pub trait Sample: Copy {
    /// The value, clamped to [0, 1]; NaN stays NaN.
    fn unit(self) -> f64;
}

impl Sample for u8 {
    fn unit(self) -> f64 {
        f64::from(self) / 255.0
    }
}

impl Sample for f32 {
    fn unit(self) -> f64 {
        f64::from(self).clamp(0.0, 1.0)
    }
}

/// Size of both images; channels are interleaved, rows packed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImageShape {
    /// Width, px.
    pub width: usize,
    /// Height, px.
    pub height: usize,
    /// Values per pixel.
    pub channels: usize,
}

impl ImageShape {
    /// Values in an image.
    pub fn n_samples(&self) -> usize {
        self.width * self.height * self.channels
    }
}

/// What one image scores.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImageQuality {
    /// Peak signal-to-noise ratio, dB; infinite for identical images.
    pub psnr_db: f64,
    /// Mean structural similarity, at most 1; NaN when the image is smaller than the window.
    pub ssim: f64,
}

/// An image that cannot be judged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ImageProblem {
    /// An image does not have the size that the meter was made for; make another meter.
    OtherSize {
        /// Values in the image.
        samples: usize,
        /// Values that the meter expects.
        needed: usize,
    },
    /// A value is NaN: the renderer is broken.
    NotANumber {
        /// Position of the first one in the image.
        sample_idx: usize,
    },
}

impl fmt::Display for ImageProblem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::OtherSize { samples, needed } => write!(f, "image has {samples} values, {needed} are needed"),
            Self::NotANumber { sample_idx } => write!(f, "value {sample_idx} of the image is not a number"),
        }
    }
}

impl std::error::Error for ImageProblem {}

/// Side of the SSIM window, px.
const WINDOW_PX: usize = 11;
/// Standard deviation of the window's weights, px.
const WINDOW_SIGMA_PX: f64 = 1.5;
/// Stabilisers (K1 L)^2 and (K2 L)^2 with K1 = 0.01, K2 = 0.03 and L = 1.
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;
/// Weighted sums that SSIM needs: x, y, x^2, y^2, xy.
const MOMENTS: usize = 5;

/// Judges images of one size, one after the other, in the memory taken at construction.
#[derive(Clone, Debug)]
pub struct ImageQualityMeter {
    shape: ImageShape,
    weights: [f64; WINDOW_PX],
    /// One row of the image: a stretch of `width` values for each moment.
    row: Vec<f64>,
    /// Horizontally filtered moments of the last 11 rows: for each row, a stretch of values for each moment.
    filtered: Vec<f64>,
    /// Moments of one row of windows.
    windows: Vec<f64>,
}

impl ImageQualityMeter {
    /// A meter for images of this shape; takes about 520 bytes per column.
    pub fn new(shape: ImageShape) -> Self {
        let n_filtered = MOMENTS * positions(shape.width);
        Self {
            shape,
            weights: gaussian_weights(),
            row: vec![0.0; MOMENTS * shape.width],
            filtered: vec![0.0; WINDOW_PX * n_filtered],
            windows: vec![0.0; n_filtered],
        }
    }

    /// PSNR and SSIM of `rendered` against `camera`.
    ///
    /// PSNR is `10 log10(1 / MSE)` over all pixels and channels. SSIM has an 11 x 11 Gaussian window with
    /// sigma 1.5 px, K1 = 0.01, K2 = 0.03, weighted (population) covariances, and is averaged over all
    /// windows that lie inside the image and over the channels.
    ///
    /// # Errors
    /// [`ImageProblem`] when a size or a value is wrong.
    ///
    /// # Source
    /// Wang, Bovik, Sheikh & Simoncelli 2004, "Image quality assessment: from error visibility to structural
    /// similarity", eq. 13-17. Own implementation.
    pub fn judge<A: Sample, B: Sample>(&mut self, rendered: &[A], camera: &[B]) -> Result<ImageQuality, ImageProblem> {
        let needed = self.shape.n_samples();
        for samples in [rendered.len(), camera.len()] {
            if samples != needed {
                return Err(ImageProblem::OtherSize { samples, needed });
            }
        }
        let mut sum_squared = 0.0;
        for (sample_idx, (r, c)) in rendered.iter().zip(camera).enumerate() {
            let difference = r.unit() - c.unit();
            if difference.is_nan() {
                return Err(ImageProblem::NotANumber { sample_idx });
            }
            sum_squared += difference * difference;
        }
        let psnr_db = 10.0 * (needed as f64 / sum_squared).log10();
        let channels = self.shape.channels;
        let sum_ssim: f64 = (0..channels).map(|channel| self.ssim_of_channel(rendered, camera, channel)).sum();
        Ok(ImageQuality { psnr_db, ssim: sum_ssim / channels as f64 })
    }

    fn ssim_of_channel<A: Sample, B: Sample>(&mut self, rendered: &[A], camera: &[B], channel: usize) -> f64 {
        let n_columns = positions(self.shape.width);
        let n_windows = n_columns * positions(self.shape.height);
        if n_windows == 0 {
            return f64::NAN;
        }
        let row_samples = self.shape.width * self.shape.channels;
        let rows = rendered.chunks_exact(row_samples).zip(camera.chunks_exact(row_samples));
        let mut sum = 0.0;
        for (y, (rendered, camera)) in rows.enumerate() {
            self.filter_row(rendered, camera, channel, y);
            if y + 1 >= WINDOW_PX {
                sum += self.ssim_of_windows(y);
            }
        }
        sum / n_windows as f64
    }

    /// Filters row `y` horizontally into its place among the last 11.
    fn filter_row<A: Sample, B: Sample>(&mut self, rendered: &[A], camera: &[B], channel: usize, y: usize) {
        let ImageShape { width, channels, .. } = self.shape;
        let n_columns = positions(width);
        let samples = rendered.iter().zip(camera).skip(channel).step_by(channels);
        for (x, (r, c)) in samples.enumerate() {
            let (r, c) = (r.unit(), c.unit());
            for (moment, value) in [r, c, r * r, c * c, r * c].into_iter().enumerate() {
                self.row[moment * width + x] = value;
            }
        }
        let filtered = &mut self.filtered[y % WINDOW_PX * MOMENTS * n_columns..][..MOMENTS * n_columns];
        filtered.fill(0.0);
        for (values, out) in self.row.chunks_exact(width).zip(filtered.chunks_exact_mut(n_columns)) {
            for (k, weight) in self.weights.iter().enumerate() {
                out.iter_mut().zip(&values[k..]).for_each(|(sum, value)| *sum += weight * value);
            }
        }
    }

    /// Sum of SSIM over the windows whose last row is `y`.
    fn ssim_of_windows(&mut self, y: usize) -> f64 {
        let n_filtered = self.windows.len();
        self.windows.fill(0.0);
        for (k, weight) in self.weights.iter().enumerate() {
            let row = &self.filtered[(y + 1 + k) % WINDOW_PX * n_filtered..][..n_filtered];
            self.windows.iter_mut().zip(row).for_each(|(sum, value)| *sum += weight * value);
        }
        let n_columns = n_filtered / MOMENTS;
        let moments = |column: usize| std::array::from_fn(|moment| self.windows[moment * n_columns + column]);
        (0..n_columns).map(|column| ssim_of_moments(&moments(column))).sum()
    }
}

/// Places of the window along a side of `length` px.
fn positions(length: usize) -> usize {
    (length + 1).saturating_sub(WINDOW_PX)
}

fn gaussian_weights() -> [f64; WINDOW_PX] {
    let center = (WINDOW_PX / 2) as f64;
    let raw: [f64; WINDOW_PX] = std::array::from_fn(|k| {
        let from_center = (k as f64 - center) / WINDOW_SIGMA_PX;
        (-0.5 * from_center * from_center).exp()
    });
    let sum: f64 = raw.iter().sum();
    raw.map(|weight| weight / sum)
}

fn ssim_of_moments(&[x, y, xx, yy, xy]: &[f64; MOMENTS]) -> f64 {
    let (variance_x, variance_y, covariance) = (xx - x * x, yy - y * y, xy - x * y);
    (2.0 * x * y + C1) * (2.0 * covariance + C2) / ((x * x + y * y + C1) * (variance_x + variance_y + C2))
}

/// Averages over images, and the worst stretch of road, without keeping the images' figures.
#[derive(Clone, Debug, Default)]
pub struct QualityAverage {
    n: u64,
    sum_psnr_db: f64,
    sum_ssim: f64,
    stretch: u64,
    stretch_n: u64,
    stretch_sum_psnr_db: f64,
    worst_stretch_db: Option<f64>,
}

/// Length of the stretches among which the worst is looked for, m.
pub const STRETCH_M: f64 = 100.0;

impl QualityAverage {
    /// Adds an image taken `driven_m` metres along the way; images come in the order of the drive.
    pub fn push(&mut self, driven_m: f64, quality: ImageQuality) {
        let stretch = (driven_m / STRETCH_M) as u64;
        if stretch != self.stretch {
            self.worst_stretch_db = self.worst_stretch_db();
            (self.stretch, self.stretch_n, self.stretch_sum_psnr_db) = (stretch, 0, 0.0);
        }
        self.n += 1;
        self.sum_psnr_db += quality.psnr_db;
        self.sum_ssim += quality.ssim;
        self.stretch_n += 1;
        self.stretch_sum_psnr_db += quality.psnr_db;
    }

    /// Mean of the images' PSNR, dB; `None` without images.
    pub fn psnr_db(&self) -> Option<f64> {
        (self.n > 0).then(|| self.sum_psnr_db / self.n as f64)
    }

    /// Mean of the images' SSIM; `None` without images.
    pub fn ssim(&self) -> Option<f64> {
        (self.n > 0).then(|| self.sum_ssim / self.n as f64)
    }

    /// Mean PSNR of the worst 100 m stretch, dB; stretches begin at multiples of 100 m driven.
    pub fn worst_stretch_db(&self) -> Option<f64> {
        let current_db = (self.stretch_n > 0).then(|| self.stretch_sum_psnr_db / self.stretch_n as f64);
        match (self.worst_stretch_db, current_db) {
            (Some(worst), Some(current)) => Some(worst.min(current)),
            (worst, current) => worst.or(current),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHAPE: ImageShape = ImageShape { width: 16, height: 12, channels: 3 };

    #[test]
    fn a_uniform_difference_has_the_psnr_of_its_size() {
        let mut meter = ImageQualityMeter::new(SHAPE);
        let (dark, bright) = (vec![0.25_f32; SHAPE.n_samples()], vec![0.35_f32; SHAPE.n_samples()]);
        let quality = meter.judge(&dark, &bright).expect("judged");
        assert!((quality.psnr_db - 20.0).abs() < 1e-5, "{quality:?}");
        // Without texture SSIM is its luminance term alone.
        let expected = (2.0 * 0.25 * 0.35 + C1) / (0.25_f64.powi(2) + 0.35_f64.powi(2) + C1);
        assert!((quality.ssim - expected).abs() < 1e-6, "{quality:?}");
    }

    #[test]
    fn identical_images_are_perfect_and_bytes_meet_floats() {
        let bytes: Vec<u8> = (0..SHAPE.n_samples()).map(|k| (k * 37 % 256) as u8).collect();
        let floats: Vec<f32> = bytes.iter().map(|&b| f32::from(b) / 255.0).collect();
        let mut meter = ImageQualityMeter::new(SHAPE);
        let same = meter.judge(&bytes, &bytes).expect("judged");
        assert!(same.psnr_db == f64::INFINITY && (same.ssim - 1.0).abs() < 1e-12, "{same:?}");
        assert!(meter.judge(&floats, &bytes).is_ok_and(|q| q.psnr_db > 140.0));
    }

    #[test]
    fn bad_images_are_refused_and_small_ones_have_no_ssim() {
        let mut meter = ImageQualityMeter::new(SHAPE);
        let good = vec![0.5_f32; SHAPE.n_samples()];
        let mut poisoned = good.clone();
        poisoned[7] = f32::NAN;
        assert_eq!(meter.judge(&poisoned, &good), Err(ImageProblem::NotANumber { sample_idx: 7 }));
        assert_eq!(meter.judge(&good[1..], &good), Err(ImageProblem::OtherSize { samples: 575, needed: 576 }));
        let tiny = ImageShape { width: 10, height: 20, channels: 1 };
        let quality = ImageQualityMeter::new(tiny).judge(&[0_u8; 200], &[51_u8; 200]).expect("judged");
        assert!((quality.psnr_db - 13.979_400_086_720_377).abs() < 1e-12 && quality.ssim.is_nan(), "{quality:?}");
    }

    #[test]
    fn the_worst_stretch_is_a_mean_over_its_images() {
        let check = |images: &[(f64, f64)], mean: Option<f64>, worst: Option<f64>| {
            let mut average = QualityAverage::default();
            images.iter().for_each(|&(driven_m, psnr_db)| average.push(driven_m, ImageQuality { psnr_db, ssim: 0.5 }));
            assert_eq!((average.psnr_db(), average.worst_stretch_db()), (mean, worst));
            assert_eq!(average.ssim(), mean.map(|_| 0.5));
        };
        check(&[], None, None);
        check(&[(50.0, 20.0)], Some(20.0), Some(20.0));
        check(&[(0.0, 20.0), (99.0, 22.0), (101.0, 10.0), (150.0, 30.0), (399.0, 18.0)], Some(20.0), Some(18.0));
        check(&[(120.0, 10.0), (250.0, 30.0)], Some(20.0), Some(10.0));
    }
}
