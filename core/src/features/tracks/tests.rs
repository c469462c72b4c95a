use super::*;
use crate::features::testing::{Scene, distance, pyramid_of};
use std::vec;
use std::vec::Vec;

const SETTINGS: TrackSettings =
    TrackSettings { corners: CornerSettings { cell_px: 150.0, ..CornerSettings::STANDARD }, ..TrackSettings::STANDARD };

struct Memory {
    tracks: Vec<Track>,
    at_keyframe: Vec<Track>,
    flows: Vec<Flow>,
    corners: Vec<Corner>,
    distances_px: Vec<f32>,
}

impl Memory {
    fn new(capacity: usize) -> Self {
        Self {
            tracks: vec![Track::NONE; capacity],
            at_keyframe: vec![Track::NONE; capacity],
            flows: vec![Flow::new([0.0; 2], [0.0; 2]); capacity],
            corners: vec![Corner::NONE; capacity],
            distances_px: vec![0.0; capacity],
        }
    }

    fn table(&mut self) -> TrackTable<'_> {
        TrackTable::new(TrackStorage {
            tracks: &mut self.tracks,
            at_keyframe: &mut self.at_keyframe,
            flows: &mut self.flows,
            corners: &mut self.corners,
            distances_px: &mut self.distances_px,
        })
        .expect("equal lengths")
    }
}

/// Runs the table over a scene that moves by `step_px` per frame, promoting the frames named in `keyframes`.
fn run(
    scene: &Scene,
    table: &mut TrackTable<'_>,
    step_px: [f32; 2],
    n_frames: usize,
    keyframes: &[usize],
) -> Vec<TrackReport> {
    let at = |i: usize| step_px.map(|c| c * i as f32);
    let mut storage = vec![Vec::new(); n_frames];
    let images: Vec<Pyramid<'_>> =
        storage.iter_mut().enumerate().map(|(i, bytes)| pyramid_of(scene, at(i), bytes)).collect();
    let mut keyframe = 0;
    table.promote(SimdLevel::new(), &images[0], &SETTINGS);
    (1..n_frames)
        .map(|i| {
            let step = TrackImages { keyframe: &images[keyframe], previous: &images[i - 1], current: &images[i] };
            let report = table.advance(SimdLevel::new(), step, &SETTINGS);
            if keyframes.contains(&i) {
                table.promote(SimdLevel::new(), &images[i], &SETTINGS);
                keyframe = i;
            }
            report
        })
        .collect()
}

#[test]
fn tracks_follow_the_scene_and_the_counts_add_up() {
    let scene = Scene::textured(260, 200);
    let mut memory = Memory::new(200);
    let mut table = memory.table();
    let step_px = [2.3, -1.1];
    let reports = run(&scene, &mut table, step_px, 6, &[]);
    for (i, report) in reports.iter().enumerate() {
        let dropped = report.n_left_image + report.n_flat + report.n_different + report.n_inconsistent;
        assert_eq!(report.n_before, report.n_live + dropped, "{report:?}");
        let expected_px = (i + 1) as f32 * distance(step_px, [0.0; 2]);
        assert!((report.median_flow_px - expected_px).abs() < 0.02, "{report:?} {expected_px}");
    }
    assert!(table.tracks().len() >= 40, "{}", table.tracks().len());
    for track in table.tracks() {
        let expected_px = [track.keyframe_px[0] + 5.0 * step_px[0], track.keyframe_px[1] + 5.0 * step_px[1]];
        assert!(distance(track.current_px, expected_px) < 0.06, "{track:?}");
        let last = [track.current_px[0] - track.previous_px[0], track.current_px[1] - track.previous_px[1]];
        assert!(distance(last, step_px) < 0.08 && track.age_frames == 5, "{track:?}");
    }
}

#[test]
fn a_keyframe_anchors_tracks_tops_up_and_remembers_where_they_were() {
    let scene = Scene::textured(260, 200);
    let mut memory = Memory::new(200);
    let mut table = memory.table();
    let step_px = [6.0, 0.0];
    run(&scene, &mut table, step_px, 7, &[3, 6]);
    assert_eq!((table.frames_since_keyframe(), table.n_at_keyframe()), (0, table.tracks().len()));
    let ids: Vec<u64> = table.tracks().iter().map(|track| track.id).collect();
    assert!(ids.windows(2).all(|pair| pair[0] < pair[1]), "{ids:?}");
    let of_age = |n: u32| table.tracks().iter().filter(move |track| track.n_keyframes == n);
    assert!(of_age(3).count() > 20 && of_age(1).count() > 3, "{} {}", of_age(3).count(), of_age(1).count());
    for track in of_age(3) {
        assert_eq!(track.in_keyframe_px(0), Some(track.current_px));
        for back in 1..3 {
            let then_px = track.in_keyframe_px(back).expect("seen in three keyframes");
            let moved = [track.current_px[0] - then_px[0], track.current_px[1] - then_px[1]];
            assert!(distance(moved, [18.0 * back as f32, 0.0]) < 0.08, "{moved:?}");
        }
        assert_eq!(track.in_keyframe_px(3), None);
    }
    for track in of_age(1) {
        assert_eq!((track.in_keyframe_px(0), track.in_keyframe_px(1)), (Some(track.keyframe_px), None));
    }
}

