//! Whole stores, written and read back, also after things went wrong.

mod limits;
mod sizes;

use super::*;
use kilogs_core::camera::Pinhole;
use kilogs_core::frame::PixelFormat;
use kilogs_core::map::GaussianParams;
use kilogs_core::store::{
    ChunkBackground, ChunkLabel, DecoderParams, MAX_LEVELS, Manifest, PageLabel, RecordProblem, StoredAnchor,
    StoredKeyframe,
};
use nalgebra::Vector3;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

const SIZE: (u32, u32) = (32, 16);

fn manifest(pixel_format: PixelFormat) -> Manifest {
    Manifest {
        camera: Pinhole { width: SIZE.0, height: SIZE.1, fx: 20.0, fy: 20.0, cx: 16.0, cy: 8.0 },
        mounting: None,
        pixel_format,
        voxel_m: [0.1, 0.25, 1.0, 5.0, 25.0, 0.0, 0.0, 0.0][..MAX_LEVELS].try_into().expect("all levels"),
        n_levels: 5,
        gaussians_per_anchor: 2,
        counts: None,
    }
}

fn settings(when_busy: WhenBusy) -> StoreSettings {
    let capacity = StoreCapacity { page_bytes: 4096, page_buffers: 2, image_buffers: 1, read_buffers: 0 };
    StoreSettings { capacity, jpeg_quality: DEFAULT_JPEG_QUALITY, when_busy }
}

pub(super) fn create(folder: &Path) -> MapStoreWriter {
    MapStoreWriter::create(folder, &manifest(PixelFormat::Rgb8), &settings(WhenBusy::Wait)).expect("a new store")
}

pub(super) fn keyframe(id: u32) -> StoredKeyframe {
    StoredKeyframe {
        keyframe_id: id,
        chunk_id: 0,
        frame_index: u64::from(id) * 3,
        timestamp_ns: u64::from(id) * 300_000_000,
        rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
        translation_m: [0.0, 0.0, f64::from(id) * 10.0],
        scale: 1.0,
        is_held_out: false,
        image_bytes: 0,
        image_crc: 0,
    }
}

fn anchor(keyframe_id: u32) -> StoredAnchor {
    StoredAnchor {
        position_in_keyframe_m: [0.5, 0.25, 8.0],
        keyframe_id,
        log_extent: [-1.0; 3],
        level: 1,
        n_gaussians: 2,
        feature_kind: 0,
    }
}

const GAUSSIANS: [GaussianParams; 2] = [GaussianParams {
    offset: [0.1, 0.2, 0.3],
    log_scale: [-0.5; 3],
    quaternion_xyzw: [0.0, 0.0, 0.0, 1.0],
    opacity_logit: 1.0,
    color_logit: [0.5; 3],
}; 2];

fn page_label(page_id: u32) -> PageLabel {
    PageLabel { page_id, first_keyframe_id: page_id * 2, last_keyframe_id: page_id * 2 + 1, ..PageLabel::default() }
}

pub(super) fn write_page(store: &MapStoreWriter, page_id: u32) -> Result<(), WriteRefusal> {
    let mut page = store.begin_page(page_label(page_id))?;
    for id in [page_id * 2, page_id * 2 + 1] {
        page.push(&anchor(id), &GAUSSIANS).expect("room for two anchors");
    }
    store.commit_page(page)
}

pub(super) fn write_keyframe(store: &MapStoreWriter, keyframe: &StoredKeyframe) -> Result<(), WriteRefusal> {
    let pixels: Vec<u8> = (0..SIZE.0 * SIZE.1 * 3).map(|i| (i / 7 + keyframe.keyframe_id * 20) as u8).collect();
    store.write_keyframe(keyframe, StoreImage { pixels: &pixels, stride_bytes: SIZE.0 as usize * 3 })
}

/// Three pages of two keyframes each, a held-out view, a chunk.
fn write_small_map(folder: &Path) -> Result<StoreSummary, StoreError> {
    let store = create(folder);
    for page_id in 0..3 {
        for id in [page_id * 2, page_id * 2 + 1] {
            let _ = write_keyframe(&store, &keyframe(id));
        }
        let _ = write_page(&store, page_id);
    }
    let held_out = StoredKeyframe { frame_index: 7, is_held_out: true, ..keyframe(2) };
    let _ = write_keyframe(&store, &held_out);
    let label = ChunkLabel { chunk_id: 0, first_keyframe_id: 0, last_keyframe_id: 5, revision: 0 };
    let background = ChunkBackground { width: 2, texels: &[[0.25; 3]; 4] };
    let _ = store.write_chunk(&label, DecoderParams::EXPLICIT, background);
    store.finish()
}

