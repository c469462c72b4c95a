//! A short drive along a street of painted planes, mapped with tiny capacities.

use super::*;
use crate::budget::{Budget, PROFILES};
use crate::map_store::{MapStoreWriter, PageDraft, StoreCapacity, StoreSettings, WhenBusy, WriteRefusal};
use crate::seal;
use crate::splat::cpu::{CpuBackend, SimdLevel};
use crate::splat::device::DeviceBackend;
use crate::splat::vulkan::{VulkanExecutor, testing};
use crate::splat::{Capacities, DecoderShape, SplatBackend};
use kilogs_core::camera::Pinhole;
use kilogs_core::conventions::Rigid;
use kilogs_core::frame::PixelFormat;
use kilogs_core::map::decoder::NO_FEATURE;
use kilogs_core::store::{ChunkBackground, ChunkLabel, DecoderParams, Manifest, PageEncoder, PageLabel, decode_page};
use kilogs_core::tracking::RoadPlane;

const CAMERA: Pinhole = Pinhole { width: 96, height: 48, fx: 60.0, fy: 60.0, cx: 48.0, cy: 20.0 };
const ROAD: RoadPlane = RoadPlane { normal_in_camera: [0.0, 1.0, 0.0], height_m: 1.65 };
const STEP_M: f64 = 4.0;
const MANIFEST: Manifest = Manifest {
    camera: CAMERA,
    mounting: None,
    pixel_format: PixelFormat::Mono8,
    voxel_m: [0.1, 0.25, 1.0, 5.0, 25.0, 0.0, 0.0, 0.0],
    n_levels: 5,
    gaussians_per_anchor: 2,
    counts: None,
};

const CAPACITY: MapperCapacity = MapperCapacity {
    anchors: 16_384,
    gaussians_per_anchor: 2,
    voxels: 32_768,
    images: 8,
    depths: 6,
    new_anchors: 600,
    keyframe_rows: 64,
    chunk_rows: 2,
    pages: 64,
    alignment_steps: 64,
    returning_files: 3,
};

/// Takes pages into memory; while `busy_calls` lasts it refuses.
#[derive(Default)]
struct MemorySink {
    pages: Vec<Vec<u8>>,
    chunks: Vec<(ChunkLabel, Vec<[f32; 3]>)>,
    decoders: Vec<Vec<u8>>,
    busy_calls: usize,
    busy_chunks: bool,
}

impl PageSink for MemorySink {
    fn begin_page(&mut self, label: PageLabel) -> Result<PageDraft, WriteRefusal> {
        if self.busy_calls > 0 {
            self.busy_calls -= 1;
            return Err(WriteRefusal::Busy);
        }
        Ok(PageEncoder::new(vec![0; 1 << 20].into_boxed_slice(), label)?)
    }

    fn commit_page(&mut self, draft: PageDraft) -> Result<(), WriteRefusal> {
        let (bytes, len) = draft.finish()?;
        self.pages.push(bytes[..len].to_vec());
        Ok(())
    }

    fn write_chunk(
        &mut self,
        label: ChunkLabel,
        decoder: DecoderParams<'_>,
        background: ChunkBackground<'_>,
    ) -> Result<(), WriteRefusal> {
        if self.busy_chunks {
            return Err(WriteRefusal::Busy);
        }
        self.chunks.push((label, background.texels.to_vec()));
        self.decoders.push(decoder.bytes.to_vec());
        Ok(())
    }
}

