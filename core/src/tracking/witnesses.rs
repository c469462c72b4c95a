//! Whom to believe: landmarks that have been tested, and stand among others that have.

use super::frame_pose::FramePose;
use super::tracker::Tracker;
use crate::correspondence::PixelMatch;
use crate::keyframe::{Landmark, WINDOW};

/// Sightings that make a landmark a witness: two give a depth to almost anything that moves along its epipolar line, the
/// third one tests it.
const WITNESS_SIGHTINGS: usize = 3;
/// With fewer witnesses than this in view all landmarks are asked.
const FEWEST_WITNESSES: usize = 10;
/// Sightings beyond those of a witness up to which a landmark's neighbours say more about it than its own tests.
const DOUBTED_SIGHTINGS: u32 = 1;
/// Half the side of a landmark's neighbourhood over the image's width. Ours: of 0.04 to 0.08, where trucks were survived
/// best.
const NEIGHBORHOOD: f32 = 0.06;
/// What a neighbour counts that nothing has tested yet; one that has been tested counts 1, one that moves -1.
const NEWCOMER_WEIGHT: f32 = 0.25;
/// Share of the tracks that has to have been found to move for neighbours to count: tracks slip here and there.
const CROWD_SHARE: f32 = 0.2;

impl Tracker<'_> {
    /// Sightings that make a landmark a witness at the moment.
    pub(super) fn witness_sightings(&self) -> u32 {
        let mut n_of_age = [0; WINDOW + 1];
        let in_view = |l: &&Landmark| l.is_used() && l.is_tracked && l.has_depth() && !l.is_outlier;
        for landmark in self.landmarks.iter().filter(in_view) {
            if let Some(count) = n_of_age.get_mut(landmark.n_sightings() as usize) {
                *count += 1;
            }
        }
        let n_witnesses: usize = n_of_age.iter().skip(WITNESS_SIGHTINGS).sum();
        let needed = if n_witnesses >= FEWEST_WITNESSES { WITNESS_SIGHTINGS } else { WITNESS_SIGHTINGS - 1 };
        needed as u32
    }

    /// Sorts the witnesses among `n` landmark matches to the front; their number.
    pub(super) fn witnesses_to_the_front(&mut self, n: usize) -> usize {
        let needed = self.witness_sightings();
        let (matches, of_match) = (&mut *self.scratch.landmark_matches, &mut *self.scratch.landmark_of_match);
        let mut n_witnesses = 0;
        for i in 0..n.min(matches.len()).min(of_match.len()) {
            if self.landmarks.get(of_match[i] as usize).is_some_and(|l| l.n_sightings() >= needed) {
                matches.swap(n_witnesses, i);
                of_match.swap(n_witnesses, i);
                n_witnesses += 1;
            }
        }
        n_witnesses
    }

    /// Marks the landmarks that a keyframe's pose contradicts: their tracks have slipped, or they move.
    pub(super) fn mark_contradicted(&mut self, pose: &FramePose) {
        let n = self.collect_landmark_matches();
        let noise_z1 = self.settings.noise_px_of(pose.source) / self.camera.fx;
        let camera_from_keyframe = pose.camera_from_world * self.newest.camera_from_world.inverse();
        let limit2 = self.settings.pnp_inlier_sigmas * self.settings.pnp_inlier_sigmas;
        let matches = self.scratch.landmark_matches.iter().zip(self.scratch.landmark_of_match.iter());
        for (m, &idx) in matches.take(n) {
            if let Some(landmark) = self.landmarks.get_mut(idx as usize) {
                landmark.is_outlier |= m.squared_sigmas(&camera_from_keyframe, noise_z1) >= limit2;
            }
        }
    }

    /// Marks landmarks that are hardly tested and stand among others that were just found to move: they are part of
    /// what moves there.
    ///
    /// On the side of a truck there are points whose way through the image is also that of some depth, but that of most of
    /// their neighbours is not.
    pub(super) fn mark_company_of_outliers(&mut self) {
        let needed = self.witness_sightings();
        let (tracks, linked) = (self.tracks.tracks(), &*self.scratch.landmark_of_track);
        // A track's slot holds where it is and what it counts.
        for ((track, &idx), slot) in tracks.iter().zip(linked).zip(self.scratch.pixel_matches.iter_mut()) {
            let confidence = self.landmarks.get(idx as usize).map_or(0.0, |l| match l.n_sightings() {
                _ if l.is_outlier => -1.0,
                _ if !l.has_depth() => 0.0,
                n if n > needed => 1.0,
                _ => NEWCOMER_WEIGHT,
            });
            *slot = PixelMatch { keyframe_px: track.keyframe_px, current_px: track.current_px, confidence };
        }
        let company = self.scratch.pixel_matches.get(..tracks.len()).unwrap_or(&[]);
        let n_outliers = company.iter().filter(|track| track.confidence < 0.0).count();
        if (n_outliers as f32) < CROWD_SHARE * company.len() as f32 {
            return;
        }
        let half_px = NEIGHBORHOOD * self.camera.width as f32;
        let near = |a: &PixelMatch, b: &PixelMatch| (0..2).all(|k| (a.current_px[k] - b.current_px[k]).abs() < half_px);
        for (place, &idx) in company.iter().zip(linked) {
            let Some(landmark) = self.landmarks.get_mut(idx as usize) else { continue };
            let is_doubted = landmark.n_sightings() <= needed + DOUBTED_SIGHTINGS;
            if landmark.has_depth() && is_doubted && !landmark.is_outlier {
                let balance: f32 = company.iter().filter(|other| near(place, other)).map(|o| o.confidence).sum();
                landmark.is_outlier = balance < 0.0;
            }
        }
    }
}