pub(super) fn open(folder: &Path) -> MapStoreReader {
    MapStoreReader::open(folder, 100).expect("the store opens")
}

pub(super) fn scratch() -> tempfile::TempDir {
    tempfile::tempdir().expect("a scratch folder")
}

/// Every file of the map with its content, by its name within the map.
fn all_files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    for part in [".", "pages", "chunks", "images"] {
        for entry in std::fs::read_dir(folder.join(part)).expect("listed") {
            let path = entry.expect("listed").path();
            if path.is_file() {
                files.insert(
                    Path::new(part).join(path.file_name().expect("named")),
                    std::fs::read(&path).expect("read"),
                );
            }
        }
    }
    files
}

#[test]
fn what_was_written_is_read_back() {
    let scratch = scratch();
    let summary = write_small_map(scratch.path()).expect("written");
    let map = open(scratch.path());
    let counts = map.manifest().counts.expect("complete");
    assert_eq!(counts, summary.counts);
    assert_eq!((counts.keyframes, counts.held_out, counts.images), (6, 1, 7));
    assert_eq!((counts.pages, counts.anchors, counts.gaussians, counts.chunks), (3, 6, 12, 1));
    assert_eq!(map.bytes().expect("listed"), summary.bytes);
    assert!(map.damages().is_empty(), "{:?}", map.damages());

    let mut buffer = Vec::new();
    let (label, mut page) = map.read_page(1, &mut buffer).expect("undamaged");
    assert_eq!((label.n_anchors, label.gaussians_per_anchor), (2, 2));
    let mut gaussians = GAUSSIANS.map(|gaussian| GaussianParams { opacity_logit: -9.0, ..gaussian });
    assert_eq!(page.next_anchor(&mut gaussians), Some(anchor(2)));
    assert_eq!(gaussians, GAUSSIANS);
    let chunk = map.read_chunk(0, &mut buffer).expect("undamaged");
    let mut texels = [[0.0; 3]; 4];
    assert_eq!(chunk.read_background(&mut texels), 4);
    assert_eq!(texels, [[0.25; 3]; 4]);
    let image = map.read_image(&map.held_out()[0]).expect("undamaged");
    assert_eq!(image.dimensions(), SIZE);
}

#[test]
fn pages_are_found_by_place() {
    let scratch = scratch();
    write_small_map(scratch.path()).expect("written");
    let map = open(scratch.path());
    let near = |z: f64, radius: f64| -> Vec<u32> {
        map.pages_near(&Vector3::new(0.0, 0.0, z), radius).map(|page| page.page_id).collect()
    };
    assert_eq!(near(0.0, 5.0), [0]);
    assert_eq!(near(16.0, 7.0), [0, 1]);
    assert_eq!(near(500.0, 100.0), Vec::<u32>::new());
}

#[test]
fn the_same_input_gives_the_same_bytes() {
    let (first, second) = (scratch(), scratch());
    write_small_map(first.path()).expect("written");
    write_small_map(second.path()).expect("written");
    // Writing over an older, larger map leaves nothing of it.
    std::fs::write(second.path().join("pages/00000009.kgs"), b"old").expect("written");
    write_small_map(second.path()).expect("written");
    let (first, second) = (all_files(first.path()), all_files(second.path()));
    assert_eq!(first.len(), 2 + 3 + 1 + 7);
    assert!(first == second, "{:?} and {:?}", first.keys(), second.keys());
}

#[test]
fn a_later_placement_moves_the_keyframe_and_keeps_its_image() {
    let scratch = scratch();
    let store = create(scratch.path());
    write_keyframe(&store, &keyframe(0)).expect("taken");
    let moved = StoredKeyframe { translation_m: [5.0, 0.0, 0.0], scale: 1.1, ..keyframe(0) };
    store.place_keyframe(&moved).expect("taken");
    store.finish().expect("written");
    let map = open(scratch.path());
    let found = map.keyframe(0).expect("it was written");
    assert_eq!((found.translation_m, found.scale), (moved.translation_m, 1.1));
    assert!(map.read_image(found).is_ok());
}

