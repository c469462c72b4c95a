//! The points of keyframes on disk: only a candidate's are needed, and those of 60 km would take gigabytes.

use kilogs_core::features::{Descriptor, Feature};
use kilogs_core::loop_closure::PlacePoints;
use kilogs_core::places::{PlaceView, PointDepth};
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::Path;
use zerocopy::{FromBytes, FromZeros, Immutable, IntoBytes, KnownLayout};

/// A point as it is written.
#[derive(Clone, Copy, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
struct Record {
    descriptor: [u64; 4],
    pixel: [f32; 2],
    direction: [f32; 2],
    scale: f32,
    min_eigenvalue: f32,
    depth_m: f32,
    relative_sigma: f32,
}

/// Bytes of a point on disk, and of its copy on the way there.
pub const RECORD_BYTES: usize = size_of::<Record>();

/// What stands before the points of a slot.
#[derive(Clone, Copy, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
struct SlotHeader {
    n_points: u32,
    points_crc: u32,
}

/// [`PlacePoints`] in a file without a name, which is gone with the process.
#[derive(Debug)]
pub struct PointsFile {
    file: File,
    records: Box<[u8]>,
    features: Box<[Feature]>,
    depths: Box<[PointDepth]>,
    is_failure_told: bool,
}

impl PointsFile {
    /// A file in `folder` with `points_per_place` points a slot.
    ///
    /// # Errors
    /// When the folder cannot be written.
    pub fn create(folder: &Path, points_per_place: usize) -> std::io::Result<Self> {
        let path = folder.join(".places.points");
        let file = File::options().read(true).write(true).create(true).truncate(true).open(&path)?;
        std::fs::remove_file(&path)?;
        Ok(Self {
            file,
            records: vec![0; points_per_place * RECORD_BYTES].into(),
            features: vec![Feature::NONE; points_per_place].into(),
            depths: vec![PointDepth::default(); points_per_place].into(),
            is_failure_told: false,
        })
    }

    fn offset(&self, slot: usize) -> u64 {
        (slot * (size_of::<SlotHeader>() + self.records.len())) as u64
    }

    fn write(&mut self, slot: usize, n_points: usize) -> std::io::Result<()> {
        let offset = self.offset(slot);
        let records = &self.records[..n_points * RECORD_BYTES];
        let header = SlotHeader { n_points: n_points as u32, points_crc: crc32fast::hash(records) };
        self.file.write_all_at(records, offset + size_of::<SlotHeader>() as u64)?;
        self.file.write_all_at(header.as_bytes(), offset)
    }

    fn read(&mut self, slot: usize) -> std::io::Result<usize> {
        let offset = self.offset(slot);
        let mut header = SlotHeader::new_zeroed();
        self.file.read_exact_at(header.as_mut_bytes(), offset)?;
        let n_points = (header.n_points as usize).min(self.features.len());
        let records = &mut self.records[..n_points * RECORD_BYTES];
        self.file.read_exact_at(records, offset + size_of::<SlotHeader>() as u64)?;
        if crc32fast::hash(records) != header.points_crc {
            return Err(std::io::Error::new(std::io::ErrorKind::InvalidData, "its checksum is wrong"));
        }
        Ok(n_points)
    }

    /// A place that cannot be compared is not recognized: a loss for the map, not for the run.
    fn tell(&mut self, action: &str, error: &std::io::Error) {
        if !self.is_failure_told {
            self.is_failure_told = true;
            log::warn!("{action} the points of keyframes: {error}; places may not be recognized from now on");
        }
    }
}

impl PlacePoints for PointsFile {
    fn keep(&mut self, slot: usize, view: &PlaceView<'_>) {
        let records = self.records.chunks_exact_mut(RECORD_BYTES);
        let mut n_points = 0;
        for ((bytes, feature), depth) in records.zip(view.features).zip(view.depths) {
            let record = Record {
                descriptor: feature.descriptor.0,
                pixel: feature.pixel,
                direction: feature.direction,
                scale: feature.scale,
                min_eigenvalue: feature.min_eigenvalue,
                depth_m: depth.depth_m,
                relative_sigma: depth.relative_sigma,
            };
            bytes.copy_from_slice(record.as_bytes());
            n_points += 1;
        }
        if let Err(error) = self.write(slot, n_points) {
            self.tell("writing", &error);
        }
    }

    fn find(&mut self, slot: usize) -> Option<PlaceView<'_>> {
        let n_points = match self.read(slot) {
            Ok(n_points) => n_points,
            Err(error) => {
                self.tell("reading back", &error);
                return None;
            }
        };
        let kept = self.features.iter_mut().zip(&mut self.depths).take(n_points);
        for (bytes, (feature, depth)) in self.records.chunks_exact(RECORD_BYTES).zip(kept) {
            let record = Record::read_from_bytes(bytes).ok()?;
            let Record { descriptor, pixel, direction, scale, min_eigenvalue, depth_m, relative_sigma } = record;
            *feature = Feature { pixel, scale, direction, min_eigenvalue, descriptor: Descriptor(descriptor) };
            *depth = PointDepth { depth_m, relative_sigma };
        }
        Some(PlaceView { features: &self.features[..n_points], depths: &self.depths[..n_points] })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(n: usize, look: u64) -> (Vec<Feature>, Vec<PointDepth>) {
        let feature = |i: usize| Feature {
            pixel: [i as f32, 0.5],
            scale: 2.0,
            direction: [0.6, 0.8],
            min_eigenvalue: 3.0,
            descriptor: Descriptor([look, i as u64, 7, u64::MAX]),
        };
        let depth = |i: usize| PointDepth { depth_m: i as f32 * 0.1, relative_sigma: 0.02 };
        ((0..n).map(feature).collect(), (0..n).map(depth).collect())
    }

    #[test]
    fn points_come_back_as_they_were_kept_and_nothing_is_left_in_the_folder() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut file = PointsFile::create(folder.path(), 8).expect("created");
        assert_eq!(std::fs::read_dir(folder.path()).expect("listed").count(), 0);
        for (slot, n, look) in [(0, 8, 1), (3, 2, 2), (1, 20, 3), (0, 5, 4), (2, 0, 5)] {
            let (features, depths) = view(n, look);
            file.keep(slot, &PlaceView { features: &features, depths: &depths });
        }
        let mut check = |slot: usize, n: usize, look: u64| {
            let (features, depths) = view(n, look);
            let found = file.find(slot).expect("kept");
            assert_eq!((found.features, found.depths), (&features[..], &depths[..]), "slot {slot}");
        };
        check(3, 2, 2);
        check(0, 5, 4);
        check(1, 8, 3);
        check(2, 0, 5);
        assert!(file.find(9).is_none(), "never kept");
        file.file.write_all_at(&[0xAA], file.offset(3) + 20).expect("changed");
        assert!(file.find(3).is_none(), "damaged");
    }
}
