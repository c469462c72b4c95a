//! Small maps of a painted wall, refined on the CPU.

use super::run::train;
use super::stretch::StretchMemory;
use crate::budget::Budget;
use crate::cli::CommonArgs;
use crate::fit::Effort;
use crate::map_store::{
    MapStoreEditor, MapStoreReader, MapStoreWriter, StoreCapacity, StoreError, StoreImage, StoreSettings, WhenBusy,
};
use crate::pipeline::{self, RunPlan};
use crate::render_views::judge_map;
use crate::run_error::RunError;
use crate::splat::{BACKGROUND_COLUMNS, BACKGROUND_TEXELS, GaussianParams};
use clap::Parser;
use kilogs_core::camera::Pinhole;
use kilogs_core::frame::PixelFormat;
use kilogs_core::store::{
    ChunkBackground, ChunkLabel, DecoderParams, MAX_LEVELS, Manifest, PageLabel, StoredAnchor, StoredKeyframe,
    page_file_bytes,
};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

const WIDTH: u32 = 48;
const HEIGHT: u32 = 32;
const N_KEYFRAMES: u32 = 12;
const PAGE_KEYFRAMES: u32 = 3;
const CHUNK_KEYFRAMES: u32 = 6;
const STEP_M: f64 = 1.0;

#[derive(Parser)]
struct Line {
    #[command(flatten)]
    common: CommonArgs,
}

fn keyframe(id: u32) -> StoredKeyframe {
    StoredKeyframe {
        keyframe_id: id,
        chunk_id: id / CHUNK_KEYFRAMES,
        frame_index: u64::from(id) * 2,
        timestamp_ns: u64::from(id),
        rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
        translation_m: [f64::from(id) * STEP_M, 0.0, 0.0],
        scale: 1.0,
        is_held_out: false,
        image_bytes: 0,
        image_crc: 0,
    }
}

/// Keyframes along a grey wall 10 m away whose picture is colored; four pages in two chunks, one view held out.
fn write_map(folder: &Path) {
    let manifest = Manifest {
        camera: Pinhole { width: WIDTH, height: HEIGHT, fx: 40.0, fy: 40.0, cx: 24.0, cy: 16.0 },
        mounting: None,
        pixel_format: PixelFormat::Rgb8,
        voxel_m: [1.0; MAX_LEVELS],
        n_levels: 5,
        gaussians_per_anchor: 2,
        counts: None,
    };
    let capacity = StoreCapacity { page_bytes: 1 << 17, page_buffers: 1, image_buffers: 1, read_buffers: 0 };
    let settings = StoreSettings { capacity, jpeg_quality: 95, when_busy: WhenBusy::Wait };
    let store = MapStoreWriter::create(folder, &manifest, &settings).expect("a new store");
    for id in 0..N_KEYFRAMES {
        let pixels: Vec<u8> = (0..WIDTH * HEIGHT)
            .flat_map(|pixel| {
                let (x_m, y_m) = (f64::from(pixel % WIDTH) / 4.0 - 6.0, f64::from(pixel / WIDTH) / 4.0 - 4.0);
                let along = x_m + f64::from(id) * STEP_M;
                [128.0 + 100.0 * (along / 2.0).sin(), 128.0 + 20.0 * y_m, 60.0].map(|value| value as u8)
            })
            .collect();
        let image = StoreImage { pixels: &pixels, stride_bytes: WIDTH as usize * 3 };
        store.write_keyframe(&keyframe(id), image).expect("taken");
        if id == 5 {
            let held_out = StoredKeyframe { frame_index: 7, is_held_out: true, ..keyframe(id) };
            store.write_keyframe(&held_out, image).expect("taken");
        }
    }
    for page_id in 0..N_KEYFRAMES / PAGE_KEYFRAMES {
        write_page(&store, page_id);
    }
    for chunk_id in 0..N_KEYFRAMES / CHUNK_KEYFRAMES {
        let first_keyframe_id = chunk_id * CHUNK_KEYFRAMES;
        let last_keyframe_id = first_keyframe_id + CHUNK_KEYFRAMES - 1;
        let label = ChunkLabel { chunk_id, first_keyframe_id, last_keyframe_id, revision: 0 };
        let background = ChunkBackground { width: BACKGROUND_COLUMNS as u32, texels: &[[0.5; 3]; BACKGROUND_TEXELS] };
        store.write_chunk(&label, DecoderParams::EXPLICIT, background).expect("taken");
    }
    store.finish().expect("written");
}

