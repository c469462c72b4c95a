//! Which frames judge the map instead of making it.

/// Every so many frames one is held out.
pub const HELD_OUT_PERIOD: u64 = 8;

/// Whether a frame may never be used in a loss: the last of every [`HELD_OUT_PERIOD`].
pub fn is_held_out_frame(frame_index: u64) -> bool {
    frame_index % HELD_OUT_PERIOD == HELD_OUT_PERIOD - 1
}

/// Picks the held-out frames that are worth storing: only one between two keyframes, so that a standing vehicle
/// does not fill the store.
#[derive(Debug, Clone, Copy, Default)]
pub struct HeldOutRule {
    keyframes_at_last: Option<u32>,
}

impl HeldOutRule {
    /// Whether to store this frame; `n_keyframes` is how many keyframes there are so far.
    pub fn admits(&mut self, frame_index: u64, n_keyframes: u32) -> bool {
        let is_new = n_keyframes > 0 && self.keyframes_at_last != Some(n_keyframes);
        let admitted = is_held_out_frame(frame_index) && is_new;
        if admitted {
            self.keyframes_at_last = Some(n_keyframes);
        }
        admitted
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_in_eight_and_none_while_standing() {
        let mut rule = HeldOutRule::default();
        let keyframes_so_far = |frame: u64| if frame < 20 { 1 + frame / 4 } else { 6 } as u32;
        let admitted: Vec<u64> = (0..48).filter(|&frame| rule.admits(frame, keyframes_so_far(frame))).collect();
        assert_eq!(admitted, [7, 15, 23]);
        assert!(!HeldOutRule::default().admits(7, 0), "no keyframe yet: no pose to judge by");
    }
}
