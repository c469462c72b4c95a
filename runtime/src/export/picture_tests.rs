//! The exported file, drawn by itself, shows what the map shows: placing, scaling, turning and colors agree with the
//! renderer, and so does the way through the store.

use super::tests::{create_store, keyframe};
use super::*;
use crate::render_views::{MapViewer, Picture};
use crate::splat::cpu::{CpuBackend, SimdLevel};
use crate::splat::{AnchorHeader, BACKGROUND_COLUMNS, BACKGROUND_TEXELS, Capacities, KeyframePlacement, SplatBackend};
use crate::splat::{RenderStats, View};
use kilogs_core::camera::Pinhole;
use kilogs_core::conventions::{Rigid, quaternion_xyzw};
use kilogs_core::map::DecoderShape;
use kilogs_core::map::GaussianParams;
use kilogs_core::map::decoder::{FEATURE_LEN, HIDDEN, NO_FEATURE};
use kilogs_core::math::Rng;
use kilogs_core::store::{ChunkBackground, ChunkLabel, DecoderParams, PageLabel, StoredAnchor, StoredKeyframe};
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use ply_rs_bw::parser::Parser;
use ply_rs_bw::ply::{DefaultElement, Property};

const N_KEYFRAMES: u32 = 3;
const ANCHORS_PER_KEYFRAME: usize = 15;
const CAMERA: Pinhole = Pinhole { width: 96, height: 64, fx: 80.0, fy: 80.0, cx: 48.0, cy: 32.0 };
static BLACK: [[f32; 3]; BACKGROUND_TEXELS] = [[0.0; 3]; BACKGROUND_TEXELS];

fn between(rng: &mut Rng, low: f32, high: f32) -> f32 {
    low + (high - low) * rng.unit_f32()
}

fn random_gaussian(rng: &mut Rng) -> GaussianParams {
    GaussianParams {
        offset: std::array::from_fn(|_| between(rng, -1.0, 1.0)),
        log_scale: std::array::from_fn(|_| between(rng, -1.5, 0.0)),
        quaternion_xyzw: std::array::from_fn(|_| between(rng, -1.0, 1.0)),
        opacity_logit: between(rng, -1.0, 3.0),
        color_logit: std::array::from_fn(|_| between(rng, -3.0, 3.0)),
    }
}

/// Keyframes that a loop closure turned, moved and scaled, each with Gaussians in front of it; anchors have features
/// where there is a decoder for them.
fn write_turned_map(folder: &Path, decoder: DecoderParams<'_>) {
    let mut rng = Rng::new(1, 2, 3);
    let mut feature_rng = Rng::new(4, 5, 6);
    let mut features = std::iter::repeat_with(|| NO_FEATURE.map(|_| between(&mut feature_rng, -1.0, 1.0)));
    let store = create_store(folder, CAMERA, 1 << 16);
    for id in 0..N_KEYFRAMES {
        let turn = UnitQuaternion::from_euler_angles(0.1 * f64::from(id), -0.15 * f64::from(id), 0.2 * f64::from(id));
        let placed = StoredKeyframe {
            rotation_xyzw: quaternion_xyzw(&turn),
            translation_m: [0.3 * f64::from(id), -0.1, 0.5 * f64::from(id)],
            scale: 1.0 + 0.25 * f64::from(id),
            ..keyframe(id)
        };
        store.place_keyframe(&placed).expect("taken");
        let label = PageLabel { page_id: id, first_keyframe_id: id, last_keyframe_id: id, ..PageLabel::default() };
        let mut page = store.begin_page(label).expect("a buffer");
        for _ in 0..ANCHORS_PER_KEYFRAME {
            let anchor = StoredAnchor {
                position_in_keyframe_m: [
                    between(&mut rng, -3.0, 3.0),
                    between(&mut rng, -2.0, 2.0),
                    between(&mut rng, 5.0, 9.0),
                ],
                keyframe_id: id,
                log_extent: std::array::from_fn(|_| between(&mut rng, -1.2, -0.2)),
                level: 0,
                n_gaussians: 2,
                feature_kind: 0,
            };
            let gaussians = [random_gaussian(&mut rng), random_gaussian(&mut rng)];
            let feature = features.next().filter(|_| decoder.is_residual()).unwrap_or(NO_FEATURE);
            page.push_with_feature(&anchor, &feature, &gaussians).expect("room");
        }
        store.commit_page(page).expect("taken");
    }
    let label = ChunkLabel { last_keyframe_id: N_KEYFRAMES - 1, ..ChunkLabel::default() };
    let sky = ChunkBackground { width: BACKGROUND_COLUMNS as u32, texels: &BLACK };
    store.write_chunk(&label, decoder, sky).expect("taken");
    store.finish().expect("written");
}

fn backend(anchors: usize, gaussians_per_anchor: usize, keyframe_rows: usize, learned_decoder: bool) -> CpuBackend {
    let capacities =
        Capacities { keyframe_rows, learned_decoder, ..Capacities::for_map(anchors, gaussians_per_anchor, 96, 64) };
    CpuBackend::new(capacities, 1, SimdLevel::best(), |_| ()).expect("a backend")
}

fn map_from_camera() -> Rigid {
    Rigid::from_parts(Translation3::new(0.1, 0.05, -0.5), UnitQuaternion::from_euler_angles(0.02, 0.03, -0.05))
}

