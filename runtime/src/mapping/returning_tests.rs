//! How pages come back when a street is driven again: whole, in time, and without making the map grow.

use super::*;
use crate::map_store::{Alignment, StoredFile};
use crate::map_store::{MapStoreReader, StoreImage};
use crate::splat::{LearningRates, StepSettings};
use kilogs_core::store::{StoredKeyframe, decode_chunk};
use std::collections::BTreeMap;
use std::path::Path;

/// Keyframes of one way along the street.
const ONE_WAY: u32 = 40;
/// Rows for all drives along the street.
const ROOMY: MapperCapacity = MapperCapacity { keyframe_rows: 256, chunk_rows: 6, ..CAPACITY };

/// A mapper that drives through a store in lock-step.
struct Drive {
    mapper: Mapper,
    store: MapStoreWriter,
    brings: bool,
}

impl Drive {
    fn new(folder: &Path, capacity: MapperCapacity, learned_decoder: bool) -> Self {
        let capacity_of_store =
            StoreCapacity { page_bytes: 200_000, page_buffers: 2, image_buffers: 1, read_buffers: 3 };
        let settings = StoreSettings { capacity: capacity_of_store, jpeg_quality: 90, when_busy: WhenBusy::Wait };
        let store = MapStoreWriter::create(&folder.join("map"), &MANIFEST, &settings).expect("a new store");
        Self { mapper: mapper_of(1, capacity, self::settings(learned_decoder)), store, brings: true }
    }

    /// Keyframe `ordinal`, `place` steps down the street.
    fn keyframe(&mut self, ordinal: u32, place: u32) {
        let pixels = picture(STEP_M * f64::from(place));
        let world_from_camera = Rigid::translation(0.0, 0.0, STEP_M * f64::from(place));
        let packet = KeyframePacket { world_from_camera, ..packet(ordinal, &pixels) };
        let view = StoredKeyframe {
            keyframe_id: ordinal,
            chunk_id: ordinal / CHUNK_KEYFRAMES,
            frame_index: packet.frame_index,
            timestamp_ns: 0,
            rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
            translation_m: world_from_camera.translation.vector.into(),
            scale: 1.0,
            is_held_out: false,
            image_bytes: 0,
            image_crc: 0,
        };
        let image = StoreImage { pixels: &pixels, stride_bytes: CAMERA.width as usize };
        self.store.write_keyframe(&view, image).expect("room in the queue");
        let sealed = (ordinal > 3).then(seal::enter);
        if self.brings {
            self.mapper.bring_pages(&packet, &mut &self.store);
        }
        self.mapper.insert_keyframe(&packet, &mut &self.store).expect("a usable keyframe");
        self.mapper.optimize(2);
        assert_eq!(sealed.map_or((0, 0), |sealed| sealed.violations()), (0, 0), "keyframe {ordinal} took memory");
    }

    fn drive_ways(&mut self, n_ways: u32) {
        for ordinal in 0..n_ways * ONE_WAY {
            let (way, step) = (ordinal / ONE_WAY, ordinal % ONE_WAY);
            self.keyframe(ordinal, if way % 2 == 0 { step } else { ONE_WAY - 1 - step });
        }
    }

    /// Finishes the map; what the mapper counted.
    fn finish(mut self) -> MapCounters {
        self.mapper.finish_into(&self.store).expect("pages that fit");
        self.store.finish().expect("a store that was written");
        self.mapper.counters()
    }
}

/// Every file of a map.
fn files(folder: &Path) -> BTreeMap<std::path::PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for entry in std::fs::read_dir(folder).expect("a folder").flatten() {
        if entry.path().is_dir() {
            found.extend(files(&entry.path()));
        } else {
            let name = entry.path().strip_prefix(folder).expect("inside").to_owned();
            found.insert(
                folder.file_name().map(Path::new).unwrap_or(folder).join(name),
                std::fs::read(entry.path()).expect("read"),
            );
        }
    }
    found
}

fn scratch() -> tempfile::TempDir {
    tempfile::tempdir().expect("a scratch folder")
}

#[test]
fn a_street_that_is_driven_again_hardly_grows_and_the_same_drive_gives_the_same_bytes() {
    let drive = |n_ways: u32, brings: bool, learned_decoder: bool| {
        let folder = scratch();
        let mut drive = Drive::new(folder.path(), ROOMY, learned_decoder);
        drive.brings = brings;
        drive.drive_ways(n_ways);
        let counters = drive.finish();
        let map = MapStoreReader::open(&folder.path().join("map"), 1000).expect("a map");
        let n_stored: u64 = map.pages().iter().map(|page| u64::from(page.n_anchors)).sum();
        let expected = counters.anchors_total - counters.anchors_pruned - counters.anchors_merged;
        assert_eq!((n_stored, map.damages().len()), (expected, 0), "{counters:?}");
        (counters, n_stored, files(&folder.path().join("map")))
    };
    for learned_decoder in [false, true] {
        let (_, once, _) = drive(1, true, learned_decoder);
        let (counters, four_times, bytes) = drive(4, true, learned_decoder);
        let (_, forgetful, _) = drive(4, false, learned_decoder);
        println!("one way {once}, four ways {four_times}, without returning {forgetful} anchors: {counters:?}");
        assert!(counters.pages_returned > 10 && counters.pages_lost == 0, "{counters:?}");
        // The map of a way back lacks what only pages beyond 30 m show, and gets it anew at coarser levels.
        assert!(four_times < once * 5 / 2, "{once} anchors became {four_times}");
        assert!(four_times - once < (forgetful - once) / 2, "{forgetful} without returning, {four_times} with");
        assert!(bytes == drive(4, true, learned_decoder).2, "same input, same bytes");
    }
}

