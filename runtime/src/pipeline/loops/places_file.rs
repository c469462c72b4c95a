//! The places of a drive on disk: of their points only a candidate's are needed, and those of 60 km would take gigabytes.
//!
//! Beside a map the file stays there, so that another drive finds itself in it.

use crate::map_store::places_path;
use kilogs_core::features::{Descriptor, Feature};
use kilogs_core::loop_closure::PlacePoints;
use kilogs_core::places::{PlaceView, PointDepth, Signature, WORDS_PER_PLACE, WeightedWord};
use std::fs::File;
use std::io::Result;
use std::os::unix::fs::FileExt;
use std::path::Path;
use zerocopy::{FromBytes, FromZeros, Immutable, IntoBytes, KnownLayout};

/// A point as it is written, in fixed-point numbers that are finer than what is known of it.
#[derive(Clone, Copy, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
struct Record {
    descriptor: [u64; 4],
    depth_m: f32,
    /// Steps of 1/8 px.
    pixel: [u16; 2],
    /// Cosine and sine, in steps of 1/32767.
    direction: [i16; 2],
    /// Steps of 1/256.
    scale: u16,
    /// Steps of 1/65535.
    relative_sigma: u16,
}

impl Record {
    fn new(feature: &Feature, depth: &PointDepth) -> Self {
        // A number beyond the range becomes the last one in it.
        let fixed = |number: f32, steps: f32| (number * steps).round() as u16;
        Self {
            descriptor: feature.descriptor.0,
            depth_m: depth.depth_m,
            pixel: feature.pixel.map(|c| fixed(c, 8.0)),
            direction: feature.direction.map(|c| (c * 32767.0).round() as i16),
            scale: fixed(feature.scale, 256.0),
            relative_sigma: fixed(depth.relative_sigma, 65535.0),
        }
    }

    fn point(&self) -> (Feature, PointDepth) {
        let feature = Feature {
            pixel: self.pixel.map(|c| f32::from(c) / 8.0),
            scale: f32::from(self.scale) / 256.0,
            direction: self.direction.map(|c| f32::from(c) / 32767.0),
            // How strong a corner was decided about its word, and is not asked again.
            min_eigenvalue: 0.0,
            descriptor: Descriptor(self.descriptor),
        };
        let relative_sigma = f32::from(self.relative_sigma) / 65535.0;
        (feature, PointDepth { depth_m: self.depth_m, relative_sigma })
    }
}

/// First bytes of the file.
const MAGIC: [u8; 4] = *b"KGSw";
/// Version of the file.
const VERSION: u32 = 2;

/// Bytes of a point on disk, and of its copy on the way there.
pub const RECORD_BYTES: usize = size_of::<Record>();

/// First bytes of the file: whoever reads it has to mean the same by a word and by a slot.
#[derive(Clone, Copy, PartialEq, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
struct Header {
    magic: [u8; 4],
    version: u32,
    points_per_place: u32,
    vocabulary_crc: u32,
}

/// What stands before the points of a slot.
#[derive(Clone, Copy, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
struct SlotHeader {
    keyframe_id: u32,
    n_words: u32,
    n_points: u32,
    points_crc: u32,
    words: [WeightedWord; WORDS_PER_PLACE],
    /// Of everything above.
    header_crc: u32,
}

impl SlotHeader {
    fn crc(&self) -> u32 {
        let bytes = self.as_bytes();
        crc32fast::hash(&bytes[..bytes.len() - size_of::<u32>()])
    }

    fn words(&self) -> Option<Signature> {
        self.words.get(..self.n_words as usize).and_then(Signature::from_words)
    }
}

/// A keyframe that a file knows.
#[derive(Debug, Clone)]
pub struct KnownPlace {
    pub slot: usize,
    pub keyframe_id: u32,
    pub words: Signature,
}

/// [`PlacePoints`] in a file.
#[derive(Debug)]
pub struct PlacesFile {
    file: File,
    records: Box<[u8]>,
    features: Box<[Feature]>,
    depths: Box<[PointDepth]>,
    is_failure_told: bool,
}

