//! How the map in memory follows what loops say.

use super::*;
use crate::map_store::Alignment;
use crate::splat::LearningRates;
use kilogs_core::conventions::Similarity;
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use std::collections::BTreeMap;
use std::ops::Range;

const N_KEYFRAMES: u32 = 6;

/// A correction as a loop makes it.
fn correction() -> Similarity {
    let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.002, 0.02, -0.001));
    Similarity::from_isometry(Rigid::from_parts(Translation3::new(1.3, -0.1, -2.2), turn), 0.97)
}

fn moved_rigidly(pose: &Rigid) -> Rigid {
    (correction() * Similarity::from_isometry(*pose, 1.0)).isometry
}

/// A mapper that has driven a few keyframes.
fn driven() -> Mapper {
    let (mut mapper, mut sink) = (mapper(1, 16_384), MemorySink::default());
    for ordinal in 0..N_KEYFRAMES {
        let pixels = picture(STEP_M * f64::from(ordinal));
        mapper.insert_keyframe(&packet(ordinal, &pixels), &mut sink).expect("a usable keyframe");
        mapper.optimize(4);
    }
    mapper
}

/// Keyframe `ordinal`, `place` steps down the street, which odometry puts aside.
fn look(mapper: &mut Mapper, ordinal: u32, place: u32, aside: &Rigid) -> InsertReport {
    let z_m = STEP_M * f64::from(place);
    let pixels = picture(z_m);
    let world_from_camera = aside * Rigid::translation(0.0, 0.0, z_m);
    let seen = KeyframePacket { world_from_camera, ..packet(ordinal, &pixels) };
    mapper.insert_keyframe(&seen, &mut MemorySink::default()).expect("a usable keyframe")
}

/// A mapper that has driven a street twice, the second time beside it, with keyframes from `again_from` on that begin
/// `first_place` steps down the street.
fn driven_again(again_from: u32, first_place: u32, aside: &Rigid) -> Mapper {
    let mut mapper = mapper(1, 16_384);
    for nth in 0..N_KEYFRAMES {
        look(&mut mapper, nth, nth, &Rigid::identity());
        mapper.optimize(2);
    }
    for nth in 0..N_KEYFRAMES {
        look(&mut mapper, again_from + nth, first_place + nth, aside);
        mapper.optimize(2);
    }
    mapper
}

/// A loop that puts the keyframes from `again_from` on back to where they are.
fn back(again_from: u32, aside: &Rigid) -> Alignment {
    let mut alignment = Alignment::default();
    alignment.push(again_from, Similarity::from_isometry(aside.inverse(), 1.0));
    alignment
}

/// A correction of everything from a keyframe on.
fn from(first_keyframe_id: u32) -> Alignment {
    let mut alignment = Alignment::default();
    alignment.push(first_keyframe_id, correction());
    alignment
}

/// PSNR of the keyframes where they stand, before any of them is trained.
fn psnr_db(mapper: &mut Mapper) -> f32 {
    let step = mapper.settings.step;
    mapper.settings.step.rates = LearningRates::FROZEN;
    let report = mapper.optimize(12);
    mapper.settings.step = step;
    report.mean_psnr_db
}

#[test]
fn a_map_that_moves_as_a_whole_looks_the_same_and_goes_on_where_it_was() {
    let [mut still, mut moved] = [driven(), driven()];
    moved.realign(&from(0));
    assert_eq!(moved.n_resident_anchors(), still.n_resident_anchors(), "neighbors never end each other");
    let [before_db, after_db] = [&mut still, &mut moved].map(psnr_db);
    // The sky does not turn with the map.
    assert!((before_db - after_db).abs() < 0.25, "{before_db} dB became {after_db} dB");
    let newest = moved.images.newest(0).expect("a keyframe").keyframe.world_from_camera;
    let expected = moved_rigidly(&packet(N_KEYFRAMES - 1, &[]).world_from_camera);
    assert!((newest.to_homogeneous() - expected.to_homogeneous()).norm() < 1e-9, "{newest}");
    // The next keyframe finds the street where it is by now, and asks for as little as if nothing had moved.
    let pixels = picture(STEP_M * f64::from(N_KEYFRAMES));
    let next = packet(N_KEYFRAMES, &pixels);
    let next_moved = KeyframePacket { world_from_camera: moved_rigidly(&next.world_from_camera), ..next };
    let sink = &mut MemorySink::default();
    let [n_still, n_moved] = [(&mut still, &next), (&mut moved, &next_moved)]
        .map(|(mapper, packet)| mapper.insert_keyframe(packet, sink).expect("a usable keyframe").n_anchors);
    assert!(n_moved.abs_diff(n_still) < n_still / 4, "{n_still} new anchors became {n_moved}");
}