#[test]
fn a_page_written_again_replaces_the_older_one() {
    let scratch = scratch();
    let store = create(scratch.path());
    write_page(&store, 0).expect("taken");
    store.flush().expect("written");
    let again = store.begin_page(PageLabel { revision: 1, ..page_label(0) }).expect("a buffer");
    store.commit_page(again).expect("taken");
    let summary = store.finish().expect("written");
    assert_eq!((summary.counts.pages, summary.counts.anchors), (1, 0));
}

#[test]
fn grey_and_bgr_images_come_back_as_they_were() {
    for (format, pixel, expected) in
        [(PixelFormat::Mono8, &[90][..], [90, 90, 90]), (PixelFormat::Bgr8, &[20, 90, 200], [200, 90, 20])]
    {
        let scratch = scratch();
        let store =
            MapStoreWriter::create(scratch.path(), &manifest(format), &settings(WhenBusy::Wait)).expect("a new store");
        // Rows are padded by five bytes that must not show.
        let row: Vec<u8> = pixel.repeat(SIZE.0 as usize).into_iter().chain([255; 5]).collect();
        let image = StoreImage { pixels: &row.repeat(SIZE.1 as usize), stride_bytes: row.len() };
        store.write_keyframe(&keyframe(0), image).expect("taken");
        let short = StoreImage { pixels: &row, stride_bytes: row.len() };
        assert_eq!(store.write_keyframe(&keyframe(1), short), Err(WriteRefusal::TooLarge));
        store.finish().expect("written");
        let map = open(scratch.path());
        let picture = map.read_image(&map.keyframes()[0]).expect("undamaged");
        let worst = picture.pixels().flat_map(|p| (0..3).map(|c| p.0[c].abs_diff(expected[c]))).max();
        assert!(worst <= Some(3), "{format:?}: off by {worst:?}");
    }
}

#[test]
fn a_live_writer_refuses_when_all_buffers_are_out() {
    let scratch = scratch();
    let store = MapStoreWriter::create(scratch.path(), &manifest(PixelFormat::Rgb8), &settings(WhenBusy::Refuse))
        .expect("a new store");
    let drafts = [store.begin_page(page_label(0)), store.begin_page(page_label(1))].map(|draft| draft.expect("two"));
    assert_eq!(store.begin_page(page_label(2)).map(|_| ()), Err(WriteRefusal::Busy));
    let [first, second] = drafts;
    store.abandon_page(first);
    assert!(store.begin_page(page_label(2)).is_ok());
    store.commit_page(second).expect("taken");
    assert_eq!(store.finish().map(|summary| summary.counts.pages).ok(), Some(1));
}

#[test]
fn settings_that_cannot_work_are_refused_with_a_reason() {
    let scratch = scratch();
    let good = settings(WhenBusy::Wait);
    for (settings, format, reason) in [
        (StoreSettings { jpeg_quality: 0, ..good }, PixelFormat::Rgb8, "JPEG quality 0"),
        (good, PixelFormat::Nv12, "Nv12"),
        (
            StoreSettings { capacity: StoreCapacity { page_bytes: 99, ..good.capacity }, ..good },
            PixelFormat::Rgb8,
            "99 bytes",
        ),
        (
            StoreSettings { capacity: StoreCapacity { image_buffers: 0, ..good.capacity }, ..good },
            PixelFormat::Rgb8,
            "image buffer",
        ),
    ] {
        let error = MapStoreWriter::create(scratch.path(), &manifest(format), &settings).expect_err("refused");
        assert!(error.to_string().contains(reason), "{error}");
    }
}

