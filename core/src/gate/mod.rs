//! Decides which frames become keyframes.
//!
//! A frame is promoted when the view has moved enough to tell depths apart, or while there are still enough tracks to
//! anchor the next keyframe to this one. All other frames get a pose and create nothing.

use crate::features::corners::REFERENCE_WIDTH_PX;

/// Constants of the gate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GateSettings {
    /// Median displacement against the last keyframe beyond which a frame is promoted, px at
    /// [`REFERENCE_WIDTH_PX`]; scaled with the image's width. Range (0, 500]; 24 in the paper's supplement.
    pub min_flow_px: f32,
    /// Share of the keyframe's tracks below which the frame is promoted before they run out. Range [0, 1]; ours.
    pub min_survivors_ratio: f32,
    /// Number of tracks below which the frame is promoted, where the keyframe had as many. Range 0..; ours.
    pub min_tracks: usize,
}

impl GateSettings {
    /// The values that the documentation of the fields explains.
    pub const STANDARD: Self = Self { min_flow_px: 24.0, min_survivors_ratio: 0.3, min_tracks: 150 };
}

/// What has changed since the last keyframe.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewChange {
    /// Median displacement of the tracks, px.
    pub median_flow_px: f32,
    /// Tracks that are still alive.
    pub n_tracks: usize,
    /// Tracks right after the last keyframe; 0 when there is none yet.
    pub n_tracks_at_keyframe: usize,
    /// Width of the image, px.
    pub width_px: usize,
}

/// Whether a frame becomes a keyframe, and the number that decided.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum GateVerdict {
    /// The view has not changed enough: no keyframe.
    Hold {
        /// Median displacement, px.
        flow_px: f32,
        /// What it would have to exceed, px.
        limit_px: f32,
    },
    /// The view has moved: keyframe.
    Moved {
        /// Median displacement, px.
        flow_px: f32,
        /// What it exceeds, px.
        limit_px: f32,
    },
    /// Tracks run out: keyframe.
    TooFewTracks {
        /// Tracks that are still alive.
        found: usize,
        /// Tracks that it would have taken to wait.
        needed: usize,
    },
}

impl GateVerdict {
    /// Whether the frame becomes a keyframe.
    pub fn is_keyframe(&self) -> bool {
        !matches!(self, Self::Hold { .. })
    }
}

/// Judges one frame. A displacement that is not a number counts as none.
///
/// # Source
/// Motion-aware keyframe selection (paper, supplement): median displacement; the survivors' rule is ours.
pub fn judge(change: &ViewChange, settings: &GateSettings) -> GateVerdict {
    let limit_px = settings.min_flow_px * change.width_px as f32 / REFERENCE_WIDTH_PX;
    let flow_px = change.median_flow_px;
    let share = (settings.min_survivors_ratio.clamp(0.0, 1.0) * change.n_tracks_at_keyframe as f32) as usize;
    let needed = share.max(settings.min_tracks.min(change.n_tracks_at_keyframe));
    if flow_px > limit_px {
        GateVerdict::Moved { flow_px, limit_px }
    } else if change.n_tracks < needed {
        GateVerdict::TooFewTracks { found: change.n_tracks, needed }
    } else {
        GateVerdict::Hold { flow_px, limit_px }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SETTINGS: GateSettings = GateSettings::STANDARD;

    #[track_caller]
    fn check(
        median_flow_px: f32,
        n_tracks: usize,
        n_tracks_at_keyframe: usize,
        width_px: usize,
        expected: GateVerdict,
    ) {
        let change = ViewChange { median_flow_px, n_tracks, n_tracks_at_keyframe, width_px };
        assert_eq!(judge(&change, &SETTINGS), expected);
    }

    #[test]
    fn the_view_must_move_by_more_than_the_scaled_limit() {
        check(24.0, 900, 1000, 1241, GateVerdict::Hold { flow_px: 24.0, limit_px: 24.0 });
        check(24.1, 900, 1000, 1241, GateVerdict::Moved { flow_px: 24.1, limit_px: 24.0 });
        check(24.1, 900, 1000, 2482, GateVerdict::Hold { flow_px: 24.1, limit_px: 48.0 });
        check(24.1, 0, 1000, 1241, GateVerdict::Moved { flow_px: 24.1, limit_px: 24.0 });
    }

    #[test]
    fn a_frame_is_kept_before_the_tracks_run_out() {
        check(1.0, 300, 1000, 1241, GateVerdict::Hold { flow_px: 1.0, limit_px: 24.0 });
        check(1.0, 299, 1000, 1241, GateVerdict::TooFewTracks { found: 299, needed: 300 });
        check(1.0, 149, 200, 1241, GateVerdict::TooFewTracks { found: 149, needed: 150 });
        check(1.0, 20, 20, 1241, GateVerdict::Hold { flow_px: 1.0, limit_px: 24.0 });
        check(0.0, 0, 0, 1241, GateVerdict::Hold { flow_px: 0.0, limit_px: 24.0 });
    }

    #[test]
    fn no_number_is_no_motion() {
        let change = ViewChange { median_flow_px: f32::NAN, n_tracks: 9, n_tracks_at_keyframe: 9, width_px: 1241 };
        assert!(!judge(&change, &SETTINGS).is_keyframe());
    }
}
