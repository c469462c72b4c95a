//! Images as borrowed views. Pixels stay where the camera process put them.

pub mod gray;
pub mod pyramid;

pub use gray::to_gray;
pub use pyramid::Pyramid;

use core::fmt;

/// How the bytes of a frame are to be read. The numbers are those of the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum PixelFormat {
    /// One grey byte per pixel.
    Mono8 = 1,
    /// Red, green, blue bytes.
    Rgb8 = 2,
    /// Blue, green, red bytes.
    Bgr8 = 3,
    /// Luma plane, then interleaved half-resolution chroma.
    Nv12 = 4,
    /// Packed 4:2:2, Y0 U Y1 V.
    Yuyv = 5,
    /// Bayer mosaic, first row red-green.
    BayerRggb8 = 6,
}

impl PixelFormat {
    /// The format with this number on the wire, `None` when there is none.
    pub const fn from_wire(number: u32) -> Option<Self> {
        match number {
            1 => Some(Self::Mono8),
            2 => Some(Self::Rgb8),
            3 => Some(Self::Bgr8),
            4 => Some(Self::Nv12),
            5 => Some(Self::Yuyv),
            6 => Some(Self::BayerRggb8),
            _ => None,
        }
    }

    /// Bytes of one row of `width` pixels without padding.
    pub const fn row_bytes(self, width: u32) -> u64 {
        let width = width as u64;
        match self {
            Self::Mono8 | Self::Nv12 | Self::BayerRggb8 => width,
            Self::Rgb8 | Self::Bgr8 => 3 * width,
            Self::Yuyv => 2 * width,
        }
    }

    /// Rows of bytes that an image of `height` pixels has; NV12 carries half as many chroma rows below the luma.
    pub const fn n_rows(self, height: u32) -> u64 {
        match self {
            Self::Nv12 => height as u64 + height.div_ceil(2) as u64,
            _ => height as u64,
        }
    }

    /// Bytes of a packed image.
    pub const fn packed_bytes(self, width: u32, height: u32) -> u64 {
        self.row_bytes(width) * self.n_rows(height)
    }
}

/// Eight-bit grey image, rows `stride` bytes apart.
#[derive(Clone, Copy, Debug)]
pub struct ImageView<'a> {
    pixels: &'a [u8],
    width: usize,
    height: usize,
    stride: usize,
}

/// The pixels do not cover `height` rows of `stride` bytes, or a row is shorter than the image is wide.
///
/// The caller handed in a truncated buffer: drop the frame and count it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageTooShort {
    /// Bytes that were there.
    pub bytes: usize,
    /// Bytes that the size asks for.
    pub needed: usize,
}

impl fmt::Display for ImageTooShort {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "image has {} bytes, its size asks for {}", self.bytes, self.needed)
    }
}

impl core::error::Error for ImageTooShort {}

impl<'a> ImageView<'a> {
    /// Borrows `pixels` as an image of `width` x `height` whose rows start every `stride` bytes.
    ///
    /// # Errors
    /// [`ImageTooShort`] when the buffer cannot hold that size.
    pub fn new(pixels: &'a [u8], width: usize, height: usize, stride: usize) -> Result<Self, ImageTooShort> {
        let needed = match height {
            0 => 0,
            rows => stride.saturating_mul(rows - 1).saturating_add(width),
        };
        if stride < width || pixels.len() < needed {
            return Err(ImageTooShort { bytes: pixels.len(), needed: needed.max(width) });
        }
        Ok(Self { pixels, width, height, stride })
    }

    /// An image without pixels.
    pub fn empty() -> Self {
        Self { pixels: &[], width: 0, height: 0, stride: 0 }
    }

    /// Width, px.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height, px.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Bytes between the starts of two rows.
    pub fn stride(&self) -> usize {
        self.stride
    }

    /// Row `y`; empty below the image.
    pub fn row(&self, y: usize) -> &'a [u8] {
        let start = y * self.stride;
        self.pixels.get(start..start + self.width).unwrap_or(&[])
    }

    /// The bytes from a pixel on, rows [`stride`](Self::stride) apart; empty behind the image.
    #[inline(always)]
    pub(crate) fn bytes_from(&self, x: usize, y: usize) -> &'a [u8] {
        self.pixels.get(y * self.stride + x..).unwrap_or(&[])
    }
}

impl PartialEq for ImageView<'_> {
    fn eq(&self, other: &Self) -> bool {
        (self.width, self.height) == (other.width, other.height)
            && (0..self.height).all(|y| self.row(y) == other.row(y))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_format_is_found_by_its_wire_number_and_knows_its_size() {
        let check = |number: u32, packed_bytes_of_6x4: Option<u64>| {
            let format = PixelFormat::from_wire(number);
            assert_eq!(format.map(|f| f as u32), packed_bytes_of_6x4.map(|_| number));
            assert_eq!(format.map(|f| f.packed_bytes(6, 4)), packed_bytes_of_6x4, "format {number}");
        };
        check(0, None);
        check(1, Some(24));
        check(2, Some(72));
        check(3, Some(72));
        check(4, Some(36));
        check(5, Some(48));
        check(6, Some(24));
        check(7, None);
    }

    #[test]
    fn a_buffer_one_byte_short_is_refused() {
        assert!(ImageView::new(&[0; 11], 4, 3, 4).is_err());
        assert!(ImageView::new(&[0; 12], 4, 3, 4).is_ok());
        assert!(ImageView::new(&[0; 12], 4, 3, 3).is_err(), "stride below width");
        assert_eq!(ImageView::new(&[1, 2, 3, 4, 5, 6], 2, 2, 4).map(|v| v.row(1)), Ok([5, 6].as_slice()));
    }
}