#[test]
fn an_interrupted_store_opens_with_what_was_completed() {
    let scratch = scratch();
    let store = create(scratch.path());
    write_keyframe(&store, &keyframe(0)).expect("taken");
    write_keyframe(&store, &keyframe(1)).expect("taken");
    write_page(&store, 0).expect("taken");
    drop(store);
    // What a kill in mid-write leaves: half a log record, a temporary page.
    let log = scratch.path().join("keyframes.kgs");
    let mut torn = std::fs::read(&log).expect("read");
    torn.extend_from_within(..50);
    std::fs::write(&log, torn).expect("written");
    std::fs::write(scratch.path().join("pages/00000001.tmp"), b"half a page").expect("written");

    let map = open(scratch.path());
    assert_eq!(map.manifest().counts, None);
    assert_eq!((map.keyframes().len(), map.pages().len()), (2, 1));
    let problem = RecordProblem::Truncated { found: 50, needed: 128 };
    assert_eq!(map.damages().len(), 1);
    assert_eq!(map.damages()[0].kind, DamageKind::Record { offset: 256, problem });
}

#[test]
fn damage_is_reported_and_the_rest_stays_usable() {
    type Harm = fn(&mut Vec<u8>);
    let flip_body: Harm = |bytes| *bytes.last_mut().expect("not empty") ^= 4;
    let flip_label: Harm = |bytes| bytes[30] ^= 4;
    let cut: Harm = |bytes| bytes.truncate(bytes.len() - 1);
    let empty: Harm = Vec::clear;
    // File, harm, whether opening notices it (a page's body is verified when it is read).
    let cases = [
        ("pages/00000001.kgs", flip_body, false),
        ("pages/00000001.kgs", flip_label, true),
        ("pages/00000001.kgs", cut, true),
        ("pages/00000001.kgs", empty, true),
        ("chunks/00000000.kgs", flip_body, true),
        ("chunks/00000000.kgs", cut, true),
        ("images/00000009.jpg", flip_body, false),
        ("images/00000009.jpg", cut, false),
        ("keyframes.kgs", flip_label, true),
    ];
    for (file, harm, noticed_on_opening) in cases {
        let scratch = scratch();
        write_small_map(scratch.path()).expect("written");
        let path = scratch.path().join(file);
        let mut bytes = std::fs::read(&path).expect("read");
        harm(&mut bytes);
        std::fs::write(&path, bytes).expect("written");

        let map = open(scratch.path());
        assert_eq!(!map.damages().is_empty(), noticed_on_opening, "{file}: {:?}", map.damages());
        let mut buffer = Vec::new();
        assert_eq!(map.read_page(1, &mut buffer).is_err(), file.starts_with("pages"), "{file}");
        assert!(map.read_page(2, &mut buffer).is_ok(), "{file}: another page suffers");
        assert_eq!(map.read_chunk(0, &mut buffer).is_err(), file.starts_with("chunks"), "{file}");
        let image = map.read_image(map.keyframe(3).expect("undamaged record"));
        assert_eq!(image.is_err(), file.starts_with("images"), "{file}");
    }
}

#[test]
fn a_page_in_the_wrong_place_is_not_taken_for_another() {
    let scratch = scratch();
    write_small_map(scratch.path()).expect("written");
    let page = |id: u32| scratch.path().join(format!("pages/0000000{id}.kgs"));
    std::fs::copy(page(2), page(1)).expect("copied");
    let map = open(scratch.path());
    assert_eq!(map.pages().len(), 2);
    assert_eq!(map.damages()[0].kind, DamageKind::Misnamed { id: 2 });
}

#[test]
fn a_damaged_manifest_and_a_missing_map_are_errors_with_advice() {
    let scratch = scratch();
    write_small_map(scratch.path()).expect("written");
    let path = scratch.path().join("manifest.kgs");
    let mut bytes = std::fs::read(&path).expect("read");
    bytes[40] ^= 1;
    std::fs::write(&path, bytes).expect("written");
    let check = |folder: &Path, text: &str| {
        let error = MapStoreReader::open(folder, 100).expect_err("refused").to_string();
        assert!(error.contains(text), "{error}");
    };
    check(scratch.path(), "bytes were changed");
    check(&scratch.path().join("nowhere"), "is this the folder");
}

#[test]
fn a_map_above_the_budget_is_refused_with_its_row() {
    let scratch = scratch();
    write_small_map(scratch.path()).expect("written");
    let error = MapStoreReader::open(scratch.path(), 6).expect_err("seven are there").to_string();
    assert!(error.contains("holds 7 keyframes, the budget allows 6; raise [store.keyframe_table]"), "{error}");
}