/// Every keyframe spawned a column of the wall in front of it.
fn write_page(store: &MapStoreWriter, page_id: u32) {
    let first_keyframe_id = page_id * PAGE_KEYFRAMES;
    let label = PageLabel {
        page_id,
        chunk_id: first_keyframe_id / CHUNK_KEYFRAMES,
        first_keyframe_id,
        last_keyframe_id: first_keyframe_id + PAGE_KEYFRAMES - 1,
        ..PageLabel::default()
    };
    let gaussian = GaussianParams {
        offset: [0.0; 3],
        log_scale: [-0.5; 3],
        quaternion_xyzw: [0.0, 0.0, 0.0, 1.0],
        opacity_logit: 1.0,
        color_logit: [0.0; 3],
    };
    let mut page = store.begin_page(label).expect("a buffer");
    for keyframe_id in label.first_keyframe_id..=label.last_keyframe_id {
        for row in -4..=4i8 {
            let anchor = StoredAnchor {
                position_in_keyframe_m: [0.0, f32::from(row), 10.0],
                keyframe_id,
                log_extent: [0.0; 3],
                level: 0,
                n_gaussians: 1,
                feature_kind: 0,
            };
            page.push(&anchor, &[gaussian]).expect("room");
        }
    }
    store.commit_page(page).expect("taken");
}

struct Scratch {
    _folder: tempfile::TempDir,
    map: PathBuf,
}

fn scratch_map() -> Scratch {
    let folder = tempfile::tempdir().expect("a scratch folder");
    let map = folder.path().join("map");
    write_map(&map);
    Scratch { _folder: folder, map }
}

fn plan(map: &MapStoreReader, options: &[&str]) -> RunPlan {
    let line = ["refine", "--backend", "cpu", "--threads", "1", "--budget", "tiny.toml"];
    let args = Line::try_parse_from(line.iter().chain(options)).expect("options").common;
    let budget: Budget = args.budget().expect("a budget");
    RunPlan::for_stored_map(&args, &budget, map).expect("a plan that fits")
}

fn open(map: &Path) -> MapStoreReader {
    MapStoreReader::open(map, 100).expect("the map opens")
}

fn refine_for(map: &Path, steps: u64, options: &[&str]) -> Result<u64, RunError> {
    let map = open(map);
    let plan = plan(&map, options);
    let editor = MapStoreEditor::open_for_pages(&map, plan.budget.store_capacity().page_bytes)?;
    train(&map, &plan, Effort::Iterations(steps), editor, &mut || true).map(|counts| counts.steps)
}

/// PSNR of keyframes and of held-out views.
fn psnr_db(map: &Path) -> [f64; 2] {
    let map = open(map);
    let mut backend = pipeline::backend(&plan(&map, &[])).expect("a backend");
    let quality = judge_map(&map, backend.as_mut(), &mut |_| Ok(())).expect("judged");
    [quality.train.psnr_db().expect("views"), quality.held_out.psnr_db().expect("a view")]
}

fn files(map: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    for folder in ["", "pages", "chunks", "images"] {
        for entry in std::fs::read_dir(map.join(folder)).expect("listed") {
            let path = entry.expect("listed").path();
            if path.is_file() {
                let name = path.strip_prefix(map).expect("inside").to_owned();
                files.insert(name, std::fs::read(&path).expect("read"));
            }
        }
    }
    files
}

#[test]
fn views_of_other_stretches_that_see_the_same_are_trained_too() {
    let scratch = scratch_map();
    let map = open(&scratch.map);
    let plan = plan(&map, &[]);
    let editor = MapStoreEditor::open(&map, plan.budget.store_capacity().page_bytes).expect("a folder for writing");
    let mut backend = pipeline::backend(&plan).expect("a backend");
    let mut memory = StretchMemory::new(&map, backend.as_mut(), editor);
    assert_eq!(memory.load(4..6), [4, 5, 0, 1, 2, 3, 6, 7, 8, 9, 10, 11]);
    let rows = [0, 1, 2].map(|chunk_id| memory.chunk_row(chunk_id).is_some());
    assert_eq!(rows, [true, true, false], "a guest is seen before the sky of its own chunk");
}

