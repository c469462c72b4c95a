//! Small maps seen through a backend that remembers.

use super::stub::StubBackend;
use super::*;
use crate::map_store::{
    MapStoreReader, MapStoreWriter, StoreCapacity, StoreImage, StoreSettings, WhenBusy, is_held_out_frame,
};
use crate::splat::{BACKGROUND_COLUMNS, BACKGROUND_TEXELS, GaussianParams};
use kilogs_core::camera::Pinhole;
use kilogs_core::conventions::Rigid;
use kilogs_core::frame::PixelFormat;
use kilogs_core::store::{
    ChunkBackground, ChunkLabel, DecoderParams, MAX_LEVELS, Manifest, PageLabel, StoredAnchor, StoredKeyframe,
};
use nalgebra::Translation3;
use std::path::Path;

const WIDTH: u32 = 32;
const HEIGHT: u32 = 16;
const N_PAGES: u32 = 6;
const PAGE_STEP_M: f64 = 20.0;

fn manifest(pixel_format: PixelFormat) -> Manifest {
    Manifest {
        camera: Pinhole { width: WIDTH, height: HEIGHT, fx: 20.0, fy: 20.0, cx: 16.0, cy: 8.0 },
        mounting: None,
        pixel_format,
        voxel_m: [1.0; MAX_LEVELS],
        n_levels: 5,
        gaussians_per_anchor: 2,
        counts: None,
    }
}

fn keyframe(id: u32) -> StoredKeyframe {
    StoredKeyframe {
        keyframe_id: id,
        chunk_id: id / 3,
        frame_index: u64::from(id) * 4,
        timestamp_ns: u64::from(id),
        rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
        translation_m: [0.0, 0.0, f64::from(id) * PAGE_STEP_M],
        scale: 1.0,
        is_held_out: false,
        image_bytes: 0,
        image_crc: 0,
    }
}

/// One page of one keyframe every 20 m, with an anchor of level 0 (seen up to 21 m) and one of level 2 (84 m); three pages per chunk, whose sky is 0.25 or 0.5; the
/// camera sees 0.5 everywhere; the view of frame 7 is held out.
fn write_map(folder: &Path, pixel_format: PixelFormat) {
    let capacity = StoreCapacity { page_bytes: 1 << 17, page_buffers: 1, image_buffers: 1, read_buffers: 0 };
    let settings = StoreSettings { capacity, jpeg_quality: 100, when_busy: WhenBusy::Wait };
    let store = MapStoreWriter::create(folder, &manifest(pixel_format), &settings).expect("a new store");
    let gaussian = GaussianParams {
        offset: [0.0; 3],
        log_scale: [0.0; 3],
        quaternion_xyzw: [0.0, 0.0, 0.0, 1.0],
        opacity_logit: 0.0,
        color_logit: [0.0; 3],
    };
    let n_channels = if pixel_format == PixelFormat::Mono8 { 1 } else { 3 };
    let grey = vec![128; (WIDTH * HEIGHT) as usize * n_channels];
    let image = StoreImage { pixels: &grey, stride_bytes: WIDTH as usize * n_channels };
    for id in 0..N_PAGES {
        store.write_keyframe(&keyframe(id), image).expect("taken");
        let label = PageLabel {
            page_id: id,
            chunk_id: id / 3,
            first_keyframe_id: id,
            last_keyframe_id: id,
            ..PageLabel::default()
        };
        let anchor = StoredAnchor {
            position_in_keyframe_m: [0.0, 0.0, 5.0],
            keyframe_id: id,
            log_extent: [0.0; 3],
            level: 0,
            n_gaussians: 1,
            feature_kind: 0,
        };
        let mut page = store.begin_page(label).expect("a buffer");
        page.push(&anchor, &[gaussian]).expect("room");
        page.push(&StoredAnchor { level: 2, ..anchor }, &[gaussian]).expect("room");
        store.commit_page(page).expect("taken");
    }
    let held_out = StoredKeyframe { frame_index: 7, is_held_out: true, ..keyframe(1) };
    assert!(is_held_out_frame(held_out.frame_index));
    store.write_keyframe(&held_out, image).expect("taken");
    for chunk_id in 0..2 {
        let label =
            ChunkLabel { chunk_id, first_keyframe_id: chunk_id * 3, last_keyframe_id: chunk_id * 3 + 2, revision: 0 };
        let texels = vec![[0.25 * (chunk_id + 1) as f32; 3]; BACKGROUND_TEXELS];
        let background = ChunkBackground { width: BACKGROUND_COLUMNS as u32, texels: &texels };
        store.write_chunk(&label, DecoderParams::EXPLICIT, background).expect("taken");
    }
    store.finish().expect("written");
}

fn scratch_map(pixel_format: PixelFormat) -> (tempfile::TempDir, MapStoreReader) {
    let scratch = tempfile::tempdir().expect("a scratch folder");
    write_map(scratch.path(), pixel_format);
    let map = MapStoreReader::open(scratch.path(), 100).expect("the store opens");
    (scratch, map)
}

