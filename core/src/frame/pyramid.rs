//! Image pyramid on borrowed storage, with replicated margins so that windows may hang over the border.

use super::ImageView;
use core::fmt;

/// Most levels a pyramid can have, the full image included.
pub const MAX_LEVELS: usize = 6;

/// Replicated pixels around every level, px: half a 21-px window, its gradient and its interpolation fit in.
pub const MARGIN_PX: usize = 16;

/// Bytes behind the last row of a level that a reader of whole SIMD rows may touch.
const SLACK_BYTES: usize = 64;

/// Columns per pass of the low-pass filter; bounds its stack.
const COLUMNS_PER_PASS: usize = 64;

/// Levels of half size each: a coordinate `x` of the image is exactly `x / 2^l` in level `l`.
///
/// That is the half-pixel convention (pixel `i` is centred at `i + 0.5`): a pixel of the next level sits on the
/// corner shared by four pixels, so the low-pass filter is the even binomial `[1 3 3 1] / 8` in each direction.
/// Odd last columns and rows are dropped.
///
/// # Source
/// Burt & Adelson 1983, with the even kernel in place of the odd one, whose levels would be shifted by a quarter pixel.
#[derive(Debug)]
pub struct Pyramid<'m> {
    storage: &'m mut [u8],
    layout: Layout,
}

/// Storage does not hold the pyramid of that size; the caller should ask [`bytes_needed`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PyramidStorageTooSmall {
    /// Bytes handed in.
    pub bytes: usize,
    /// Bytes needed.
    pub needed: usize,
}

impl fmt::Display for PyramidStorageTooSmall {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "pyramid storage has {} bytes, {} needed", self.bytes, self.needed)
    }
}

impl core::error::Error for PyramidStorageTooSmall {}

/// The image has another size than the pyramid was laid out for: drop the frame and count it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WrongImageSize {
    /// Width and height of the image, px.
    pub found: [u32; 2],
    /// Width and height of the pyramid, px.
    pub expected: [u32; 2],
}

impl fmt::Display for WrongImageSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ([w, h], [ew, eh]) = (self.found, self.expected);
        write!(f, "image is {w}x{h} px, the pyramid was laid out for {ew}x{eh}")
    }
}

impl core::error::Error for WrongImageSize {}

/// Bytes of storage of a pyramid with up to `levels` levels (at most [`MAX_LEVELS`]).
pub fn bytes_needed(width: usize, height: usize, levels: usize) -> usize {
    Layout::new(width, height, levels).bytes
}

impl<'m> Pyramid<'m> {
    /// Lays out a pyramid of black images. `storage` bounds its size: at least [`bytes_needed`] bytes.
    ///
    /// # Errors
    /// [`PyramidStorageTooSmall`] with the number of bytes that would do.
    pub fn new(
        storage: &'m mut [u8],
        width: usize,
        height: usize,
        levels: usize,
    ) -> Result<Self, PyramidStorageTooSmall> {
        let layout = Layout::new(width, height, levels);
        if storage.len() < layout.bytes {
            return Err(PyramidStorageTooSmall { bytes: storage.len(), needed: layout.bytes });
        }
        Ok(Self { storage, layout })
    }

    /// Copies the image into level 0 and filters it down to the last level.
    ///
    /// # Errors
    /// [`WrongImageSize`]; the pyramid then keeps its former content.
    ///
    /// # Cost
    /// O(width * height), about 4/3 of a pass over the image; 0.5 KiB of stack.
    pub fn build(&mut self, image: ImageView<'_>) -> Result<(), WrongImageSize> {
        let (width, height) = (self.width(), self.height());
        if (image.width(), image.height()) != (width, height) {
            let px = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
            return Err(WrongImageSize {
                found: [px(image.width()), px(image.height())],
                expected: [px(width), px(height)],
            });
        }
        let Some(first) = self.layout.level(0) else { return Ok(()) };
        for y in 0..height {
            let start = first.start_of(y);
            self.storage[start..start + width].copy_from_slice(image.row(y));
        }
        replicate_margins(&mut self.storage[first.offset..first.offset + first.bytes()], first);
        for l in 1..self.layout.n_levels {
            let (Some(fine), Some(coarse)) = (self.layout.level(l - 1), self.layout.level(l)) else { break };
            let (finer, coarser) = self.storage.split_at_mut(coarse.offset);
            let coarse_bytes = &mut coarser[..coarse.bytes()];
            halve(&finer[fine.offset..], fine, coarse_bytes, coarse);
            replicate_margins(coarse_bytes, coarse);
        }
        Ok(())
    }