#[test]
fn a_refined_map_looks_more_like_its_pictures_and_the_same_steps_give_the_same_bytes() {
    let maps = [scratch_map(), scratch_map()];
    let before = psnr_db(&maps[0].map);
    for scratch in &maps {
        assert_eq!(refine_for(&scratch.map, 96, &[]).expect("refined"), 96);
    }
    let after = psnr_db(&maps[0].map);
    assert!(after[0] > before[0] + 3.0 && after[1] > before[1] + 3.0, "{before:?} dB became {after:?} dB");
    assert!(files(&maps[0].map) == files(&maps[1].map), "the two maps differ");
    let map = open(&maps[0].map);
    assert!(map.damages().is_empty() && map.pages().iter().all(|page| page.revision == 2), "{:?}", map.pages());
    assert!(map.manifest().counts.is_some());
}

#[test]
fn every_part_of_the_route_is_visited_and_improves() {
    let scratch = scratch_map();
    // As many exposures as images fit into memory: nine, so there are two stretches.
    let original = files(&scratch.map);
    refine_for(&scratch.map, 96, &["--set", "mapping.exposure=true"]).expect("refined");
    let refined = files(&scratch.map);
    assert_eq!(refined.keys().collect::<Vec<_>>(), original.keys().collect::<Vec<_>>());
    for (name, bytes) in &refined {
        let is_trained = name.starts_with("pages") || name.starts_with("chunks") || name.ends_with("manifest.kgs");
        assert_eq!(bytes != &original[name], is_trained, "{}", name.display());
    }
}

#[test]
fn what_is_damaged_is_left_as_it_is_and_the_rest_is_refined() {
    for damaged in ["pages/00000001.kgs", "chunks/00000001.kgs", "images/00000004.jpg"] {
        let scratch = scratch_map();
        let path = scratch.map.join(damaged);
        let mut bytes = std::fs::read(&path).expect("read");
        let middle = bytes.len() / 2;
        bytes[middle] ^= 0x10;
        std::fs::write(&path, &bytes).expect("written");
        let page = scratch.map.join("pages/00000003.kgs");
        let neighbour = std::fs::read(&page).expect("read");
        refine_for(&scratch.map, 24, &[]).expect("refined");
        assert!(std::fs::read(&path).expect("read") == bytes, "{damaged} was changed");
        assert!(std::fs::read(&page).expect("read") != neighbour, "the rest was not refined beside {damaged}");
    }
}

#[test]
fn a_map_that_does_not_fit_at_once_is_refined_in_shorter_stretches() {
    let scratch = scratch_map();
    let map = open(&scratch.map);
    let args = Line::try_parse_from(["refine", "--backend", "cpu", "--budget", "tiny.toml"]).expect("options").common;
    // 27 anchors a page, four pages: two fit.
    let budget = args.budget().expect("a budget").with_max_gaussians(2 * 64).expect("scaled");
    let plan = RunPlan::for_stored_map(&args, &budget, &map).expect("a plan");
    let editor = MapStoreEditor::open(&map, plan.budget.store_capacity().page_bytes).expect("opened");
    let counts = train(&map, &plan, Effort::Iterations(48), editor, &mut || true).expect("refined");
    assert!(counts.steps == 48 && counts.parts > 3, "{counts:?}");
    let map = open(&scratch.map);
    assert!(map.damages().is_empty() && map.pages().iter().all(|page| page.n_anchors > 0 && page.revision > 0));
}

/// Nothing of so small a picture is faint or oversized.
const KEEP_ALL: [&str; 4] = ["--set", "mapping.max_width_ratio=1", "--set", "mapping.min_opacity=0"];

/// Gaussians of a map of 108 on 11 m that was refined with a setting.
fn gaussians_after(setting: &str) -> u32 {
    let scratch = scratch_map();
    let options: Vec<&str> = KEEP_ALL.into_iter().chain(["--set", setting]).collect();
    refine_for(&scratch.map, 48, &options).expect("refined");
    let map = open(&scratch.map);
    assert!(map.damages().is_empty());
    assert_eq!(map.pages().len(), (N_KEYFRAMES / PAGE_KEYFRAMES) as usize, "an empty page stays a page");
    map.pages().iter().map(|page| page.n_gaussians).sum()
}

#[test]
fn a_route_keeps_as_many_gaussians_as_its_length_allows() {
    // 11 m, and 20 m that the first view is worth.
    let [few, more] = ["1", "2.5"].map(|per_m| gaussians_after(&format!("lifecycle.max_gaussians_per_m={per_m}")));
    assert!((1..=31).contains(&few) && (32..=78).contains(&more), "{few} and {more}");
}

