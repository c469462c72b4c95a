//! How anchors and chunks leave for the store: in time, whole, and once.

use super::*;

#[test]
fn a_busy_sink_gets_the_same_pages_later() {
    let pages = |busy_calls: [usize; 2]| {
        let mut sink = MemorySink { busy_calls: busy_calls[0], ..MemorySink::default() };
        let mut mapper = mapper(1, 16_384);
        for ordinal in 0..20 {
            let pixels = picture(STEP_M * f64::from(ordinal));
            mapper.insert_keyframe(&packet(ordinal, &pixels), &mut sink).expect("a usable keyframe");
        }
        sink.busy_calls += busy_calls[1];
        while mapper.finish(&mut sink) == Err(WriteRefusal::Busy) {}
        let counters = mapper.counters();
        assert!(sink.pages.len() == 2 && sink.busy_calls == 0);
        assert_eq!(counters.anchors_stored, counters.anchors_total - counters.anchors_pruned, "nothing is lost");
        sink.pages
    };
    assert!(pages([0, 0]) == pages([0, 3]), "the same pages, later");
    // What stays longer while driving takes the place of what would be inserted: other pages, but all of them.
    pages([3, 0]);
    let mut sink = MemorySink { busy_calls: usize::MAX, ..MemorySink::default() };
    let mut stuck = mapper(1, 16_384);
    let pixels = picture(0.0);
    stuck.insert_keyframe(&packet(0, &pixels), &mut sink).expect("a usable keyframe");
    assert_eq!(stuck.finish(&mut sink), Err(WriteRefusal::Busy));
    assert!(stuck.n_resident_anchors() > 0);
}

#[test]
fn anchors_leave_before_the_row_of_their_keyframe_is_taken() {
    let settings = MapperSettings { page_distance_m: f64::INFINITY, ..MapperSettings::measured(7, 1.0) };
    let capacity = MapperCapacity { keyframe_rows: 16, ..CAPACITY };
    let (mut mapper, mut sink) = (mapper_of(1, capacity, settings), MemorySink::default());
    let insert = |mapper: &mut Mapper, sink: &mut MemorySink, ordinal: u32| {
        let pixels = picture(STEP_M * f64::from(ordinal));
        let inserted = mapper.insert_keyframe(&packet(ordinal, &pixels), sink).map(|report| report.n_anchors > 0);
        let without_row = mapper.pool.iter().find(|(_, record)| mapper.keyframe_row(record.keyframe_ordinal).is_none());
        assert!(without_row.is_none(), "{without_row:?} lost its row to {ordinal}");
        assert!(mapper.table_load().keyframes <= 16);
        inserted
    };
    for ordinal in 0..16 {
        assert!(insert(&mut mapper, &mut sink, ordinal).is_ok() && sink.pages.is_empty());
    }
    sink.busy_calls = 1;
    let refused = Err(PacketRefused::RowInUse { frame_index: 16 * 16 });
    let pixels = picture(STEP_M * 16.0);
    assert_eq!(mapper.insert_keyframe(&packet(16, &pixels), &mut sink).map(|_| ()), refused);
    assert_eq!(mapper.counters().keyframes, 16, "nothing was added");
    for ordinal in [16, 17, 40] {
        assert_eq!(insert(&mut mapper, &mut sink, ordinal), Ok(true));
    }
    assert_eq!(mapper.finish(&mut sink), Ok(()));
    assert_eq!(mapper.n_resident_anchors(), 0);
}

#[test]
fn a_chunk_that_nobody_took_is_never_overwritten() {
    let (mut mapper, mut sink) = (mapper(1, 16_384), MemorySink::default());
    let pixels = picture(0.0);
    let mut inserted = |sink: &mut MemorySink, chunk: u32| {
        sink.busy_chunks = chunk == 2;
        mapper.insert_keyframe(&packet(chunk * CHUNK_KEYFRAMES, &pixels), sink).is_ok()
    };
    assert_eq!([0, 1, 2, 3, 4].map(|chunk| inserted(&mut sink, chunk)), [true, true, true, true, true]);
    assert_eq!(mapper.finish(&mut sink), Ok(()));
    let ids: Vec<u32> = sink.chunks.iter().map(|chunk| chunk.0.chunk_id).collect();
    assert_eq!(ids, [0, 1, 2, 3, 4]);
}

