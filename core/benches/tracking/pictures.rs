//! Two pairs of pictures: one as recorded, one whose flow is known.

use super::problems::normal;
use kilogs_core::frame::pyramid::bytes_needed;
use kilogs_core::frame::{ImageView, Pyramid};
use kilogs_core::math::Rng;
use std::path::Path;

/// Width and height of all pictures, px: KITTI's.
pub const SIZE: [usize; 2] = [1241, 376];
const LEVELS: usize = 4;
/// Rectangles of an invented picture, and their largest side, px.
const RECTANGLES: usize = 6000;
const LARGEST_PX: usize = 60;

/// What a picture differs by from the one before.
pub struct Difference {
    /// For people.
    pub name: &'static str,
    /// About the middle of the picture.
    pub zoom: f64,
    /// About the middle of the picture, rad.
    pub turn_rad: f64,
    /// After that, px.
    pub shift_px: [f64; 2],
    /// Of both pictures, about their mean.
    pub contrast: f64,
    /// Of the second.
    pub gain: f64,
    /// Of the second, grey values.
    pub bias: f64,
    /// Length of the second's horizontal blur, px, odd.
    pub blur_px: usize,
    /// Standard deviation of the noise added last, grey values; of both pictures where the contrast is not 1.
    pub noise: f64,
}

impl Difference {
    /// A step of about 12 px at the borders.
    pub const SMALL: Self = Self {
        name: "a step",
        zoom: 1.02,
        turn_rad: 0.004,
        shift_px: [3.3, -1.7],
        contrast: 1.0,
        gain: 1.0,
        bias: 0.0,
        blur_px: 1,
        noise: 2.0,
    };
    /// A step of about 30 px at the borders.
    pub const PLAIN: Self = Self { zoom: 1.05, turn_rad: 0.01, shift_px: [6.3, -3.4], ..Self::SMALL };

    /// Where a pixel of the first picture is in the second, pixel centres at +0.5.
    pub fn target_px(&self, [x, y]: [f32; 2]) -> [f64; 2] {
        let (dx, dy) = (f64::from(x) - center_px()[0], f64::from(y) - center_px()[1]);
        let (sin, cos) = self.turn_rad.sin_cos();
        let at = |along: f64, k: usize| center_px()[k] + self.zoom * along + self.shift_px[k];
        [at(cos * dx - sin * dy, 0), at(sin * dx + cos * dy, 1)]
    }

    /// Where a pixel of the second picture is in the first.
    fn source_px(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let (sin, cos) = self.turn_rad.sin_cos();
        let dx = (x - center_px()[0] - self.shift_px[0]) / self.zoom;
        let dy = (y - center_px()[1] - self.shift_px[1]) / self.zoom;
        [center_px()[0] + cos * dx + sin * dy, center_px()[1] - sin * dx + cos * dy]
    }
}

/// A picture and the next one, rows without gaps.
pub struct Pair {
    /// The earlier.
    pub first: Vec<u8>,
    /// The later.
    pub second: Vec<u8>,
}

impl Pair {
    /// Two neighbouring pictures that `peers.py` has stored.
    pub fn stored(folder: &Path) -> std::io::Result<Self> {
        let read = |name: &str| {
            let bytes = std::fs::read(folder.join(name))?;
            let is_whole = bytes.len() == SIZE[0] * SIZE[1];
            is_whole.then_some(bytes).ok_or_else(|| std::io::Error::other(format!("{name} is not 1241x376 bytes")))
        };
        Ok(Self { first: read("a.gray")?, second: read("b.gray")? })
    }

    /// Rectangles over rectangles, and the same moved.
    pub fn invented() -> Self {
        let mut rng = Rng::new(1, 2, 3);
        let mut first = vec![128; SIZE[0] * SIZE[1]];
        for _ in 0..RECTANGLES {
            let (left, top) = (rng.below(SIZE[0]), rng.below(SIZE[1]));
            let (width, height) = (1 + rng.below(LARGEST_PX), 1 + rng.below(LARGEST_PX));
            let grey = 40 + rng.below(176) as u8;
            for row in first.chunks_exact_mut(SIZE[0]).skip(top).take(height) {
                row.iter_mut().skip(left).take(width).for_each(|pixel| *pixel = grey);
            }
        }
        let second = moved(&first, &Difference::SMALL);
        Self { first, second }
    }