/// What a camera `z_m` down the street sees: a striped road, painted walls 6 m to either side, a plain sky.
fn picture(z_m: f64) -> Vec<u8> {
    let stripes = |x: f64, y: f64| (x * 2.1).sin() * (y * 1.7).cos() * 60.0 + (x * 0.6 + y * 0.4).sin() * 40.0;
    (0..CAMERA.width * CAMERA.height)
        .map(|i| {
            let ray_x = (f64::from(i % CAMERA.width) + 0.5 - CAMERA.cx) / CAMERA.fx;
            let ray_y = (f64::from(i / CAMERA.width) + 0.5 - CAMERA.cy) / CAMERA.fy;
            let road_m = if ray_y > 0.0 { ROAD.height_m / ray_y } else { f64::INFINITY };
            let wall_m = 6.0 / ray_x.abs();
            let value = if road_m < wall_m {
                110.0 + stripes(ray_x * road_m, road_m + z_m)
            } else if ray_y * wall_m > -5.0 {
                100.0 + stripes(ray_y * wall_m * 2.0, wall_m + z_m + ray_x.signum())
            } else {
                230.0
            };
            value.clamp(0.0, 255.0) as u8
        })
        .collect()
}

fn packet<'a>(ordinal: u32, pixels: &'a [u8]) -> KeyframePacket<'a> {
    KeyframePacket {
        ordinal,
        frame_index: 16 * u64::from(ordinal),
        timestamp_ns: 0,
        world_from_camera: Rigid::translation(0.0, 0.0, STEP_M * f64::from(ordinal)),
        image: MappingImage { pixels, stride_bytes: CAMERA.width as usize, format: PixelFormat::Mono8 },
        points: &[],
        road: Some(ROAD),
    }
}

fn mapper(threads: usize, anchors: usize) -> Mapper {
    mapper_with(threads, anchors, false)
}

fn mapper_with(threads: usize, anchors: usize, learned_decoder: bool) -> Mapper {
    mapper_of(threads, MapperCapacity { anchors, voxels: 2 * anchors, ..CAPACITY }, settings(learned_decoder))
}

fn settings(learned_decoder: bool) -> MapperSettings {
    MapperSettings { page_distance_m: 30.0, learned_decoder, ..MapperSettings::measured(7, 1.0) }
}

fn mapper_of(threads: usize, capacity: MapperCapacity, settings: MapperSettings) -> Mapper {
    mapper_on(capacity, settings, |capacities| {
        Box::new(CpuBackend::new(capacities, threads, SimdLevel::best(), |_| ()).expect("a possible backend"))
    })
}

fn mapper_on(
    capacity: MapperCapacity,
    settings: MapperSettings,
    backend: impl FnOnce(Capacities) -> Box<dyn SplatBackend>,
) -> Mapper {
    let capacities = Capacities {
        keyframe_rows: capacity.keyframe_rows,
        chunk_rows: capacity.chunk_rows,
        exposure_slots: capacity.images,
        learned_decoder: settings.learned_decoder,
        ..Capacities::for_map(capacity.anchors, 2, CAMERA.width, CAMERA.height)
    };
    Mapper::new(settings, capacity, &CAMERA, 1, backend(capacities))
}

/// Drives `n_keyframes` and hands over everything.
fn drive(mapper: &mut Mapper, n_keyframes: u32, sink: &mut MemorySink) -> Vec<(InsertReport, OptimizeReport)> {
    let reports = (0..n_keyframes)
        .map(|ordinal| {
            let pixels = picture(STEP_M * f64::from(ordinal));
            let inserted = mapper.insert_keyframe(&packet(ordinal, &pixels), sink).expect("a usable keyframe");
            (inserted, mapper.optimize(4))
        })
        .collect();
    assert_eq!(mapper.finish(sink), Ok(()));
    reports
}