impl PlacesFile {
    /// A file without a name in `folder`, which is gone with the process.
    ///
    /// # Errors
    /// When the folder cannot be written.
    pub fn nameless(folder: &Path, points_per_place: usize, vocabulary_crc: u32) -> Result<Self> {
        let path = folder.join(".places.points");
        let file = Self::open(&path, points_per_place, vocabulary_crc)?;
        std::fs::remove_file(&path)?;
        Ok(file)
    }

    /// The file of the map in `folder`; what is there already stays, if it means the same.
    ///
    /// # Errors
    /// When the folder cannot be written.
    pub fn of_map(folder: &Path, points_per_place: usize, vocabulary_crc: u32) -> Result<Self> {
        Self::open(&places_path(folder), points_per_place, vocabulary_crc)
    }

    fn open(path: &Path, points_per_place: usize, vocabulary_crc: u32) -> Result<Self> {
        let file = File::options().read(true).write(true).create(true).truncate(false).open(path)?;
        let header =
            Header { magic: MAGIC, version: VERSION, points_per_place: points_per_place as u32, vocabulary_crc };
        let mut found = Header::new_zeroed();
        if file.read_exact_at(found.as_mut_bytes(), 0).is_err() || found != header {
            file.set_len(0)?;
            file.write_all_at(header.as_bytes(), 0)?;
        }
        Ok(Self {
            file,
            records: vec![0; points_per_place * RECORD_BYTES].into(),
            features: vec![Feature::NONE; points_per_place].into(),
            depths: vec![PointDepth::default(); points_per_place].into(),
            is_failure_told: false,
        })
    }

    /// The keyframes that it knows, by id; at most `n_slots` slots are looked at.
    pub fn known(&self, n_slots: usize) -> Vec<KnownPlace> {
        let known = |slot: usize| {
            let header = self.header(slot).ok()?;
            let (keyframe_id, words) = (header.keyframe_id, header.words()?);
            Some(KnownPlace { slot, keyframe_id, words })
        };
        let n_bytes = self.file.metadata().map_or(0, |data| data.len());
        let is_there = |slot: &usize| self.offset(*slot) < n_bytes;
        let mut places: Vec<KnownPlace> = (0..n_slots).take_while(is_there).filter_map(known).collect();
        places.sort_by_key(|place| place.keyframe_id);
        places.dedup_by_key(|place| place.keyframe_id);
        places
    }

    fn offset(&self, slot: usize) -> u64 {
        (size_of::<Header>() + slot * (size_of::<SlotHeader>() + self.records.len())) as u64
    }

    fn header(&self, slot: usize) -> Result<SlotHeader> {
        let mut header = SlotHeader::new_zeroed();
        self.file.read_exact_at(header.as_mut_bytes(), self.offset(slot))?;
        if header.crc() != header.header_crc {
            return Err(std::io::Error::new(std::io::ErrorKind::InvalidData, "its checksum is wrong"));
        }
        Ok(header)
    }

    fn write(&mut self, slot: usize, keyframe_id: u32, words: &Signature, n_points: usize) -> Result<()> {
        let offset = self.offset(slot);
        let records = &self.records[..n_points * RECORD_BYTES];
        let mut header = SlotHeader::new_zeroed();
        header.keyframe_id = keyframe_id;
        header.n_words = words.words().len() as u32;
        header.n_points = n_points as u32;
        header.points_crc = crc32fast::hash(records);
        header.words.iter_mut().zip(words.words()).for_each(|(stored, word)| *stored = *word);
        header.header_crc = header.crc();
        self.file.write_all_at(records, offset + size_of::<SlotHeader>() as u64)?;
        self.file.write_all_at(header.as_bytes(), offset)
    }