fn picture_of_map(folder: &Path) -> Picture {
    let map = MapStoreReader::open(folder, 10).expect("the store opens");
    let mut picture = Picture::new(CAMERA.width, CAMERA.height);
    let mut backend = backend(100, 2, 9, map.has_learned_decoder());
    let mut viewer = MapViewer::new(&map, &mut backend);
    viewer.render(&map_from_camera(), &CAMERA, 0, &mut picture).expect("drawn");
    assert_eq!((viewer.counts().pages_loaded, viewer.counts().anchors_left_out), (3, 0));
    picture
}

fn picture_of_file(file: &Path) -> Picture {
    let bytes = std::fs::read(file).expect("read");
    let parsed = Parser::<DefaultElement>::new().read_ply(&mut bytes.as_slice()).expect("a PLY file");
    let vertices = &parsed.payload["vertex"];
    let mut backend = backend(vertices.len(), 1, 1, false);
    backend.set_keyframes(0, &[KeyframePlacement::identity()]);
    backend.write_background(0, &BLACK);
    for (slot, vertex) in (0..).zip(vertices) {
        let number = |name: &str| match vertex[name] {
            Property::Float(value) => value,
            ref other => panic!("{other:?}"),
        };
        let logit_of_dc = |name: &str| {
            let channel = number(name) * 0.282_094_8 + 0.5;
            (channel / (1.0 - channel)).ln()
        };
        let header = AnchorHeader {
            position_in_keyframe_m: ["x", "y", "z"].map(number),
            keyframe_row: 0,
            log_extent: [0.0; 3],
            level: 0,
            n_gaussians: 1,
            chunk_row: 0,
        };
        let params = GaussianParams {
            offset: [0.0; 3],
            log_scale: ["scale_0", "scale_1", "scale_2"].map(number),
            quaternion_xyzw: ["rot_1", "rot_2", "rot_3", "rot_0"].map(number),
            opacity_logit: number("opacity"),
            color_logit: ["f_dc_0", "f_dc_1", "f_dc_2"].map(logit_of_dc),
        };
        assert_eq!(backend.write_anchors(&[slot], &[header], &[params]), 0);
    }
    let mut picture = Picture::new(CAMERA.width, CAMERA.height);
    let view = View { camera_from_map: map_from_camera().inverse(), camera: CAMERA, chunk_row: 0 };
    let stats: RenderStats = backend.render(&view, picture.target());
    assert!(!stats.refused && stats.visible > 50, "{stats:?}");
    picture
}

fn largest_difference(a: &Picture, b: &Picture) -> f32 {
    let pairs = a.rgb().as_flattened().iter().zip(b.rgb().as_flattened());
    pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn the_exported_file_drawn_by_itself_is_the_map_s_picture() {
    let scratch = tempfile::tempdir().expect("a scratch folder");
    write_turned_map(scratch.path(), DecoderParams::EXPLICIT);
    let file = scratch.path().join("street.ply");
    let args = ExportArgs {
        map: scratch.path().to_owned(),
        ply: Some(file.clone()),
        spz: None,
        selection: Selection::default(),
    };
    let summary = run(&args, 10).expect("exported");
    assert_eq!(summary.gaussians, u64::from(N_KEYFRAMES) * ANCHORS_PER_KEYFRAME as u64 * 2);

    let (from_map, from_file) = (picture_of_map(scratch.path()), picture_of_file(&file));
    let brightest = from_map.rgb().as_flattened().iter().copied().fold(0.0, f32::max);
    assert!(brightest > 0.3, "the picture shows something: {brightest}");
    let difference = largest_difference(&from_map, &from_file);
    assert!(difference < 2e-3, "largest difference {difference}");
    // The comparison notices a picture from a step aside.
    let mut aside = Picture::new(CAMERA.width, CAMERA.height);
    let map = MapStoreReader::open(scratch.path(), 10).expect("the store opens");
    let mut backend = backend(100, 2, 9, false);
    let moved = Rigid::from_parts(Translation3::from(Vector3::new(0.02, 0.0, 0.0)), Default::default());
    let moved = moved * map_from_camera();
    MapViewer::new(&map, &mut backend).render(&moved, &CAMERA, 0, &mut aside).expect("drawn");
    assert!(largest_difference(&from_map, &aside) > 1e-2);
}

/// A decoder that does not look at where the anchor is seen from: what is exported holds for all views.
fn decoder_of_features_only() -> Vec<f32> {
    let shape = DecoderShape::new(2);
    let mut rng = Rng::new(7, 8, 9);
    let mut weights: Vec<f32> = (0..shape.len()).map(|_| between(&mut rng, -0.2, 0.2)).collect();
    weights[FEATURE_LEN * HIDDEN..shape.hidden_weights().end].fill(0.0);
    weights
}

#[test]
fn what_decoders_add_is_in_the_map_s_picture_and_in_the_file() {
    let scratch = tempfile::tempdir().expect("a scratch folder");
    let [plain, learned] = ["plain", "learned"].map(|name| scratch.path().join(name));
    write_turned_map(&plain, DecoderParams::EXPLICIT);
    write_turned_map(&learned, DecoderParams::residual(&decoder_of_features_only()));
    let file = scratch.path().join("street.ply");
    let args = ExportArgs { map: learned.clone(), ply: Some(file.clone()), spz: None, selection: Selection::default() };
    run(&args, 10).expect("exported");
    let (from_map, from_file) = (picture_of_map(&learned), picture_of_file(&file));
    let difference = largest_difference(&from_map, &from_file);
    assert!(difference < 2e-3, "largest difference {difference}");
    assert!(largest_difference(&from_map, &picture_of_map(&plain)) > 0.05, "the decoder can be seen");
}