#[test]
fn a_street_is_inserted_trained_and_handed_over_completely() {
    let (mut mapper, mut sink) = (mapper(1, 16_384), MemorySink::default());
    let reports = drive(&mut mapper, 24, &mut sink);
    let (first, last) = (&reports[1].1, &reports[23].1);
    assert!(last.mean_psnr_db > 15.0 && last.mean_psnr_db > first.mean_psnr_db + 1.0, "{first:?} then {last:?}");
    assert!(reports[23].0.n_gaussians < reports[1].0.n_gaussians, "a known street asks for less");
    let counters = mapper.counters();
    let labels: Vec<PageLabel> = sink.pages.iter().map(|page| decode_page(page).expect("a whole page").0).collect();
    let n_stored: u64 = labels.iter().map(|label| u64::from(label.n_anchors)).sum();
    assert_eq!(n_stored, counters.anchors_total - counters.anchors_pruned);
    assert_eq!((counters.anchors_stored, mapper.n_resident_anchors()), (n_stored, 0));
    assert!(labels.iter().all(|label| label.n_anchors > 0));
    assert!(labels.is_sorted_by(|a, b| a.page_id < b.page_id), "every page has an id of its own");
    assert_eq!(labels.last().map(|label| label.last_keyframe_id), Some(29));
    assert_eq!(sink.chunks.len(), 1);
    let horizon_and_up = &sink.chunks[0].1[sink.chunks[0].1.len() / 2..];
    let brightness = horizon_and_up.iter().map(|c| c[0]).sum::<f32>() / horizon_and_up.len() as f32;
    assert!(brightness > 0.75, "the sky is bright, not {brightness}");
}

#[test]
fn the_map_does_not_depend_on_the_number_of_threads() {
    let pages = |threads| {
        let mut sink = MemorySink::default();
        drive(&mut mapper(threads, 16_384), 6, &mut sink);
        (sink.pages, sink.chunks.into_iter().map(|chunk| chunk.1).collect::<Vec<_>>())
    };
    assert!(pages(1) == pages(2), "same input, same bytes");
}

/// Drives with a learned decoder and checks that it and the features were learned and handed over.
fn check_learned(mut mapper: Mapper) -> MemorySink {
    let mut sink = MemorySink::default();
    let reports = drive(&mut mapper, 12, &mut sink);
    let (first, last) = (&reports[1].1, &reports[11].1);
    assert!(last.mean_psnr_db > 15.0 && last.mean_psnr_db > first.mean_psnr_db, "{first:?} then {last:?}");
    let mut weights = vec![0.0; DecoderShape::new(2).len()];
    assert_eq!(sink.decoders.len(), 1);
    assert!(DecoderParams { kind: DecoderParams::RESIDUAL_KIND, bytes: &sink.decoders[0] }.read_residual(&mut weights));
    assert!(weights[DecoderShape::new(2).output_weights()].iter().any(|weight| *weight != 0.0), "it learned");
    let (mut n_anchors, mut n_features) = (0, 0);
    for page in &sink.pages {
        let (_, mut reader) = decode_page(page).expect("a whole page");
        while let Some((_, feature)) = reader.next_with_feature(&mut []) {
            n_anchors += 1;
            n_features += u32::from(feature != NO_FEATURE);
        }
    }
    assert!(n_features > n_anchors / 2, "{n_features} of {n_anchors} anchors learned a feature");
    sink
}

#[test]
fn a_learned_decoder_leaves_with_its_chunk_and_features_with_their_pages() {
    let [once, again] = [1, 2].map(|threads| check_learned(mapper_with(threads, 16_384, true)));
    assert!(once.pages == again.pages && once.decoders == again.decoders, "same input, same bytes");
}

#[test]
fn so_they_do_on_a_device() {
    let Some(device) = testing::device() else { return };
    check_learned(mapper_on(CAPACITY, settings(true), |capacities| {
        let executor = VulkanExecutor::new(&device, &capacities, 1 << 30).unwrap_or_else(|e| panic!("{e}"));
        Box::new(DeviceBackend::new(capacities, executor).unwrap_or_else(|e| panic!("{e}")))
    }));
}