    /// Levels, the full image included; fewer than asked for when the image is small.
    pub fn n_levels(&self) -> usize {
        self.layout.n_levels
    }

    /// Width of the full image, px.
    pub fn width(&self) -> usize {
        self.layout.level(0).map_or(0, |level| level.width)
    }

    /// Height of the full image, px.
    pub fn height(&self) -> usize {
        self.layout.level(0).map_or(0, |level| level.height)
    }

    /// Level `l`, `None` beyond the last.
    pub fn level(&self, l: usize) -> Option<PaddedImage<'_>> {
        let level = self.layout.level(l)?;
        let pixels = self.storage.get(level.offset..level.offset + level.bytes())?;
        Some(PaddedImage { pixels, width: level.width, height: level.height, stride: level.stride() })
    }

    /// The full image.
    pub fn image(&self) -> ImageView<'_> {
        self.level(0).map_or_else(ImageView::empty, |level| level.image())
    }
}

/// One level of a [`Pyramid`]: the image and [`MARGIN_PX`] replicated pixels on every side.
#[derive(Clone, Copy, Debug)]
pub struct PaddedImage<'a> {
    pixels: &'a [u8],
    width: usize,
    height: usize,
    stride: usize,
}

impl<'a> PaddedImage<'a> {
    /// Width without margins, px.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height without margins, px.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Bytes between the starts of two rows.
    pub fn stride(&self) -> usize {
        self.stride
    }

    /// The level without its margins.
    pub fn image(&self) -> ImageView<'a> {
        let first = MARGIN_PX * self.stride + MARGIN_PX;
        let pixels = self.pixels.get(first..).unwrap_or(&[]);
        ImageView::new(pixels, self.width, self.height, self.stride).unwrap_or_else(|_| ImageView::empty())
    }

    /// Bytes from pixel (x, y) on; the margin is at negative coordinates. `None` outside image and margin.
    pub fn from_pixel(&self, x: i32, y: i32) -> Option<&'a [u8]> {
        let column = usize::try_from(x + MARGIN_PX as i32).ok().filter(|&c| c < self.stride)?;
        let row = usize::try_from(y + MARGIN_PX as i32).ok().filter(|&r| r < self.height + 2 * MARGIN_PX)?;
        self.pixels.get(row * self.stride + column..)
    }
}

#[derive(Clone, Copy, Debug, Default)]
struct Level {
    offset: usize,
    width: usize,
    height: usize,
}

impl Level {
    fn stride(&self) -> usize {
        self.width + 2 * MARGIN_PX
    }

    fn bytes(&self) -> usize {
        self.stride() * (self.height + 2 * MARGIN_PX) + SLACK_BYTES
    }

    /// Index of the first pixel of row `y` in the pyramid's storage.
    fn start_of(&self, y: usize) -> usize {
        self.offset + (y + MARGIN_PX) * self.stride() + MARGIN_PX
    }
}

#[derive(Clone, Copy, Debug)]
struct Layout {
    levels: [Level; MAX_LEVELS],
    n_levels: usize,
    bytes: usize,
}