/// Drives through the map and says which keyframes' anchors were shown at every stop.
fn drive(map: &MapStoreReader, backend: &mut StubBackend, stops_z_m: &[f64]) -> ViewerCounts {
    let mut picture = Picture::new(WIDTH, HEIGHT);
    let mut viewer = MapViewer::new(map, backend);
    for z_m in stops_z_m {
        let map_from_camera = Rigid::from_parts(Translation3::new(0.0, 0.0, *z_m), Default::default());
        let chunk_id = viewer.chunk_near(&map_from_camera.translation.vector);
        viewer.render(&map_from_camera, &map.manifest().camera, chunk_id, &mut picture).expect("drawn");
    }
    viewer.counts()
}

#[test]
fn near_pages_are_shown_with_all_levels_and_far_ones_with_the_coarse() {
    let (_scratch, map) = scratch_map(PixelFormat::Rgb8);
    let check = |(anchors, keyframe_rows, chunk_rows), expected: [&[i64]; 3], what: &str| {
        let mut backend = StubBackend::new(anchors, keyframe_rows, chunk_rows);
        let counts = drive(&map, &mut backend, &[0.0, 50.0, 100.0]);
        assert_eq!(backend.shown_z_m, expected, "{what}");
        assert_eq!((counts.pages_damaged, counts.anchors_left_out, counts.backgrounds_missing), (0, 0, 0));
        assert!(counts.anchors_peak <= anchors as u64, "{what}");
    };
    let all: [&[i64]; 3] =
        [&[0, 0, 20, 20, 40, 60, 80], &[0, 20, 40, 40, 60, 60, 80, 100], &[20, 40, 60, 80, 80, 100, 100]];
    check((100, 9, 2), all, "room for everything");
    check((7, 9, 2), [all[0], &[0, 20, 40, 40, 60, 60, 80], all[2]], "room for seven anchors");
    check((3, 9, 2), [&[0, 0], &[40, 40], &[100, 100]], "room for three anchors");
    check((100, 2, 2), [&[0, 0, 20, 20], &[40, 40, 60, 60], &[80, 80, 100, 100]], "two keyframe rows");
    check((100, 9, 1), [&[0, 0, 20, 20, 40], &[40, 40], &[60, 80, 80, 100, 100]], "the camera's chunk only");
}

#[test]
fn standing_still_loads_nothing_twice() {
    let (_scratch, map) = scratch_map(PixelFormat::Rgb8);
    let mut backend = StubBackend::new(100, 9, 2);
    let counts = drive(&map, &mut backend, &[0.0, 0.0, 1.0]);
    assert_eq!((counts.pages_loaded, counts.pages_evicted, counts.anchors_peak), (5, 0, 7));
}

fn damage(page: &Path) {
    let mut bytes = std::fs::read(page).expect("read");
    *bytes.last_mut().expect("not empty") ^= 1;
    std::fs::write(page, bytes).expect("written");
}

#[test]
fn a_damaged_page_is_missing_everywhere_and_reported_once() {
    let (scratch, map) = scratch_map(PixelFormat::Rgb8);
    damage(&scratch.path().join("pages/00000001.kgs"));
    let mut backend = StubBackend::new(100, 9, 2);
    let counts = drive(&map, &mut backend, &[0.0, 100.0, 0.0]);
    // Four pages at first, then one more and the fine level of another, then the first page again.
    assert_eq!((counts.pages_damaged, counts.pages_loaded), (1, 7));
    let expected: [&[i64]; 3] = [&[0, 0, 40, 60, 80], &[40, 60, 80, 80, 100, 100], &[0, 0, 40, 60, 80]];
    assert_eq!(backend.shown_z_m, expected);
}

#[test]
fn a_page_that_is_damaged_while_the_camera_moves_is_left_out_altogether() {
    let (scratch, map) = scratch_map(PixelFormat::Rgb8);
    let mut backend = StubBackend::new(100, 9, 2);
    let mut picture = Picture::new(WIDTH, HEIGHT);
    let mut viewer = MapViewer::new(&map, &mut backend);
    for z_m in [0.0, 50.0, 50.0] {
        let map_from_camera = Rigid::from_parts(Translation3::new(0.0, 0.0, z_m), Default::default());
        viewer.render(&map_from_camera, &map.manifest().camera, 0, &mut picture).expect("drawn");
        // Its coarse level is there; its fine one will be wanted.
        damage(&scratch.path().join("pages/00000002.kgs"));
    }
    assert_eq!(viewer.counts().pages_damaged, 1);
    let expected: [&[i64]; 3] = [&[0, 0, 20, 20, 40, 60, 80], &[0, 20, 60, 60, 80, 100], &[0, 20, 60, 60, 80, 100]];
    assert_eq!(backend.shown_z_m, expected);
}

