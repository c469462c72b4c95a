//! Images by name, wherever they lie, all of one size.

use std::path::{Path, PathBuf};

use kilogs_core::frame::PixelFormat;

use super::image_file::{ImageKind, ImageReader};
use super::{Distortion, SourceError};

/// Reads any of a list of image files, all of one size.
pub struct ImageList {
    paths: Vec<PathBuf>,
    kind: ImageKind,
    reader: ImageReader,
}

impl ImageList {
    /// Looks at the headers of all images. The first one decides about color.
    ///
    /// # Errors
    /// [`SourceError::File`] names an image that is missing, unreadable or of another size than the first.
    pub fn open(paths: Vec<PathBuf>) -> Result<Self, SourceError> {
        let mut reader = ImageReader::default();
        let mut first: Option<(&Path, ImageKind)> = None;
        for path in &paths {
            let kind = reader.probe(path).map_err(|reason| SourceError::file(path, reason))?;
            let (first_path, first_kind) = *first.get_or_insert((path, kind));
            if kind.size != first_kind.size {
                let ([width, height], [first_width, first_height]) = (kind.size, first_kind.size);
                let first_path = first_path.display();
                return Err(SourceError::file(
                    path,
                    format!(
                        "the image has {width}x{height} px, {first_path} has {first_width}x{first_height} px; all \
                         images must be of one camera, resize or leave out the others"
                    ),
                ));
            }
        }
        let kind = first.map(|(_, kind)| kind);
        let kind = kind.ok_or_else(|| SourceError::Range("the list of images is empty".to_owned()))?;
        Ok(Self { paths, kind, reader })
    }

    /// Delivers images as an ideal camera would have taken them.
    #[must_use]
    pub fn rectified(mut self, distortion: Option<Distortion>) -> Self {
        self.reader.rectify(distortion);
        self
    }

    /// Width and height of every image, px.
    pub fn size(&self) -> [u32; 2] {
        self.kind.size
    }

    /// What the pixels are delivered as.
    pub fn pixel_format(&self) -> PixelFormat {
        self.kind.pixel_format
    }

    /// The files, in order.
    pub fn paths(&self) -> &[PathBuf] {
        &self.paths
    }

    /// Bytes of one image.
    pub fn bytes(&self) -> usize {
        let [width, height] = self.kind.size;
        self.kind.pixel_format.packed_bytes(width, height) as usize
    }

    /// Writes the pixels of image `index` into `pixels` (exactly [`bytes`](Self::bytes) long).
    ///
    /// # Errors
    /// [`SourceError::File`] names the file and what is wrong with it.
    pub fn read(&mut self, index: usize, pixels: &mut [u8]) -> Result<(), SourceError> {
        let Some(path) = self.paths.get(index) else {
            return Err(SourceError::Range(format!("there is no image {index} of {}", self.paths.len())));
        };
        self.reader.decode(path, self.kind, pixels).map_err(|reason| SourceError::file(path, reason))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{GrayImage, Luma};

    fn write(folder: &Path, name: &str, size: [u32; 2], value: u8) -> PathBuf {
        let path = folder.join(name);
        GrayImage::from_pixel(size[0], size[1], Luma([value])).save(&path).expect("an image");
        path
    }

    #[test]
    fn images_of_one_size_are_read_in_any_order() {
        let folder = tempfile::tempdir().expect("a folder");
        let paths = ["b.png", "a.png"].map(|name| write(folder.path(), name, [4, 3], name.as_bytes()[0]));
        let mut list = ImageList::open(paths.to_vec()).expect("two images");
        assert_eq!((list.size(), list.pixel_format(), list.bytes()), ([4, 3], PixelFormat::Mono8, 12));
        let mut pixels = vec![0; list.bytes()];
        for (index, expected) in [(1, b'a'), (0, b'b')] {
            list.read(index, &mut pixels).expect("an image");
            assert_eq!(pixels, [expected; 12]);
        }
        assert!(list.read(2, &mut pixels).is_err());
    }

    #[test]
    fn what_does_not_fit_is_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let good = write(folder.path(), "good.png", [4, 3], 1);
        let check = |paths: Vec<PathBuf>, expected: &str| {
            let error = ImageList::open(paths).err().map(|e| e.to_string()).unwrap_or_default();
            assert!(error.contains(expected), "{error}");
        };
        let wide = write(folder.path(), "wide.png", [5, 3], 1);
        check(vec![good.clone(), wide], "wide.png: the image has 5x3 px");
        check(vec![good, folder.path().join("gone.png")], "gone.png");
        check(vec![], "the list of images is empty");
    }
}