impl Layout {
    fn new(width: usize, height: usize, levels: usize) -> Self {
        let mut layout = Self { levels: [Level::default(); MAX_LEVELS], n_levels: 0, bytes: 0 };
        for (l, slot) in layout.levels.iter_mut().enumerate().take(levels) {
            let (width, height) = (width >> l, height >> l);
            if width == 0 || height == 0 {
                break;
            }
            *slot = Level { offset: layout.bytes, width, height };
            layout.bytes += slot.bytes();
            layout.n_levels = l + 1;
        }
        layout
    }

    fn level(&self, l: usize) -> Option<Level> {
        self.levels.get(l).copied().filter(|_| l < self.n_levels)
    }
}

/// Low-pass filters and halves; `fine_bytes` starts at the finer level, margins included and filled.
fn halve(fine_bytes: &[u8], fine: Level, coarse_bytes: &mut [u8], coarse: Level) {
    const READ: usize = 2 * COLUMNS_PER_PASS + 2;
    let stride = fine.stride();
    for y in 0..coarse.height {
        // Row 2y - 1 of the finer level, which for y = 0 is the margin.
        let above = (2 * y + MARGIN_PX - 1) * stride + MARGIN_PX - 1;
        let out_start = (y + MARGIN_PX) * coarse.stride() + MARGIN_PX;
        let out = &mut coarse_bytes[out_start..out_start + coarse.width];
        for (pass, out) in out.chunks_mut(COLUMNS_PER_PASS).enumerate() {
            let n_read = 2 * out.len() + 2;
            let column = above + pass * 2 * COLUMNS_PER_PASS;
            let row = |r: usize| &fine_bytes[column + r * stride..column + r * stride + n_read];
            let mut columns = [0u16; READ];
            let rows = row(0).iter().zip(row(1)).zip(row(2)).zip(row(3));
            for (sum, (((&a, &b), &c), &d)) in columns.iter_mut().zip(rows) {
                *sum = u16::from(a) + 3 * (u16::from(b) + u16::from(c)) + u16::from(d);
            }
            for (i, out) in out.iter_mut().enumerate() {
                let [a, b, c, d] = [columns[2 * i], columns[2 * i + 1], columns[2 * i + 2], columns[2 * i + 3]];
                *out = ((a + 3 * (b + c) + d + 32) >> 6) as u8;
            }
        }
    }
}