#[test]
fn a_later_drive_ends_nothing_of_an_earlier_one() {
    let n_of_first_drive = |n_drives: u32| {
        let folder = scratch();
        let mut drive = Drive::new(folder.path(), ROOMY, false);
        for (nth, step) in (0..n_drives).flat_map(|nth| (0..ONE_WAY).map(move |step| (nth, step))) {
            // The later drive has mapped some of the street anew when the pages of the earlier one come.
            drive.brings = nth == 0 || step >= ONE_WAY / 2;
            drive.keyframe(nth * CHUNK_KEYFRAMES + step, if nth % 2 == 0 { step } else { ONE_WAY - 1 - step });
        }
        drive.finish();
        let map = MapStoreReader::open(&folder.path().join("map"), 1000).expect("a map");
        let of_first_drive = map.pages().iter().filter(|page| page.first_keyframe_id < CHUNK_KEYFRAMES);
        of_first_drive.map(|page| page.n_anchors).sum::<u32>()
    };
    let (alone, again) = (n_of_first_drive(1), n_of_first_drive(2));
    // Pages of one drive that were never in memory together share a few voxels.
    assert!(again >= alone - alone / 20, "{alone} anchors became {again}");
}

#[test]
fn pages_that_leave_unchanged_are_not_written_again() {
    let folder = scratch();
    let mut drive = Drive::new(folder.path(), ROOMY, true);
    drive.drive_ways(1);
    // From now on nothing learns and nothing is inserted.
    drive.mapper.settings.step = StepSettings { rates: LearningRates::FROZEN, ..drive.mapper.settings.step };
    drive.mapper.settings.min_confidence = f32::INFINITY;
    let mut before = drive.mapper.counters();
    for ordinal in ONE_WAY..6 * ONE_WAY {
        if ordinal == 4 * ONE_WAY {
            // By now every page has met its neighbours, and whoever shared a voxel with one was written once more.
            before = drive.mapper.counters();
        }
        let (way, step) = (ordinal / ONE_WAY, ordinal % ONE_WAY);
        drive.keyframe(ordinal, if way % 2 == 0 { step } else { ONE_WAY - 1 - step });
    }
    let after = drive.finish();
    assert!(after.pages_returned >= before.pages_returned + 4, "{after:?}");
    let unwritten = |counters: &MapCounters| (counters.pages_written, counters.anchors_merged, counters.anchors_total);
    assert_eq!(unwritten(&after), unwritten(&before));
}

#[test]
fn a_damaged_page_stays_away_and_the_others_come() {
    let truncate = |path: &Path| {
        let bytes = std::fs::read(path).expect("a page");
        std::fs::write(path, &bytes[..bytes.len() / 2])
    };
    let flip = |path: &Path| {
        let mut bytes = std::fs::read(path).expect("a page");
        let middle = bytes.len() / 2;
        bytes[middle] ^= 0x10;
        std::fs::write(path, bytes)
    };
    let lose = |path: &Path| std::fs::remove_file(path);
    let check = |name: &str, spoil: &dyn Fn(&Path) -> std::io::Result<()>| {
        let folder = scratch();
        let mut drive = Drive::new(folder.path(), CAPACITY, false);
        drive.drive_ways(1);
        drive.store.flush().expect("written");
        spoil(&folder.path().join("map/pages/00000064.kgs")).expect("the page of keyframes 10 to 19");
        for ordinal in ONE_WAY..2 * ONE_WAY {
            drive.keyframe(ordinal, 2 * ONE_WAY - 1 - ordinal);
        }
        assert!(drive.mapper.pool.iter().all(|(_, record)| !(10..20).contains(&record.keyframe_ordinal)), "{name}");
        let counters = drive.finish();
        assert_eq!(counters.pages_lost, 1, "{name}: {counters:?}");
        assert!(counters.pages_returned >= 2, "{name}: {counters:?}");
        let map = MapStoreReader::open(&folder.path().join("map"), 1000).expect("a map");
        let unreadable =
            map.pages().iter().filter(|page| map.read_page(page.page_id, &mut Vec::new()).is_err()).count();
        let is_listed = map.pages().iter().any(|page| page.page_id == 64);
        assert_eq!((unreadable, is_listed), (usize::from(name == "flipped"), name == "flipped"), "{name}");
    };
    check("truncated", &truncate);
    check("flipped", &flip);
    check("gone", &lose);
}

