//! Whole exports of small maps.

use super::*;
use crate::map_store::{MapStoreWriter, StoreCapacity, StoreSettings, WhenBusy};
use kilogs_core::camera::Pinhole;
use kilogs_core::frame::PixelFormat;
use kilogs_core::map::GaussianParams;
use kilogs_core::store::{MAX_LEVELS, Manifest, PageLabel, StoredAnchor, StoredKeyframe};
use ply_rs_bw::parser::Parser;
use ply_rs_bw::ply::{DefaultElement, Property};
use std::io::Read;

const HEADER: &str = "ply\nformat binary_little_endian 1.0\nelement vertex 4\n\
    property float x\nproperty float y\nproperty float z\nproperty float nx\nproperty float ny\nproperty float nz\n\
    property float f_dc_0\nproperty float f_dc_1\nproperty float f_dc_2\nproperty float opacity\n\
    property float scale_0\nproperty float scale_1\nproperty float scale_2\n\
    property float rot_0\nproperty float rot_1\nproperty float rot_2\nproperty float rot_3\nend_header\n";

pub(super) fn gaussian(opacity_logit: f32) -> GaussianParams {
    GaussianParams {
        offset: [0.0; 3],
        log_scale: [-2.0; 3],
        quaternion_xyzw: [0.6, 0.0, 0.0, 0.8],
        opacity_logit,
        color_logit: [0.0; 3],
    }
}

/// An empty store with room for two Gaussians per anchor.
pub(super) fn create_store(folder: &Path, camera: Pinhole, page_bytes: usize) -> MapStoreWriter {
    let manifest = Manifest {
        camera,
        mounting: None,
        pixel_format: PixelFormat::Mono8,
        voxel_m: [1.0; MAX_LEVELS],
        n_levels: 5,
        gaussians_per_anchor: 2,
        counts: None,
    };
    let capacity = StoreCapacity { page_bytes, page_buffers: 1, image_buffers: 1, read_buffers: 0 };
    let settings = StoreSettings { capacity, jpeg_quality: 90, when_busy: WhenBusy::Wait };
    MapStoreWriter::create(folder, &manifest, &settings).expect("a new store")
}

/// A keyframe 10 m behind the next one, looking along the road.
pub(super) fn keyframe(id: u32) -> StoredKeyframe {
    StoredKeyframe {
        keyframe_id: id,
        chunk_id: 0,
        frame_index: u64::from(id),
        timestamp_ns: 0,
        rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
        translation_m: [0.0, 0.0, 10.0 * f64::from(id)],
        scale: 1.0,
        is_held_out: false,
        image_bytes: 0,
        image_crc: 0,
    }
}

/// Three pages of one keyframe each, 10 m apart, with two Gaussians 5 m ahead; one of the second page is not finite.
fn write_map(folder: &Path) {
    let camera = Pinhole { width: 16, height: 8, fx: 10.0, fy: 10.0, cx: 8.0, cy: 4.0 };
    let store = create_store(folder, camera, 1024);
    for id in 0..3 {
        store.place_keyframe(&keyframe(id)).expect("taken");
        let label = PageLabel { page_id: id, first_keyframe_id: id, last_keyframe_id: id, ..PageLabel::default() };
        let anchor = StoredAnchor {
            position_in_keyframe_m: [0.0, 0.0, 5.0],
            keyframe_id: id,
            log_extent: [0.0; 3],
            level: 0,
            n_gaussians: 2,
            feature_kind: 0,
        };
        let second = if id == 1 { f32::NAN } else { -2.0 };
        let mut page = store.begin_page(label).expect("a buffer");
        page.push(&anchor, &[gaussian(-1.0), gaussian(second)]).expect("room");
        store.commit_page(page).expect("taken");
    }
    store.finish().expect("written");
}

fn export(map: &Path, file: &Path) -> Result<ExportSummary, ExportError> {
    let args =
        ExportArgs { map: map.to_owned(), ply: Some(file.to_owned()), spz: None, selection: Selection::default() };
    run(&args, 10)
}