#[test]
fn what_was_moved_twice_is_where_the_second_time_puts_it_and_back_is_back() {
    let mut mapper = driven();
    let cells = |mapper: &Mapper| mapper.pool.iter().map(|(_, record)| record.voxel).collect::<Vec<_>>();
    let before = cells(&mapper);
    mapper.realign(&from(3));
    let once = cells(&mapper);
    assert_ne!(before, once);
    mapper.realign(&from(0));
    assert_ne!(once, cells(&mapper));
    mapper.realign(&Alignment::default());
    let n_elsewhere = before.iter().zip(cells(&mapper)).filter(|(before, after)| *before != after).count();
    assert_eq!(n_elsewhere, 0, "of {}", before.len());
}

#[test]
fn the_later_of_two_drives_gives_way_where_both_are_in_one_place() {
    // Keyframes 60 to 65 see the street of 0 to 5 again, and odometry puts them 20 m aside.
    let aside = Rigid::translation(20.0, 0.0, 0.0);
    let mut mapper = driven_again(60, 0, &aside);
    let before = mapper.n_resident_anchors();
    mapper.realign(&back(60, &aside));
    let merged = mapper.counters().anchors_merged;
    assert_eq!(u64::from(before - mapper.n_resident_anchors()), merged);
    assert!(merged > u64::from(before) / 20, "{merged} of {before} anchors were of the same voxels");
    assert_eq!(mapper.pool.n_live(), mapper.n_resident_anchors());
    assert_eq!(mapper.grid.len() as u32, mapper.n_resident_anchors(), "one voxel, one anchor");
}

#[test]
fn what_was_mapped_astray_ends_when_a_loop_puts_it_right() {
    // Two chunks later the street is seen again from half its way on, and odometry puts it 3 m aside.
    let aside = Rigid::translation(3.0, 0.0, 0.0);
    let mut mapper = driven_again(200, 3, &aside);
    let n_of = |mapper: &Mapper, ordinals: Range<u32>| {
        mapper.pool.iter().filter(|(_, record)| ordinals.contains(&record.keyframe_ordinal)).count()
    };
    // Up to 206 stand at most 4 m beyond the last finished keyframe, the others up to 12 m.
    let [earlier, same, farther] = [0..200, 200..204, 204..206];
    let counts = |mapper: &Mapper| [&earlier, &same, &farther].map(|ordinals| n_of(mapper, ordinals.clone()));
    let before = counts(&mapper);
    let mut blurred = Alignment::default();
    blurred.push(200, Similarity::from_isometry(Rigid::translation(-0.1, 0.0, 0.0), 1.0));
    assert!(!mapper.realign(&blurred), "steps mend 0.1 m");
    let [_, still_same, still_farther] = counts(&mapper);
    assert!(still_same + still_farther > (before[1] + before[2]) * 9 / 10);
    assert!(mapper.realign(&back(200, &aside)), "3 m are astray");
    mapper.map_anew();
    let anew = counts(&mapper);
    assert_eq!(anew[0], before[0], "what is finished stays");
    assert_eq!(anew[1], 0, "they show nothing new");
    assert!((1..before[2]).contains(&anew[2]), "{} anchors that were astray became {}", before[2], anew[2]);
    assert_eq!(mapper.grid.len() as u32, mapper.n_resident_anchors(), "one voxel, one anchor");
}

