//! A drive without one tracked frame has failed, however it ended.

use crate::input::HeaderVerdict;
use crate::output::FrameCounts;
use crate::run_error::RunError;

/// Why a drive left nothing to drive by; `None` when a frame was tracked.
pub fn nothing_tracked(counts: &FrameCounts, n_refused: u64, last_refusal: Option<HeaderVerdict>) -> Option<RunError> {
    if counts.tracked > 0 {
        return None;
    }
    let n_received = counts.received();
    let FrameCounts { doubtful, lost, dropped, .. } = *counts;
    Some(RunError::Run(format!(
        "tracking the drive: not one frame was tracked; {n_received} were received ({doubtful} doubtful, {lost} lost, \
         {dropped} dropped), {n_refused} refused; {}",
        advice(counts, last_refusal)
    )))
}

fn advice(counts: &FrameCounts, last_refusal: Option<HeaderVerdict>) -> String {
    let n_seen = counts.doubtful + counts.lost;
    match last_refusal {
        _ if n_seen > 0 => "do the images show a street, sharp and not dark, and is the camera file that of this camera?".to_owned(),
        Some(verdict @ HeaderVerdict::WrongSize { .. }) => {
            format!("the last one: {verdict}; give --camera the file of the camera that sends")
        }
        Some(verdict) => format!(
            "the last one: {verdict}; is it the right --service, with one camera process of this version of kilogs?"
        ),
        None if counts.dropped > 0 => {
            "none could be read, or none in time: see the warnings above, play slower with --rate, or give more --threads"
                .to_owned()
        }
        None => "is the camera process running and sending under the same --service, and had the run the time to begin?"
            .to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_drive_without_a_tracked_frame_says_what_came_and_what_to_try() {
        let wrong_size = HeaderVerdict::WrongSize { found: [64, 48], expected: [416, 128] };
        let none = FrameCounts::default();
        for (counts, n_refused, last_refusal, expected) in [
            (
                none,
                7,
                Some(wrong_size),
                "7 refused; the last one: image of 64x48 px, the camera has 416x128 px; give --camera",
            ),
            (none, 7, Some(HeaderVerdict::SecondCamera), "is it the right --service"),
            (
                none,
                0,
                None,
                "0 were received (0 doubtful, 0 lost, 0 dropped), 0 refused; is the camera process running",
            ),
            (FrameCounts { dropped: 3, ..none }, 0, None, "3 dropped), 0 refused; none could be read"),
            (FrameCounts { lost: 2, ..none }, 1, Some(wrong_size), "2 lost, 0 dropped), 1 refused; do the images show"),
        ] {
            let failure = nothing_tracked(&counts, n_refused, last_refusal).expect("nothing was tracked");
            assert!(failure.code() == 1 && failure.to_string().contains(expected), "{failure}");
        }
        assert!(nothing_tracked(&FrameCounts { tracked: 1, ..none }, 7, Some(wrong_size)).is_none());
    }
}
