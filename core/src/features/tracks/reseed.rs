//! Tracks started anew from matches of the keyframe with the current frame.

use super::{IDENTITY, Track, TrackImages, TrackSettings, TrackTable};
use crate::correspondence::PixelMatch;
use crate::features::SimdLevel;
use crate::features::affine::{self, AffineFlow, AffineVerdict, Placement};
use crate::features::lk::squared_distance;

/// A match this near says where a track is without a look at its window, px.
const SAME_POINT_PX: f32 = 3.0;

/// What the matches did to the tracks.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ReseedReport {
    /// Tracks of the keyframe that were found again.
    pub n_found: usize,
    /// Matches that became new tracks of the keyframe.
    pub n_new: usize,
    /// Of both: those whose window confirmed the place; the others are as exact as the match.
    pub n_refined: usize,
    /// Median displacement of the tracks against the keyframe, px; 0 without tracks.
    pub median_flow_px: f32,
}

impl TrackTable<'_> {
    /// Replaces the live tracks by what `matches` say about the keyframe's.
    ///
    /// A track of the keyframe, dead or alive, is expected where the nearest match in the keyframe moved to, and refined
    /// there against the keyframe's window. Where the windows do not agree (noise, darkness, blur: the reasons for asking
    /// a matcher), a match that lies on the track is believed all the same. A match without a track near becomes a track.
    ///
    /// # Cost
    /// O(tracks * matches) distances and a refinement per track; no allocation.
    pub fn reseed(
        &mut self,
        simd: SimdLevel,
        images: TrackImages<'_>,
        matches: &[PixelMatch],
        settings: &TrackSettings,
    ) -> ReseedReport {
        let mut report = ReseedReport::default();
        let evidence = Evidence { simd, images, settings };
        let reach_px = settings.corners.cell_px;
        self.n_live = 0;
        for place in 0..self.n_at_keyframe {
            let Some(&track) = self.storage.at_keyframe.get(place) else { break };
            let Some((nearest, distance_px)) = nearest_match(track.keyframe_px, matches) else { break };
            let moved = [0, 1].map(|k: usize| nearest.current_px[k] - nearest.keyframe_px[k]);
            let expected_px = [0, 1].map(|k: usize| track.keyframe_px[k] + moved[k]);
            let may_be_raw = distance_px < SAME_POINT_PX;
            let is_near = distance_px <= reach_px;
            if let Some(is_refined) =
                is_near.then(|| self.restart(&evidence, &track, expected_px, may_be_raw)).flatten()
            {
                report.n_found += 1;
                report.n_refined += usize::from(is_refined);
            }
        }
        for m in matches {
            let known = self.storage.at_keyframe.get(..self.n_at_keyframe).unwrap_or(&[]);
            let is_near = |t: &Track| squared_distance(t.keyframe_px, m.keyframe_px) < SAME_POINT_PX * SAME_POINT_PX;
            if known.iter().any(is_near) {
                continue;
            }
            let track = Track::born(self.n_born, m.keyframe_px, 0.0);
            let Some(slot) = self.storage.at_keyframe.get_mut(self.n_at_keyframe) else { break };
            *slot = track;
            if let Some(is_refined) = self.restart(&evidence, &track, m.current_px, true) {
                report.n_new += 1;
                report.n_refined += usize::from(is_refined);
                self.n_at_keyframe += 1;
                self.n_born += 1;
            }
        }
        report.median_flow_px = self.median_flow_px();
        report
    }

    /// Puts a track back among the living, where there is evidence and room for it; whether its window confirmed it.
    fn restart(
        &mut self,
        evidence: &Evidence<'_>,
        track: &Track,
        expected_px: [f32; 2],
        may_be_raw: bool,
    ) -> Option<bool> {
        let Evidence { simd, images, settings } = evidence;
        let mut flow = [AffineFlow {
            keyframe_px: track.keyframe_px,
            placement: Placement { center_px: expected_px, shape: IDENTITY },
            verdict: AffineVerdict::Pending,
        }];
        affine::refine(*simd, images.keyframe, images.current, &settings.affine, &mut flow);
        let [AffineFlow { placement, verdict, .. }] = flow;
        let (placement, correlation, is_refined) = match verdict {
            AffineVerdict::Placed { correlation } => (placement, correlation, true),
            AffineVerdict::LeftImage => return None,
            _ if may_be_raw => (Placement { center_px: expected_px, shape: IDENTITY }, 0.0, false),
            _ => return None,
        };
        // As if it had moved evenly since the keyframe: where the next frame will look for it.
        let share = 1.0 / self.frames_since_keyframe.max(1) as f32;
        let center_px = placement.center_px;
        let previous_px = [0, 1].map(|k: usize| center_px[k] - share * (center_px[k] - track.keyframe_px[k]));
        let slot = self.storage.tracks.get_mut(self.n_live)?;
        *slot = Track {
            previous_px,
            current_px: center_px,
            shape: placement.shape,
            age_frames: track.age_frames.max(1),
            correlation,
            ..*track
        };
        self.n_live += 1;
        Some(is_refined)
    }
}

/// What a match is held against.
struct Evidence<'a> {
    simd: SimdLevel,
    images: TrackImages<'a>,
    settings: &'a TrackSettings,
}

/// The match whose keyframe pixel is nearest, and how near.
fn nearest_match(keyframe_px: [f32; 2], matches: &[PixelMatch]) -> Option<(&PixelMatch, f32)> {
    let distance2 = |m: &PixelMatch| squared_distance(m.keyframe_px, keyframe_px);
    let nearest = matches.iter().min_by(|a, b| distance2(a).total_cmp(&distance2(b)))?;
    Some((nearest, libm::sqrtf(distance2(nearest))))
}