#[test]
fn an_independent_reader_finds_what_the_map_holds() {
    let scratch = tempfile::tempdir().expect("a scratch folder");
    write_map(&scratch.path().join("map"));
    // The first page is damaged after the store was closed.
    let page = scratch.path().join("map/pages/00000000.kgs");
    let mut bytes = std::fs::read(&page).expect("read");
    *bytes.last_mut().expect("not empty") ^= 1;
    std::fs::write(&page, bytes).expect("written");

    let file = scratch.path().join("street.ply");
    // The run's folder is as good as the map's.
    let summary = export(scratch.path(), &file).expect("exported");
    assert_eq!(summary, ExportSummary { gaussians: 3, left_out: 1, damaged_pages: 1, ..ExportSummary::default() });

    let bytes = std::fs::read(&file).expect("read");
    let header = HEADER.replace("vertex 4", "vertex 3");
    assert_eq!(bytes.get(..header.len()), Some(header.as_bytes()));
    assert_eq!(bytes.len(), header.len() + 3 * 17 * 4);
    let parsed = Parser::<DefaultElement>::new().read_ply(&mut bytes.as_slice()).expect("a PLY file");
    let vertices = &parsed.payload["vertex"];
    let number = |row: usize, name: &str| match vertices[row][name] {
        Property::Float(value) => value,
        ref other => panic!("{other:?}"),
    };
    assert_eq!([number(0, "z"), number(1, "z"), number(2, "z")], [15.0, 25.0, 25.0]);
    let expected = [("opacity", -1.0), ("scale_1", -2.0), ("rot_0", 0.8), ("rot_1", 0.6), ("rot_3", 0.0), ("ny", 0.0)];
    for (name, value) in expected {
        assert_eq!(number(0, name), value, "{name}");
    }
    assert_eq!(number(0, "f_dc_0"), 0.0);
    assert_eq!(number(2, "opacity"), -2.0);
}

#[test]
fn a_region_or_a_chunk_is_exported_alone() {
    let scratch = tempfile::tempdir().expect("a scratch folder");
    write_map(scratch.path());
    let check = |selection: Selection, gaussians: u64, outside: u64| {
        let file = scratch.path().join("part.ply");
        let args = ExportArgs { map: scratch.path().to_owned(), ply: Some(file.clone()), spz: None, selection };
        let summary = run(&args, 10).expect("exported");
        assert_eq!((summary.gaussians, summary.outside), (gaussians, outside), "{args:?}");
        let header = HEADER.replace("vertex 4", &format!("vertex {gaussians}")).len();
        let n_bytes = std::fs::metadata(&file).expect("a file").len();
        assert_eq!(n_bytes, (header + gaussians as usize * 17 * 4) as u64);
    };
    let region = |text: &str| Selection { region: Some(text.parse().expect("a region")), ..Selection::default() };
    check(region("-1,0,1,10"), 2, 3);
    check(region("-1,0,1,20"), 3, 2);
    check(region("5,0,9,100"), 0, 5);
    check(Selection { chunks: vec![0], ..Selection::default() }, 5, 0);
    check(Selection { chunks: vec![7], ..Selection::default() }, 0, 0);
}

#[test]
fn nothing_half_written_is_left_behind() {
    let scratch = tempfile::tempdir().expect("a scratch folder");
    write_map(scratch.path());
    let missing = scratch.path().join("nowhere/street.ply");
    let error = export(scratch.path(), &missing).expect_err("no such folder");
    assert_eq!(error.code(), 1);
    assert!(error.to_string().contains("nowhere/street.ply"), "{error}");

    let full = scratch.path().join("full.ply");
    std::os::unix::fs::symlink("/dev/full", scratch.path().join("full.ply.part")).expect("linked");
    assert!(export(scratch.path(), &full).is_err());
    assert!(!full.exists() && !scratch.path().join("full.ply.part").exists());
}

