//! What the live tracks say: matches with the keyframe, and with the window's landmarks.

use super::settings::DynamicFilter;
use super::tracker::{NO_LANDMARK, Tracker};
use crate::camera::Pinhole;
use crate::features::tracks::Track;
use crate::pose::{LandmarkMatch, Match};
use nalgebra::Vector2;

/// A pixel on the plane z = 1.
pub(super) fn z1_of(camera: &Pinhole, pixel: [f32; 2]) -> Vector2<f64> {
    camera.unproject_z1(&Vector2::new(f64::from(pixel[0]), f64::from(pixel[1])))
}

impl Tracker<'_> {
    /// Fills the landmark matches of the current frame and returns their number.
    pub(super) fn collect_landmark_matches(&mut self) -> usize {
        let (camera_from_world, flow_limit_px) = (self.newest.camera_from_world, self.flow_limit_px());
        let mut n = 0;
        for (track, &landmark_idx) in self.tracks.tracks().iter().zip(self.scratch.landmark_of_track.iter()) {
            let Some(landmark) = self.landmarks.get(landmark_idx as usize) else { continue };
            if landmark.is_outlier || !landmark.has_depth() || track.flow_px() > flow_limit_px {
                continue;
            }
            let Some(view) = self.window.landmark_in(landmark, &camera_from_world) else { continue };
            let found = LandmarkMatch {
                reference_z1: z1_of(&self.camera, track.keyframe_px),
                inverse_depth: view.inverse_depth,
                inverse_depth_sigma: view.sigma,
                seen_z1: z1_of(&self.camera, track.current_px),
            };
            let (Some(slot), Some(idx)) =
                (self.scratch.landmark_matches.get_mut(n), self.scratch.landmark_of_match.get_mut(n))
            else {
                break;
            };
            (*slot, *idx) = (found, landmark_idx);
            n += 1;
        }
        n
    }

    /// Fills the matches of all live tracks with the keyframe and returns their number.
    pub(super) fn collect_matches(&mut self) -> usize {
        let flow_limit = self.flow_limit_px();
        let mut n = 0;
        let alive = self.tracks.tracks().iter().filter(|t| t.flow_px() <= flow_limit);
        for (slot, track) in self.scratch.matches.iter_mut().zip(alive) {
            *slot = Match {
                first_z1: z1_of(&self.camera, track.keyframe_px),
                second_z1: z1_of(&self.camera, track.current_px),
            };
            n += 1;
        }
        n
    }

    /// Largest flow that the paper's filter lets pass, px.
    fn flow_limit_px(&self) -> f32 {
        if self.settings.dynamic_filter != DynamicFilter::Paper {
            return f32::INFINITY;
        }
        flow_limit_px(self.tracks.tracks())
    }

    /// Renews the table from tracks to landmarks and notes which landmarks have lost their track.
    pub(super) fn link_landmarks(&mut self) {
        let tracks = self.tracks.tracks();
        self.scratch.landmark_of_track.fill(NO_LANDMARK);
        for (i, landmark) in self.landmarks.iter_mut().enumerate().filter(|(_, l)| l.is_used() && l.is_tracked) {
            match tracks.binary_search_by_key(&landmark.track_id, |t| t.id) {
                Ok(place) => {
                    if let Some(slot) = self.scratch.landmark_of_track.get_mut(place) {
                        *slot = i as u32;
                    }
                }
                Err(_) => landmark.is_tracked = false,
            }
        }
    }
}

/// The paper's limit, median + 3 MAD of the flow, by bisection: it needs no memory for sorting.
fn flow_limit_px(tracks: &[Track]) -> f32 {
    const MADS: f32 = 3.0;
    let median_px = median(tracks.iter().map(Track::flow_px));
    let mad_px = median(tracks.iter().map(|t| (t.flow_px() - median_px).abs()));
    median_px + MADS * mad_px
}

/// Median by bisection of the value range, to f32 precision.
fn median(values: impl Iterator<Item = f32> + Clone) -> f32 {
    const HALVINGS: usize = 30;
    let n = values.clone().count();
    let (mut low, mut high) = (0.0_f32, values.clone().fold(0.0, f32::max));
    for _ in 0..HALVINGS {
        let middle = 0.5 * (low + high);
        if 2 * values.clone().filter(|&v| v <= middle).count() >= n { high = middle } else { low = middle }
    }
    high
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_median_needs_no_memory() {
        for (values, expected) in
            [([1.0, 9.0, 3.0, 2.0, 100.0], 3.0), ([5.0; 5], 5.0), ([0.0, 0.0, 0.0, 7.0, 8.0], 0.0)]
        {
            assert!((median(values.into_iter()) - expected).abs() < 1e-4, "{values:?}");
        }
        assert_eq!(median([].into_iter()), 0.0);
    }
}
