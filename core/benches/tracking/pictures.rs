//! Two pairs of pictures: one as recorded, one whose flow is known.

use super::problems::normal;
use kilogs_core::frame::pyramid::bytes_needed;
use kilogs_core::frame::{ImageView, Pyramid};
use kilogs_core::math::Rng;
use std::path::Path;

/// Width and height of all pictures, px: KITTI's.
pub const SIZE: [usize; 2] = [1241, 376];
const LEVELS: usize = 4;
/// Zoom, turn (rad) and shift (px) of the second pair: a step of about 12 px at the borders.
const ZOOM: f64 = 1.02;
const TURN_RAD: f64 = 0.004;
const SHIFT_PX: [f64; 2] = [3.3, -1.7];
/// Standard deviation of the noise added to the moved picture, grey values.
const NOISE_GREY: f64 = 2.0;
/// Rectangles of an invented picture, and their largest side, px.
const RECTANGLES: usize = 6000;
const LARGEST_PX: usize = 60;

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
        let second = moved(&first);
        Self { first, second }
    }

    /// The first picture and itself moved by [`true_target_px`], with noise.
    pub fn with_known_flow(&self) -> Self {
        Self { first: self.first.clone(), second: moved(&self.first) }
    }
}

/// Where a pixel of the first picture is in the second, pixel centres at +0.5.
pub fn true_target_px([x, y]: [f32; 2]) -> [f64; 2] {
    let (dx, dy) = (f64::from(x) - center_px()[0], f64::from(y) - center_px()[1]);
    let (sin, cos) = TURN_RAD.sin_cos();
    let at = |along: f64, k: usize| center_px()[k] + ZOOM * along + SHIFT_PX[k];
    [at(cos * dx - sin * dy, 0), at(sin * dx + cos * dy, 1)]
}

fn center_px() -> [f64; 2] {
    SIZE.map(|side| 0.5 * side as f64)
}

fn moved(picture: &[u8]) -> Vec<u8> {
    let mut rng = Rng::new(4, 5, 6);
    let (sin, cos) = TURN_RAD.sin_cos();
    let grey = |i: usize| {
        let (x, y) = ((i % SIZE[0]) as f64 + 0.5, (i / SIZE[0]) as f64 + 0.5);
        let dx = (x - center_px()[0] - SHIFT_PX[0]) / ZOOM;
        let dy = (y - center_px()[1] - SHIFT_PX[1]) / ZOOM;
        let source = [center_px()[0] + cos * dx + sin * dy, center_px()[1] - sin * dx + cos * dy];
        (cubic(picture, source) + NOISE_GREY * normal(&mut rng)).round().clamp(0.0, 255.0) as u8
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