#[test]
fn a_lost_chunk_is_shown_before_grey_and_counted() {
    let (scratch, _) = scratch_map(PixelFormat::Rgb8);
    std::fs::remove_file(scratch.path().join("chunks/00000001.kgs")).expect("removed");
    let map = MapStoreReader::open(scratch.path(), 100).expect("the store opens");
    assert_eq!(map.damages().len(), 1);
    let counts = drive(&map, &mut StubBackend::new(100, 9, 2), &[100.0]);
    assert_eq!(counts.backgrounds_missing, 1);
}

#[test]
fn judging_follows_the_drive_and_tells_the_kinds_apart() {
    for pixel_format in [PixelFormat::Rgb8, PixelFormat::Mono8] {
        let (_scratch, map) = scratch_map(pixel_format);
        let mut seen = Vec::new();
        let quality = judge_map(&map, &mut StubBackend::new(100, 9, 2), &mut |view| {
            seen.push((view.keyframe.frame_index, view.driven_m.round() as i64));
            Ok(())
        });
        let quality = quality.expect("judged");
        assert_eq!(seen, [(0, 0), (4, 20), (7, 20), (8, 40), (12, 60), (16, 80), (20, 100)]);
        // The first chunk's sky differs from the image by a quarter: 12 dB; the second's by half a step at most.
        let db = quality.held_out.psnr_db().expect("one view");
        let expected_db = 20.0 * (255.0_f64 / (128.0 - 63.75)).log10();
        assert!((db - expected_db).abs() < 0.2, "{pixel_format:?}: {db} dB, expected {expected_db}");
        let train_db = quality.train.psnr_db().expect("six views");
        assert!(train_db > db + 10.0, "{pixel_format:?}: {train_db} dB");
        assert_eq!(quality.views_skipped, 0);
    }
}

#[test]
#[cfg(feature = "inference")]
fn a_network_compares_what_a_display_shows() {
    // Four thirds of the mean squared difference, where the channels are alike.
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/models");
    let networks = crate::inference::Manifest::find(&folder).expect("part of the source tree");
    for pixel_format in [PixelFormat::Rgb8, PixelFormat::Mono8] {
        let (_scratch, map) = scratch_map(pixel_format);
        let mut lpips = crate::inference::open_lpips(&networks, (WIDTH as usize, HEIGHT as usize)).expect("loaded");
        let figures = measure_lpips(&map, &mut StubBackend::new(100, 9, 2), &mut lpips).expect("measured");
        let expected = [0.25, 0.5].map(|sky: f64| 4.0 / 3.0 * (sky - 128.0 / 255.0).powi(2));
        let check = |found: Option<f64>, expected: f64| {
            let found = found.expect("views of both kinds");
            assert!((found / expected - 1.0).abs() < 0.02, "{pixel_format:?}: {found}, expected {expected}");
        };
        check(figures.held_out, expected[0]);
        check(figures.train, 0.5 * (expected[0] + expected[1]));
    }
}

#[test]
fn a_view_without_its_image_is_skipped_and_counted() {
    let (scratch, map) = scratch_map(PixelFormat::Rgb8);
    std::fs::write(scratch.path().join("images/00000008.jpg"), b"not any more").expect("written");
    let mut n_judged = 0;
    let quality = judge_map(&map, &mut StubBackend::new(100, 9, 2), &mut |_| {
        n_judged += 1;
        Ok(())
    });
    assert_eq!((quality.expect("judged").views_skipped, n_judged), (1, 6));
}

#[test]
fn the_command_renders_every_pose_and_refuses_what_it_cannot() {
    let (scratch, map) = scratch_map(PixelFormat::Rgb8);
    let trajectory = scratch.path().join("poses.txt");
    std::fs::write(&trajectory, "# two poses\n0 0 0 0 0 0 0 1\n1 0 0 100 0 0 0 1\n").expect("written");
    let out = scratch.path().join("views");
    let args = command::RenderArgs { map: scratch.path().to_owned(), trajectory, out: out.clone() };
    assert_eq!(command::run(&args, &map, &mut StubBackend::new(100, 9, 2)).ok(), Some(2));
    let last = image::open(out.join("000001.png")).expect("a picture").to_rgb8();
    assert_eq!(last.get_pixel(0, 0).0, [128; 3]);

    let missing = command::RenderArgs { trajectory: scratch.path().join("none.txt"), ..args };
    let error = command::run(&missing, &map, &mut StubBackend::new(100, 9, 2)).expect_err("no trajectory");
    assert!(error.code() == 3 && error.to_string().contains("none.txt"), "{error}");
}

#[derive(Debug, clap::Parser)]
struct CommandLine {
    #[command(flatten)]
    args: command::RenderArgs,
}

#[test]
fn the_command_line_takes_a_map_a_trajectory_and_a_folder() {
    use clap::Parser;
    let check = |line: &str, accepted: bool| {
        let parsed = CommandLine::try_parse_from(line.split(' '));
        assert_eq!(parsed.is_ok(), accepted, "{line}: {parsed:?}");
    };
    check("render out/04/map --trajectory keyframes_tum.txt --out views", true);
    check("render out/04/map --trajectory keyframes_tum.txt", false);
    check("render --trajectory keyframes_tum.txt --out views", false);
}