#[test]
fn a_page_buffer_that_holds_no_chunk_ends_the_run_and_the_smallest_of_a_budget_holds_one() {
    let smallest = Budget::parse(
        &PROFILES[0].1.replace("[store.page_anchors]\ncapacity = 4096", "[store.page_anchors]\ncapacity = 16"),
        "smallest.toml",
    );
    let smallest = smallest.expect("a possible budget").store_capacity();
    for (page_bytes, fits) in [(40_000, false), (smallest.page_bytes, true)] {
        let scratch = tempfile::tempdir().expect("a scratch folder");
        let capacity = StoreCapacity { page_bytes, ..smallest };
        let store = MapStoreWriter::create(
            &scratch.path().join("map"),
            &MANIFEST,
            &StoreSettings { capacity, jpeg_quality: 90, when_busy: WhenBusy::Wait },
        );
        let store = store.expect("a new store");
        let (mut mapper, pixels) = (mapper_with(1, 16_384, true), picture(0.0));
        mapper.insert_keyframe(&packet(0, &pixels), &mut &store).expect("a usable keyframe");
        let finished = mapper.finish_into(&store);
        assert_eq!(finished.is_ok(), fits, "{page_bytes} bytes: {finished:?}");
        assert!(fits || finished.unwrap_err().to_string().contains("store.page_anchors"));
    }
}

/// Makes the Gaussians of an anchor so wide and opaque.
fn widen(mapper: &mut Mapper, slot: u32, sigma_m: f32) {
    let (mut header, mut params) = ([NO_HEADER], [NO_GAUSSIAN; CAPACITY.gaussians_per_anchor]);
    assert_eq!(mapper.backend.read_anchors(&[slot], &mut header, &mut params), 0);
    for gaussian in &mut params[..usize::from(header[0].n_gaussians)] {
        gaussian.offset = [0.0; 3];
        gaussian.log_scale = header[0].log_extent.map(|log_extent_m| sigma_m.ln() - log_extent_m);
        gaussian.opacity_logit = 2.0;
    }
    assert_eq!(mapper.backend.write_anchors(&[slot], &header, &params), 0);
}

/// The first anchor of a keyframe between so many metres down the street, in the camera's path.
fn ahead(mapper: &Mapper, ordinal: u32, z_m: std::ops::Range<f64>) -> u32 {
    let is_ahead = |[x_m, y_m, at_m]: [f64; 3]| z_m.contains(&at_m) && x_m.abs() < 3.0 && y_m.abs() < 2.0;
    let mut anchors = mapper.pool.iter().filter(|(_, record)| record.keyframe_ordinal == ordinal);
    let found = anchors.find(|(_, record)| record.voxel.level() == 0 && is_ahead(record.voxel.center_in_map_m()));
    found.unwrap_or_else(|| panic!("keyframe {ordinal} sees nothing at {z_m:?}")).0.slot
}

#[test]
fn what_fills_the_view_of_who_comes_near_ends_and_what_is_finished_stays() {
    for (next, ends) in [(1, true), (3 * CHUNK_KEYFRAMES, false)] {
        let (mut mapper, pixels) = (mapper(1, 16_384), picture(0.0));
        mapper.insert_keyframe(&packet(0, &pixels), &mut MemorySink::default()).expect("a usable keyframe");
        let pixels = picture(STEP_M);
        mapper.insert_keyframe(&packet(1, &pixels), &mut MemorySink::default()).expect("a usable keyframe");
        // From keyframe 0 they are slim enough: 1 m at more than 9 m, and 0.13 of the depth is half the picture.
        let [near, far] = [ahead(&mapper, 0, 9.0..11.0), ahead(&mapper, 0, 15.0..19.0)];
        for slot in [near, far] {
            widen(&mut mapper, slot, 1.0);
        }
        let next =
            KeyframePacket { world_from_camera: Rigid::translation(0.0, 0.0, STEP_M), ..packet(next.max(2), &pixels) };
        mapper.insert_keyframe(&next, &mut MemorySink::default()).expect("a usable keyframe");
        // A slot that is free may be taken again.
        let lives = |slot: u32| mapper.ordinal_in(slot) == Some(0);
        assert_eq!((lives(near), lives(far)), (!ends, true), "keyframe {}", next.ordinal);
    }
}