#[test]
fn a_junction_of_more_chunks_than_rows_evicts_the_least_visible_and_never_mixes_decoders() {
    let folder = scratch();
    let mut drive = Drive::new(folder.path(), MapperCapacity { chunk_rows: 3, ..CAPACITY }, true);
    // Six chunks, each 12 keyframes along the same 48 m of street, to and fro.
    for ordinal in 0..6 * 12 {
        let (chunk, step) = (ordinal / 12, ordinal % 12);
        drive.keyframe(chunk * CHUNK_KEYFRAMES + step, if chunk % 2 == 0 { step } else { 11 - step });
        let tables = drive.mapper.table_load();
        assert!(tables.chunks <= 3, "{tables:?}");
        let (mut in_memory, mut on_disk) =
            (vec![0.0; DecoderShape::new(2).len()], vec![1.0; DecoderShape::new(2).len()]);
        drive.store.flush().expect("written");
        for of_chunk in drive.mapper.paging.directory.resident().map(|group| group.chunk()) {
            let row = drive.mapper.row_of_chunk(of_chunk).expect("a row for whoever is in memory");
            let is_loading = drive.mapper.paging.coming.iter().any(|(file, _)| *file == StoredFile::Chunk(of_chunk));
            let path = folder.path().join(format!("map/chunks/{of_chunk:08}.kgs"));
            let Some(bytes) = std::fs::read(path).ok().filter(|_| !is_loading) else { continue };
            assert!(drive.mapper.backend.read_decoder(row, &mut in_memory));
            assert!(decode_chunk(&bytes).expect("whole").decoder.read_residual(&mut on_disk));
            assert!(in_memory == on_disk, "chunk {of_chunk} at keyframe {ordinal}");
        }
    }
    assert!(drive.finish().pages_written > 5);
}

#[test]
fn a_drive_goes_on_in_a_map_whose_writing_was_killed() {
    let folder = scratch();
    let path = folder.path().join("map");
    let mut first = Drive::new(folder.path(), ROOMY, true);
    first.drive_ways(1);
    first.mapper.finish_into(&first.store).expect("pages that fit");
    first.store.flush().expect("written");
    // Without its end the store says nothing of what it holds, and the last record of its log is torn.
    drop(first);
    let mut log = std::fs::read(path.join("keyframes.kgs")).expect("a log");
    log.extend([7; 50]);
    std::fs::write(path.join("keyframes.kgs"), log).expect("written");
    std::fs::write(path.join("pages/00000000.tmp"), b"half a page").expect("written");

    let map = MapStoreReader::open(&path, 1000).expect("a map");
    assert_eq!((map.manifest().counts, map.keyframes().len()), (None, ONE_WAY as usize));
    let last_decoder = map.read_chunk(0, &mut Vec::new()).expect("a chunk").decoder.bytes.to_vec();
    let n_before: u64 = map.pages().iter().map(|page| u64::from(page.n_anchors)).sum();
    let next = first_keyframe_id_after(&map);
    assert_eq!(next, CHUNK_KEYFRAMES);
    let capacity = StoreCapacity { page_bytes: 200_000, page_buffers: 2, image_buffers: 1, read_buffers: 3 };
    let settings = StoreSettings { capacity, jpeg_quality: 90, when_busy: WhenBusy::Wait };
    for other in [
        Manifest { camera: Pinhole { fx: 61.0, ..CAMERA }, ..MANIFEST },
        Manifest { gaussians_per_anchor: 3, ..MANIFEST },
    ] {
        let refused = MapStoreWriter::resume(&map, &other, &settings).map(|_| ()).expect_err("another map");
        assert!(refused.to_string().contains("is not that of this run"), "{refused}");
    }
    let store = MapStoreWriter::resume(&map, &MANIFEST, &settings).expect("a map to go on with");
    let mut second = Drive { mapper: mapper_of(1, ROOMY, self::settings(true)), store, brings: true };
    second.mapper.resume(&map, &Alignment::default());
    for ordinal in 0..ONE_WAY {
        second.keyframe(next + ordinal, ONE_WAY - 1 - ordinal);
        if ordinal == 0 {
            second.store.flush().expect("written");
            let chunk = std::fs::read(path.join("chunks/00000000.kgs")).expect("the last chunk");
            assert!(decode_chunk(&chunk).expect("whole").decoder.bytes == last_decoder, "a closed chunk is frozen");
        }
    }
    let counters = second.finish();
    assert!(counters.pages_returned >= 4 && counters.pages_lost == 0, "{counters:?}");
    let map = MapStoreReader::open(&path, 1000).expect("a map");
    assert_eq!((map.keyframes().len(), map.damages()), (2 * ONE_WAY as usize, [].as_slice()));
    let n_after: u64 = map.pages().iter().map(|page| u64::from(page.n_anchors)).sum();
    assert_eq!(n_after, n_before + counters.anchors_total - counters.anchors_pruned - counters.anchors_merged);
    assert!(counters.anchors_total < n_before, "{n_before} anchors were there, {counters:?}");
    assert!(!path.join("pages/00000000.tmp").exists());
}