#[test]
fn a_new_chunk_begins_with_the_decoder_of_the_one_before_which_is_frozen() {
    let (mut mapper, mut sink) = (mapper_with(1, 16_384, true), MemorySink::default());
    let mut fresh = [vec![0.0; DecoderShape::new(2).len()], vec![0.0; DecoderShape::new(2).len()]];
    let train = |mapper: &mut Mapper, sink: &mut MemorySink, ordinal: u32| {
        let pixels = picture(STEP_M * f64::from(ordinal));
        mapper.insert_keyframe(&packet(ordinal, &pixels), sink).expect("a usable keyframe");
        mapper.optimize(6);
    };
    (CHUNK_KEYFRAMES - 3..CHUNK_KEYFRAMES).for_each(|ordinal| train(&mut mapper, &mut sink, ordinal));
    assert!(mapper.backend.read_decoder(0, &mut fresh[0]) && fresh[0].iter().any(|weight| *weight != 0.0));
    let pixels = picture(STEP_M * f64::from(CHUNK_KEYFRAMES));
    mapper.insert_keyframe(&packet(CHUNK_KEYFRAMES, &pixels), &mut sink).expect("a usable keyframe");
    assert!(
        mapper.backend.read_decoder(1, &mut fresh[1]) && fresh[1] == fresh[0],
        "it begins where the last one ended"
    );
    mapper.optimize(6);
    let mut after = fresh.clone();
    assert!(mapper.backend.read_decoder(0, &mut after[0]) && after[0] == fresh[0], "a closed chunk is frozen");
    assert!(mapper.backend.read_decoder(1, &mut after[1]) && after[1] != fresh[1], "the new one learns");
}

#[test]
fn a_shared_decoder_goes_on_learning_for_the_chunks_before_too() {
    let settings = MapperSettings { shared_decoder: true, ..settings(true) };
    let (mut mapper, mut sink) = (mapper_of(1, CAPACITY, settings), MemorySink::default());
    let mut decoders = [vec![0.0; DecoderShape::new(2).len()], vec![0.0; DecoderShape::new(2).len()]];
    let mut before = Vec::new();
    for ordinal in CHUNK_KEYFRAMES - 3..CHUNK_KEYFRAMES + 2 {
        before.clone_from(&decoders[0]);
        let pixels = picture(STEP_M * f64::from(ordinal));
        mapper.insert_keyframe(&packet(ordinal, &pixels), &mut sink).expect("a usable keyframe");
        mapper.optimize(6);
        assert!(mapper.backend.read_decoder(0, &mut decoders[0]) && decoders[0] != before, "{ordinal}");
    }
    assert!(mapper.backend.read_decoder(1, &mut decoders[1]) && decoders[0] == decoders[1]);
}

#[path = "loss_term_tests.rs"]
mod loss_terms;

#[path = "leaving_tests.rs"]
mod leaving;

#[path = "returning_tests.rs"]
mod returning;

#[path = "realigning_tests.rs"]
mod realigning;

#[path = "sky_tests.rs"]
mod sky;

#[test]
fn a_full_pool_refuses_and_says_how_often() {
    let (mut mapper, mut sink) = (mapper(1, 64), MemorySink::default());
    let reports = drive(&mut mapper, 3, &mut sink);
    assert!(reports.iter().any(|(inserted, _)| inserted.refused.anchors > 0));
    assert_eq!(mapper.counters().anchors_resident_peak, 64);
    let refused = mapper.counters().refused;
    assert_eq!((refused.anchors, refused.new_anchors, refused.voxels), (refused.total(), 0, 0));
}