#[test]
fn a_missing_map_is_refused_with_its_exit_code() {
    let scratch = tempfile::tempdir().expect("a scratch folder");
    let error = export(scratch.path(), &scratch.path().join("a.ply")).expect_err("no map");
    assert!(error.code() == 5 && error.to_string().contains("manifest.kgs"), "{error}");
}

/// The columns of an SPZ file, unpacked by what the format says and not by what we write.
#[test]
fn an_spz_file_holds_what_the_map_holds() {
    let scratch = tempfile::tempdir().expect("a scratch folder");
    write_map(&scratch.path().join("map"));
    let file = scratch.path().join("street.spz");
    let args = ExportArgs {
        map: scratch.path().to_owned(),
        ply: None,
        spz: Some(file.clone()),
        selection: Selection::default(),
    };
    let summary = run(&args, 10).expect("exported");
    assert_eq!((summary.gaussians, summary.left_out), (5, 1));

    let mut bytes = Vec::new();
    flate2::read::GzDecoder::new(std::fs::File::open(&file).expect("opened")).read_to_end(&mut bytes).expect("gzip");
    let n = 5;
    assert_eq!(bytes.len(), 16 + n * 20);
    assert_eq!(&bytes[..16], [b'N', b'G', b'S', b'P', 3, 0, 0, 0, 5, 0, 0, 0, 0, 12, 0, 0]);
    let (positions, rest) = bytes[16..].split_at(9 * n);
    let (opacities, rest) = rest.split_at(n);
    let (colors, rest) = rest.split_at(3 * n);
    let (scales, rotations) = rest.split_at(3 * n);
    let coordinate_m = |bytes: &[u8]| {
        let fixed = i32::from_le_bytes([0, bytes[0], bytes[1], bytes[2]]) >> 8;
        f64::from(fixed) / 4096.0
    };
    // Forward is -z there; keyframes are 10 m apart and see 5 m ahead.
    let z_m: Vec<f64> = positions.chunks(9).map(|position| coordinate_m(&position[6..])).collect();
    assert_eq!(z_m, [-5.0, -5.0, -15.0, -25.0, -25.0]);
    // Opacities are the logistic function of -1 and -2.
    assert_eq!(opacities, [69, 30, 69, 69, 30]);
    assert!(colors.iter().all(|value| value.abs_diff(127) <= 1), "{colors:?}");
    assert!(scales.iter().all(|value| *value == 128), "{scales:?}");
    // (0.6, 0, 0, 0.8): w is the largest, x is 434 of 511 steps to sqrt(1/2).
    for rotation in rotations.chunks(4) {
        assert_eq!(
            u32::from_le_bytes([rotation[0], rotation[1], rotation[2], rotation[3]]) & !(1 << 19 | 1 << 9),
            3 << 30 | 434 << 20
        );
    }
}

#[derive(Debug, clap::Parser)]
struct CommandLine {
    #[command(flatten)]
    args: ExportArgs,
}

#[test]
fn the_command_line_takes_a_map_and_exactly_one_format() {
    use clap::Parser;
    let check = |line: &str, accepted: bool| {
        let parsed = CommandLine::try_parse_from(line.split(' '));
        assert_eq!(parsed.is_ok(), accepted, "{line}: {parsed:?}");
    };
    check("export out/04/map --ply street.ply", true);
    check("export --spz street.spz out/04/map", true);
    check("export map --spz street.spz --region -20,0,20,100 --chunk 1 --chunk 2 --finest-level 2", true);
    check("export map --ply street.ply --region -20,0", false);
    check("export map --ply street.ply --finest-level 9", false);
    check("export map --ply street.ply --finest-level 1 --all-levels", false);
    check("export out/04/map", false);
    check("export --ply street.ply", false);
    check("export out/04/map --ply street.ply --spz street.spz", false);
}