    fn read(&mut self, slot: usize) -> Result<usize> {
        let offset = self.offset(slot);
        let header = self.header(slot)?;
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

impl PlacePoints for PlacesFile {
    fn keep(&mut self, slot: usize, keyframe_id: u32, words: &Signature, view: &PlaceView<'_>) {
        let records = self.records.chunks_exact_mut(RECORD_BYTES);
        let mut n_points = 0;
        for ((bytes, feature), depth) in records.zip(view.features).zip(view.depths) {
            bytes.copy_from_slice(Record::new(feature, depth).as_bytes());
            n_points += 1;
        }
        if let Err(error) = self.write(slot, keyframe_id, words, n_points) {
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
            (*feature, *depth) = record.point();
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
            direction: [0.0, -1.0],
            min_eigenvalue: 0.0,
            descriptor: Descriptor([look, i as u64, 7, u64::MAX]),
        };
        let depth = |i: usize| PointDepth { depth_m: i as f32 * 0.1, relative_sigma: 0.2 };
        ((0..n).map(feature).collect(), (0..n).map(depth).collect())
    }

    #[test]
    fn what_is_written_of_a_point_is_as_good_as_what_is_known_of_it() {
        let feature = Feature {
            pixel: [1240.97, 3.03],
            scale: 4.0,
            direction: [0.6, -0.8],
            min_eigenvalue: 0.0,
            descriptor: Descriptor([1, 2, 3, 4]),
        };
        let depth = PointDepth { depth_m: 12.345, relative_sigma: 0.0123 };
        let (found, found_depth) = Record::new(&feature, &depth).point();
        let check = |what: &str, a: f32, b: f32, most: f32| assert!((a - b).abs() <= most, "{what}: {a} for {b}");
        for axis in 0..2 {
            check("pixel", found.pixel[axis], feature.pixel[axis], 0.0626);
            check("direction", found.direction[axis], feature.direction[axis], 2e-5);
        }
        check("sigma", found_depth.relative_sigma, depth.relative_sigma, 1e-5);
        assert_eq!((found.scale, found.descriptor, found_depth.depth_m), (4.0, feature.descriptor, 12.345));
        let beyond = Feature { pixel: [1e9, -5.0], ..feature };
        assert_eq!(Record::new(&beyond, &depth).point().0.pixel, [8191.875, 0.0]);
    }

    #[test]
    fn points_come_back_as_they_were_kept_and_nothing_is_left_in_the_folder() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut file = PlacesFile::nameless(folder.path(), 8, 1).expect("created");
        assert_eq!(std::fs::read_dir(folder.path()).expect("listed").count(), 0);
        let words = Signature::default();
        for (slot, n, look) in [(0, 8, 1), (3, 2, 2), (1, 20, 3), (0, 5, 4), (2, 0, 5)] {
            let (features, depths) = view(n, look);
            file.keep(slot, 7, &words, &PlaceView { features: &features, depths: &depths });
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
        file.file.write_all_at(&[0xAA], file.offset(3) + size_of::<SlotHeader>() as u64 + 20).expect("changed");
        assert!(file.find(3).is_none(), "damaged");
    }

    #[test]
    fn a_map_knows_its_places_by_their_words_while_words_mean_the_same() {
        let folder = tempfile::tempdir().expect("a folder");
        let words = |word: u16| Signature::from_words(&[WeightedWord { word, weight: 9 }]).expect("one word");
        let keep = |file: &mut PlacesFile, slot: usize, keyframe_id: u32| {
            let (features, depths) = view(3, keyframe_id.into());
            let view = PlaceView { features: &features, depths: &depths };
            file.keep(slot, keyframe_id, &words(keyframe_id as u16), &view);
        };
        let mut file = PlacesFile::of_map(folder.path(), 8, 1).expect("created");
        // A slot is taken over by a later keyframe, one is damaged.
        for (slot, keyframe_id) in [(0, 4), (1, 5), (2, 6), (3, 7), (1, 9)] {
            keep(&mut file, slot, keyframe_id);
        }
        file.file.write_all_at(&[0xAA], file.offset(2) + 20).expect("changed");
        let known = |vocabulary_crc: u32| {
            let file = PlacesFile::of_map(folder.path(), 8, vocabulary_crc).expect("opened");
            let places = file.known(100).into_iter();
            places.map(|place| (place.slot, place.keyframe_id, place.words.words()[0].word)).collect::<Vec<_>>()
        };
        assert_eq!(known(1), [(0, 4, 4), (3, 7, 7), (1, 9, 9)]);
        assert_eq!(known(2), [], "another vocabulary");
    }
}
