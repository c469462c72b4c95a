//! What is known of the camera process that sends, and what its next header makes of it.

use iceoryx2::identifiers::UniquePublisherId;
use kilogs_camera::ipc::{FrameHeader, HeaderVerdict, MAX_TIME_STEP_NS, PreviousFrame, ServiceFormat};

/// The frames of one camera process, from its first to its last.
#[derive(Clone, Copy, Debug)]
pub(super) struct Session {
    pub(super) camera: UniquePublisherId,
    pub(super) previous: Option<PreviousFrame>,
    pub(super) has_ended: bool,
    /// It was told that this process is gone.
    pub(super) has_gone: bool,
    /// It was there before the tracker and may have been sending: its numbers do not tell how many frames were meant
    /// for this run.
    may_have_sent: bool,
    /// The last frame, refused because its time or number is far from that of the frame before.
    far_off: Option<PreviousFrame>,
    /// Added to its times (wrapping), so that time goes on where a camera process or its clock starts anew.
    pub(super) time_shift_ns: u64,
}

/// What to do with a header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Judgement {
    pub(super) verdict: HeaderVerdict,
    /// Frames that are missing before it.
    pub(super) n_missing: u64,
    /// The clock of the camera was set.
    pub(super) is_new_clock: bool,
}

impl Session {
    pub(super) fn new(camera: UniquePublisherId, may_have_sent: bool) -> Self {
        Self {
            camera,
            previous: None,
            may_have_sent,
            has_ended: false,
            has_gone: false,
            far_off: None,
            time_shift_ns: 0,
        }
    }

    /// The verdict on a header. A single time or number far from the others is refused, lest it make all later ones go
    /// backwards; a second frame that agrees with it says that the clock was set or that the camera counts anew. What
    /// such a count has left out nobody knows: nothing is missing then, and nothing is before the first frame of a
    /// camera that was there before the tracker.
    pub(super) fn judge(&mut self, header: &FrameHeader, format: &ServiceFormat, sent_bytes: u64) -> Judgement {
        let verdict = header.judge(format, self.previous, sent_bytes);
        let n_missing = match verdict {
            HeaderVerdict::Accept { n_missing, .. } | HeaderVerdict::End { n_missing } => n_missing,
            _ => 0,
        };
        if !self.may_begin_anew(&verdict, header) {
            self.far_off = None;
            let is_unknown = self.previous.is_none() && self.may_have_sent;
            return Judgement { verdict, n_missing: if is_unknown { 0 } else { n_missing }, is_new_clock: false };
        }
        let this = PreviousFrame { sequence: header.sequence, timestamp_ns: header.timestamp_ns };
        let before = self.far_off.replace(this);
        match before.map(|before| header.judge(format, Some(before), sent_bytes)) {
            Some(agreeing @ HeaderVerdict::Accept { .. }) => {
                self.far_off = None;
                Judgement {
                    verdict: agreeing,
                    n_missing: self.missing_behind_far_frame(&verdict, header),
                    is_new_clock: self.is_far_in_time(header),
                }
            }
            _ => Judgement { verdict, n_missing: 0, is_new_clock: false },
        }
    }

    /// Whether a refusal may be the camera's first frame of another clock or another count.
    fn may_begin_anew(&self, verdict: &HeaderVerdict, header: &FrameHeader) -> bool {
        match verdict {
            HeaderVerdict::SequenceJump { .. } => true,
            // Behind the frame before in both, it was only reordered.
            HeaderVerdict::SequenceBackwards { .. } => {
                self.previous.is_some_and(|previous| header.timestamp_ns > previous.timestamp_ns)
                    || self.is_far_in_time(header)
            }
            _ => verdict.is_time_jump(),
        }
    }

    fn is_far_in_time(&self, header: &FrameHeader) -> bool {
        self.previous.is_some_and(|previous| header.timestamp_ns.abs_diff(previous.timestamp_ns) > MAX_TIME_STEP_NS)
    }

    /// A clock that was set does not change the count.
    fn missing_behind_far_frame(&self, verdict: &HeaderVerdict, header: &FrameHeader) -> u64 {
        let last = self.previous.filter(|_| verdict.is_time_jump()).map(|previous| previous.sequence);
        last.map_or(0, |last| header.sequence.saturating_sub(last).saturating_sub(1))
    }
}