#[test]
fn a_view_that_shows_nothing_new_leaves_the_map_as_it_is() {
    let aside = Rigid::translation(3.0, 0.0, 0.0);
    let mut mapper = driven_again(200, 0, &aside);
    // As long as no loop says where the street is, it is mapped.
    assert!(look(&mut mapper, 206, 2, &aside).n_anchors > 0 && mapper.optimize(8).n_iterations == 8);
    mapper.realign(&back(200, &aside));
    mapper.map_anew();
    assert_eq!(look(&mut mapper, 207, 3, &Rigid::identity()), InsertReport::default());
    let n_steps = mapper.optimize(8).n_iterations;
    assert_eq!(n_steps, 0, "every keyframe of the window stands where a finished one did");
    let turned = Rigid::rotation(Vector3::new(0.0, 0.8, 0.0));
    let n_anchors = look(&mut mapper, 208, 0, &turned).n_anchors;
    assert!(n_anchors > 0, "it looks elsewhere");
    // The newest keyframe's steps are taken, one by one as in a live drive, and those of the others are not.
    let n_steps: u32 = (0..40).map(|_| mapper.optimize(1).n_iterations).sum();
    assert!((8..24).contains(&n_steps), "{n_steps} of 40");
    assert!(look(&mut mapper, 209, 9, &Rigid::identity()).n_anchors > 0, "it stands elsewhere");
}

#[test]
fn exact_poses_need_no_loop() {
    let mut mapper = driven_again(200, 0, &Rigid::translation(3.0, 0.0, 0.0));
    mapper.trust_poses();
    assert_eq!(look(&mut mapper, 206, 3, &Rigid::identity()), InsertReport::default());
    assert!(look(&mut mapper, 207, 9, &Rigid::identity()).n_anchors > 0, "it stands elsewhere");
}

#[test]
fn who_comes_from_the_other_end_puts_anchors_of_his_own_into_voxels_that_are_taken() {
    let n_shared_and_occupied = |moved: &Similarity| {
        let settings = MapperSettings { page_distance_m: f64::INFINITY, ..settings(false) };
        let mut mapper = mapper_of(1, CAPACITY, settings);
        for nth in 0..2 {
            look(&mut mapper, nth, nth, &Rigid::identity());
        }
        // The same voxels as if keyframes had spawned them that stand elsewhere.
        mapper.paging.directory.iter_mut().for_each(|group| group.move_keyframes(|_| *moved));
        let n_occupied = look(&mut mapper, 2, 1, &Rigid::identity()).n_occupied;
        let mut voxels = BTreeMap::<_, [u32; 2]>::new();
        for (_, record) in mapper.pool.iter() {
            voxels.entry(record.voxel).or_default()[usize::from(record.keyframe_ordinal == 2)] += 1;
        }
        (voxels.values().filter(|[before, now]| before * now > 0).count(), n_occupied)
    };
    let (n_shared, n_occupied) = n_shared_and_occupied(&Similarity::identity());
    assert!(n_shared == 0 && n_occupied > 50, "{n_shared} shared, {n_occupied} occupied");
    let from_the_other_end =
        Similarity::from_parts(Translation3::new(0.0, 0.0, 500.0), UnitQuaternion::identity(), 1.0);
    let (n_shared, n_occupied) = n_shared_and_occupied(&from_the_other_end);
    assert!(n_shared > 50 && n_occupied < 10, "{n_shared} shared, {n_occupied} occupied");
}

#[test]
fn an_anchor_is_shown_to_who_is_on_the_side_of_its_keyframe() {
    let mapper = driven();
    let mut n_anchors = 0;
    for (handle, record) in mapper.pool.iter() {
        let keyframe_m = mapper.keyframe_in_map_m(record.keyframe_ordinal).expect("a keyframe in memory");
        let center_m = Vector3::from(record.voxel.center_in_map_m());
        assert!(mapper.is_shown_to(handle.slot, record.voxel, &keyframe_m));
        assert!(!mapper.is_shown_to(handle.slot, record.voxel, &(2.0 * center_m - keyframe_m)), "from behind");
        n_anchors += 1;
    }
    assert!(n_anchors > 100);
}