#[test]
fn what_is_wrong_is_split_only_when_that_is_asked_for() {
    assert_eq!(gaussians_after("lifecycle.densify=false"), 108);
    assert!(gaussians_after("lifecycle.densify=true") > 108);
}

#[test]
fn a_page_with_more_anchors_than_the_budget_rewrites_is_refused_before_the_work() {
    let scratch = scratch_map();
    let before = files(&scratch.map);
    let map = open(&scratch.map);
    // 27 anchors of at most two Gaussians and a feature each.
    let page_bytes = page_file_bytes(26, 52, true);
    let refused = MapStoreEditor::open_for_pages(&map, page_bytes).expect_err("refused").to_string();
    for part in ["pages/", "holds 27 anchors, the budget allows 26", "[store.page_anchors]"] {
        assert!(refused.contains(part), "{part} in {refused}");
    }
    assert!(files(&scratch.map) == before, "nothing was written");
    assert!(MapStoreEditor::open_for_pages(&map, page_file_bytes(27, 54, true)).is_ok());
}

/// Tells the child process below which map to refine; unset in an ordinary test run.
const FOLDER_VARIABLE: &str = "KILOGS_TEST_REFINED_MAP";

/// Not a test of its own: what the tests below run as a child process.
#[test]
fn endless_refiner() {
    let Some(folder) = std::env::var_os(FOLDER_VARIABLE) else { return };
    loop {
        match refine_for(Path::new(&folder), 4, &[]) {
            Ok(_) => {}
            Err(error) => {
                println!("exit code {}: {error}", error.code());
                return;
            }
        }
    }
}

fn start(map: &Path, before: &str) -> Child {
    Command::new("sh")
        .arg("-c")
        .arg(format!("{before} exec \"$0\" --exact refine::tests::endless_refiner --nocapture"))
        .arg(std::env::current_exe().expect("the test binary"))
        .env(FOLDER_VARIABLE, map)
        .stdout(Stdio::piped())
        .spawn()
        .expect("a shell")
}

#[test]
fn a_killed_refinement_leaves_a_map_that_opens_whole() {
    for delay_ms in [150, 211, 333] {
        let scratch = scratch_map();
        let mut child = start(&scratch.map, "");
        let page = scratch.map.join("pages/00000003.kgs");
        let original = std::fs::read(&page).expect("read");
        let changed = || std::fs::read(&page).expect("read") != original;
        (0..6000).find(|_| {
            std::thread::sleep(Duration::from_millis(5));
            changed()
        });
        assert!(changed(), "nothing was refined within half a minute");
        std::thread::sleep(Duration::from_millis(delay_ms));
        child.kill().expect("SIGKILL");
        let _ = child.wait();
        let map = open(&scratch.map);
        assert!(map.damages().is_empty(), "{:?}", map.damages());
        let mut buffer = Vec::new();
        for page in map.pages() {
            let (label, _) = map.read_page(page.page_id, &mut buffer).expect("a whole page");
            // Faint anchors end as it goes on.
            assert!(label.n_anchors <= 27, "{label:?}");
        }
        assert!(map.chunks().count() == 2 && map.keyframes().iter().all(|view| map.read_image(view).is_ok()));
    }
}

#[test]
fn a_disk_that_is_full_ends_it_with_advice_and_the_old_page() {
    let scratch = scratch_map();
    // Files of at most 1 KiB, and no signal instead of the error: the manifest can be written, a page cannot.
    let output = start(&scratch.map, "trap '' 25; ulimit -f 2;").wait_with_output().expect("the child ends by itself");
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(said.contains("exit code 5: writing the map: writing") && said.contains("the disk is full"), "{said}");
    let map = open(&scratch.map);
    assert!(map.damages().is_empty() && map.pages().iter().all(|page| page.revision == 0));
}

#[test]
fn a_folder_that_cannot_be_written_is_known_at_once() {
    let scratch = scratch_map();
    // What the manifest is written to first is a folder: no permission stops a test that runs as root.
    std::fs::create_dir(scratch.map.join("manifest.tmp")).expect("made");
    let refused = refine_for(&scratch.map, 4, &[]).expect_err("refused");
    assert!(matches!(refused, RunError::Store(StoreError::Write { .. })) && refused.code() == 5, "{refused}");
}