    /// The first picture and itself, so different.
    pub fn with_difference(&self, difference: &Difference) -> Self {
        let mean = self.first.iter().map(|&p| f64::from(p)).sum::<f64>() / self.first.len() as f64;
        let mut rng = Rng::new(7, 8, 9);
        let noise = if difference.contrast == 1.0 { 0.0 } else { difference.noise };
        let mut grey = |&p: &u8| {
            let value = mean + difference.contrast * (f64::from(p) - mean) + noise * normal(&mut rng);
            value.round().clamp(0.0, 255.0) as u8
        };
        Self { first: self.first.iter().map(&mut grey).collect(), second: moved(&self.first, difference) }
    }
}

fn center_px() -> [f64; 2] {
    SIZE.map(|side| 0.5 * side as f64)
}

fn moved(picture: &[u8], difference: &Difference) -> Vec<u8> {
    let mean = picture.iter().map(|&p| f64::from(p)).sum::<f64>() / picture.len() as f64;
    let mut rng = Rng::new(4, 5, 6);
    let place = |i: usize| difference.source_px([(i % SIZE[0]) as f64 + 0.5, (i / SIZE[0]) as f64 + 0.5]);
    let sharp: Vec<f64> = (0..picture.len()).map(|i| cubic(picture, place(i))).collect();
    let half = difference.blur_px / 2;
    let grey = |i: usize| {
        let (x, row) = (i % SIZE[0], i / SIZE[0] * SIZE[0]);
        let run = &sharp[row + x.saturating_sub(half)..row + (x + half + 1).min(SIZE[0])];
        let blurred = run.iter().sum::<f64>() / run.len() as f64;
        let exposed = difference.gain * (mean + difference.contrast * (blurred - mean)) + difference.bias;
        (exposed + difference.noise * normal(&mut rng)).round().clamp(0.0, 255.0) as u8
    };
    (0..picture.len()).map(grey).collect()
}

/// Cubic convolution with a = -0.5 (Keys 1981, eq. 15), replicated beyond the border.
fn cubic(picture: &[u8], [x, y]: [f64; 2]) -> f64 {
    let weight = |d: f64| match d.abs() {
        d if d < 1.0 => (1.5 * d - 2.5) * d * d + 1.0,
        d if d < 2.0 => ((-0.5 * d + 2.5) * d - 4.0) * d + 2.0,
        _ => 0.0,
    };
    let (left, top) = ((x - 0.5).floor() as i64 - 1, (y - 0.5).floor() as i64 - 1);
    let inside = |k: i64, side: usize| k.clamp(0, side as i64 - 1) as usize;
    let mut sum = 0.0;
    for (row, column) in (top..top + 4).flat_map(|row| (left..left + 4).map(move |column| (row, column))) {
        let pixel = picture[inside(row, SIZE[1]) * SIZE[0] + inside(column, SIZE[0])];
        sum += weight(x - 0.5 - column as f64) * weight(y - 0.5 - row as f64) * f64::from(pixel);
    }
    sum
}

/// The picture as core takes it.
pub fn view(picture: &[u8]) -> ImageView<'_> {
    ImageView::new(picture, SIZE[0], SIZE[1], SIZE[0]).expect("rows without gaps")
}

/// Memory of [`pyramid`].
pub fn pyramid_storage() -> Vec<u8> {
    vec![0; bytes_needed(SIZE[0], SIZE[1], LEVELS)]
}

/// Four levels of a picture.
pub fn pyramid<'m>(picture: &[u8], storage: &'m mut [u8]) -> Pyramid<'m> {
    let mut pyramid = Pyramid::new(storage, SIZE[0], SIZE[1], LEVELS).expect("asked for its size");
    pyramid.build(view(picture)).expect("same size");
    pyramid
}