/// Repeats the border pixels over the margins of a level that starts at `bytes[0]`.
fn replicate_margins(bytes: &mut [u8], level: Level) {
    let stride = level.stride();
    for y in 0..level.height {
        let row = &mut bytes[(y + MARGIN_PX) * stride..(y + MARGIN_PX + 1) * stride];
        let (first, last) = (row[MARGIN_PX], row[MARGIN_PX + level.width - 1]);
        row[..MARGIN_PX].fill(first);
        row[MARGIN_PX + level.width..].fill(last);
    }
    let first = MARGIN_PX * stride;
    let last = (MARGIN_PX + level.height - 1) * stride;
    for margin in 0..MARGIN_PX {
        bytes.copy_within(first..first + stride, margin * stride);
        bytes.copy_within(last..last + stride, last + (margin + 1) * stride);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec;
    use std::vec::Vec;

    fn pyramid_of<'a>(
        pixels: &[u8],
        width: usize,
        height: usize,
        levels: usize,
        storage: &'a mut Vec<u8>,
    ) -> Pyramid<'a> {
        storage.resize(bytes_needed(width, height, levels), 0xAA);
        let mut pyramid = Pyramid::new(storage, width, height, levels).expect("asked for its size");
        pyramid.build(ImageView::new(pixels, width, height, width).expect("sized")).expect("same size");
        pyramid
    }

    #[test]
    fn a_ramp_stays_the_same_function_of_the_full_image_coordinate() {
        let (width, height) = (65, 40);
        let value = |x: f64, y: f64| 2.0 * x + 1.5 * y;
        let pixels: Vec<u8> = (0..width * height)
            .map(|i| value((i % width) as f64 + 0.5, (i / width) as f64 + 0.5).round() as u8)
            .collect();
        let mut storage = Vec::new();
        let pyramid = pyramid_of(&pixels, width, height, 4, &mut storage);
        for l in 1..4 {
            let level = pyramid.level(l).expect("four levels fit");
            let scale = f64::from(1u32 << l);
            assert_eq!((level.width(), level.height()), (width >> l, height >> l));
            // The outermost pixels of a level see the replicated margin.
            for y in 2..level.height() - 2 {
                for (x, &found) in level.image().row(y).iter().enumerate().take(level.width() - 2).skip(2) {
                    let expected = value((x as f64 + 0.5) * scale, (y as f64 + 0.5) * scale);
                    assert!((f64::from(found) - expected).abs() <= 1.0, "level {l} ({x}, {y}): {found} {expected}");
                }
            }
        }
    }

    #[test]
    fn an_impulse_spreads_by_the_even_binomial() {
        let mut pixels = [0u8; 64];
        pixels[3 * 8 + 4] = 64;
        let mut storage = Vec::new();
        let pyramid = pyramid_of(&pixels, 8, 8, 2, &mut storage);
        let level = pyramid.level(1).expect("two levels");
        let rows: Vec<&[u8]> = (0..4).map(|y| level.image().row(y)).collect();
        // Source (4, 3) is the outer tap of column 1 and an inner tap of column 2; likewise rows 1 and 2.
        assert_eq!(rows, [[0, 0, 0, 0], [0, 3, 9, 0], [0, 1, 3, 0], [0, 0, 0, 0]]);
    }

    #[test]
    fn the_margin_repeats_the_border() {
        let pixels: Vec<u8> = (0..12).collect();
        let mut storage = Vec::new();
        let pyramid = pyramid_of(&pixels, 4, 3, 1, &mut storage);
        let level = pyramid.level(0).expect("one level");
        let at = |x: i32, y: i32| level.from_pixel(x, y).map(|bytes| bytes[0]);
        assert_eq!([at(-16, -16), at(19, -1), at(-1, 18), at(19, 18)], [Some(0), Some(3), Some(8), Some(11)]);
        assert_eq!([at(2, 1), at(-17, 0), at(20, 0), at(0, 19)], [Some(6), None, None, None]);
        assert_eq!(level.image().row(2), [8, 9, 10, 11]);
    }

    #[test]
    fn sizes_that_do_not_fit_are_refused_with_their_numbers() {
        let needed = bytes_needed(10, 8, 3);
        let mut storage = vec![0; needed];
        assert_eq!(
            Pyramid::new(&mut storage[..needed - 1], 10, 8, 3).map(|_| ()),
            Err(PyramidStorageTooSmall { bytes: needed - 1, needed })
        );
        let mut pyramid = Pyramid::new(&mut storage, 10, 8, 3).expect("exactly enough");
        let other = [0; 81];
        let refused = pyramid.build(ImageView::new(&other, 9, 9, 9).expect("sized"));
        assert_eq!(refused, Err(WrongImageSize { found: [9, 9], expected: [10, 8] }));
    }

    #[test]
    fn tiny_images_have_as_many_levels_as_they_can_be_halved() {
        for (width, height, levels, expected) in [(1, 1, 4, 1), (2, 5, 4, 2), (0, 0, 4, 0), (64, 64, 9, MAX_LEVELS)] {
            let mut storage = vec![0; bytes_needed(width, height, levels)];
            let pixels = vec![7; width * height];
            let mut pyramid = Pyramid::new(&mut storage, width, height, levels).expect("enough");
            assert_eq!(pyramid.n_levels(), expected, "{width}x{height}");
            pyramid.build(ImageView::new(&pixels, width, height, width).expect("sized")).expect("same size");
            assert!((0..height).all(|y| pyramid.image().row(y).iter().all(|&p| p == 7)));
        }
    }
}