#[test]
fn history_forgets_the_oldest_keyframe() {
    let scene = Scene::textured(120, 100);
    let mut memory = Memory::new(9);
    let mut table = memory.table();
    let keyframes: Vec<usize> = (1..=HISTORY_KEYFRAMES).collect();
    run(&scene, &mut table, [0.5, 0.0], HISTORY_KEYFRAMES + 1, &keyframes);
    let track = table.tracks()[0];
    assert_eq!(track.n_keyframes as usize, HISTORY_KEYFRAMES + 1);
    assert!(track.in_keyframe_px(HISTORY_KEYFRAMES - 1).is_some());
    assert_eq!(track.in_keyframe_px(HISTORY_KEYFRAMES), None);
}

#[test]
fn capacities_down_to_nothing_are_held() {
    let scene = Scene::textured(200, 160);
    for capacity in [0, 1, 3] {
        let mut memory = Memory::new(capacity);
        let mut table = memory.table();
        let reports = run(&scene, &mut table, [1.0, 0.0], 4, &[2]);
        assert_eq!(table.tracks().len(), capacity);
        assert_eq!(reports[2].n_live, capacity);
    }
    let mut memory = Memory::new(3);
    memory.flows.pop();
    let storage = TrackStorage {
        tracks: &mut memory.tracks,
        at_keyframe: &mut memory.at_keyframe,
        flows: &mut memory.flows,
        corners: &mut memory.corners,
        distances_px: &mut memory.distances_px,
    };
    assert_eq!(TrackTable::new(storage).map(|_| ()), Err(UnequalStorage { shortest: 2, longest: 3 }));
}

#[test]
fn a_covered_part_loses_its_tracks_only() {
    let scene = Scene::textured(260, 200);
    let covered = Scene { cover: Some([0, 0, 130, 200]), ..scene };
    let (mut a, mut b) = (Vec::new(), Vec::new());
    let first = pyramid_of(&scene, [0.0, 0.0], &mut a);
    let second = pyramid_of(&covered, [0.0, 0.0], &mut b);
    let mut memory = Memory::new(200);
    let mut table = memory.table();
    table.promote(SimdLevel::new(), &first, &SETTINGS);
    let n_right = table.tracks().iter().filter(|track| track.keyframe_px[0] > 145.0).count();
    let images = TrackImages { keyframe: &first, previous: &first, current: &second };
    table.advance(SimdLevel::new(), images, &SETTINGS);
    let (left, right): (Vec<&Track>, Vec<&Track>) = table
        .tracks()
        .iter()
        .filter(|t| (t.keyframe_px[0] - 130.0).abs() > 15.0)
        .partition(|t| t.keyframe_px[0] < 130.0);
    assert_eq!((left.len(), right.len()), (0, n_right));
}

#[test]
fn tracks_judged_elsewhere_can_be_dropped() {
    let scene = Scene::textured(200, 160);
    let mut memory = Memory::new(50);
    let mut table = memory.table();
    run(&scene, &mut table, [1.0, 0.0], 2, &[]);
    let expected: Vec<Track> = table.tracks().iter().filter(|track| track.id % 3 != 0).copied().collect();
    table.retain(|track| track.id % 3 != 0);
    assert_eq!(table.tracks(), expected);
    table.clear();
    assert_eq!(table.tracks(), []);
}

#[test]
fn a_track_is_expected_to_go_on_and_a_new_one_to_follow_its_neighbor() {
    let track = |x: f32, age_frames: u32, step_x: f32| Track {
        age_frames,
        previous_px: [x - step_x, 50.0],
        current_px: [x, 50.0],
        ..Track::NONE
    };
    let tracks = [track(10.0, 3, 5.0), track(90.0, 1, -2.0), track(60.0, 0, 0.0), track(30.0, 0, 0.0)];
    let expected: Vec<[f32; 2]> = tracks.iter().map(|track| expected_step_px(track, &tracks)).collect();
    assert_eq!(expected, [[5.0, 0.0], [-2.0, 0.0], [-2.0, 0.0], [5.0, 0.0]]);
    assert_eq!(expected_step_px(&tracks[2], &tracks[2..]), [0.0, 0.0], "nobody has moved yet");
}