#[test]
fn lists_that_are_full_in_a_step_or_in_a_comparison_are_told() {
    let (mut mapper, mut sink) = (mapper_of(1, CAPACITY, MapperSettings::measured(7, 1.0)), MemorySink::default());
    let tight = Capacities {
        keyframe_rows: CAPACITY.keyframe_rows,
        chunk_rows: CAPACITY.chunk_rows,
        visible_gaussians: 64,
        row_entries: 64,
        pairs: 64,
        ..Capacities::for_map(CAPACITY.anchors, 2, CAMERA.width, CAMERA.height)
    };
    mapper.backend = Box::new(CpuBackend::new(tight, 1, SimdLevel::best(), |_| ()).expect("a possible backend"));
    let mut told = |mapper: &mut Mapper, ordinal: u32, n_steps: u32| {
        let pixels = picture(STEP_M * f64::from(ordinal));
        mapper.insert_keyframe(&packet(ordinal, &pixels), &mut sink).expect("a usable keyframe");
        let compared = mapper.take_list_load();
        mapper.optimize(n_steps);
        (compared, mapper.take_list_load())
    };
    told(&mut mapper, 0, 0);
    told(&mut mapper, 1, 0);
    let (compared, trained) = told(&mut mapper, 2, 3);
    assert_eq!((compared.n_views, trained.n_views), (1, 3));
    for load in [compared, trained] {
        assert!(load.visible.peak > 0 && load.visible.n_refused > 0, "{load:?}");
    }
    assert_eq!(mapper.take_list_load(), ListLoad::default());
}

#[test]
fn a_keyframe_that_is_visited_again_is_pruned_whole_and_draws_new_numbers() {
    let samples_of = |visit: u32| {
        let capacity = MapperCapacity { new_anchors: 100, ..CAPACITY };
        let (mut mapper, mut sink) = (mapper_of(1, capacity, MapperSettings::measured(7, 1.0)), MemorySink::default());
        let pictures = [picture(0.0), picture(STEP_M)];
        for ordinal in [0, 1] {
            let packet = packet(ordinal, &pictures[ordinal as usize]);
            mapper.insert_keyframe(&packet, &mut sink).expect("a usable keyframe");
        }
        mapper.look_again(&packet(0, &pictures[0])).expect("a usable keyframe");
        mapper.revisit(&packet(1, &pictures[1]), (1, visit)).expect("a usable keyframe");
        let n_of_keyframe = mapper.pool.iter().filter(|(_, record)| record.keyframe_ordinal == 1).count();
        assert!(n_of_keyframe > capacity.new_anchors, "{n_of_keyframe}");
        mapper.settings.min_opacity = 0.999;
        mapper.prune_keyframe(1);
        assert!(mapper.pool.iter().all(|(_, record)| record.keyframe_ordinal != 1), "not one is overlooked");
        mapper.scratch.samples.clone()
    };
    assert_eq!(samples_of(1), samples_of(1));
    assert_ne!(samples_of(1), samples_of(2));
}

#[test]
fn held_out_frames_and_odd_images_are_refused_without_a_trace() {
    let (mut mapper, mut sink, pixels) = (mapper(1, 64), MemorySink::default(), picture(0.0));
    let held_out = KeyframePacket { frame_index: 15, ..packet(0, &pixels) };
    assert_eq!(mapper.insert_keyframe(&held_out, &mut sink), Err(PacketRefused::HeldOut { frame_index: 15 }));
    let truncated = packet(1, &pixels[1..]);
    let refused = Err(PacketRefused::ImageDoesNotFit { frame_index: 16 });
    assert_eq!(mapper.insert_keyframe(&truncated, &mut sink), refused);
    assert_eq!((mapper.counters(), mapper.optimize(3)), (MapCounters::default(), OptimizeReport::default()));
}

#[test]
fn after_construction_nothing_is_allocated() {
    let (mut mapper, mut sink) = (mapper_with(1, 16_384, true), MemorySink::default());
    let pictures: Vec<Vec<u8>> = (0..3).map(|ordinal| picture(STEP_M * f64::from(ordinal))).collect();
    let sealed = seal::enter();
    for (pixels, ordinal) in pictures.iter().zip(0..) {
        let inserted = mapper.insert_keyframe(&packet(ordinal, pixels), &mut sink);
        assert!(inserted.is_ok_and(|report| report.n_gaussians > 0));
        mapper.optimize(3);
    }
    assert_eq!(sealed.violations(), (0, 0));
}
