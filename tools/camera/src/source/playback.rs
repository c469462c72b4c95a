//! Which part of a recording is played, how often, and at what times.

use kilogs_core::conventions::TimestampNs;

use super::{FrameInfo, FrameSource, IndexedFrames, SourceError, SourceFormat};

/// Frames for which the camera stands still at each turn of a ping-pong playback.
pub const STANDING_FRAMES: u64 = 10;

/// Distance of the standing frames where one frame alone is played.
const LONE_FRAME_INTERVAL_NS: u64 = 100_000_000;

/// The part of a recording that is played.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PlaybackRange {
    /// Frames that are left out at the beginning.
    pub start: u64,
    /// Frames of one pass at most; `None` plays to the end.
    pub frames: Option<u64>,
    /// One-way passes; 1 plays forward once.
    pub passes: u64,
}

impl PlaybackRange {
    /// Everything, once.
    pub const ALL: Self = Self { start: 0, frames: None, passes: 1 };
}

/// Frame for each step of a playback: forward, standing, backward, standing, forward.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Schedule {
    first: u64,
    length: u64,
    passes: u64,
}

/// Where in the schedule a step lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Place {
    /// Passes that are complete before this step.
    pass: u64,
    /// Frames moved within the pass, from its first.
    moved: u64,
    /// Frames stood still after the pass.
    stood: u64,
}

impl Schedule {
    /// Plans the playback of a recording of `n_frames`.
    ///
    /// # Errors
    /// [`SourceError::Range`] when nothing would be played.
    pub fn new(n_frames: u64, range: &PlaybackRange) -> Result<Self, SourceError> {
        let left = n_frames.saturating_sub(range.start);
        let length = range.frames.map_or(left, |frames| frames.min(left));
        if length == 0 || range.passes == 0 {
            return Err(SourceError::Range(format!(
                "--start {} --frames {} --ping-pong {} of {n_frames} frames leaves none; start below {n_frames} and \
                 ask for at least one frame and one pass",
                range.start,
                range.frames.map_or("all".to_owned(), |frames| frames.to_string()),
                range.passes
            )));
        }
        Ok(Self { first: range.start, length, passes: range.passes })
    }

    /// Steps in all.
    pub fn n_steps(&self) -> u64 {
        1 + self.passes * (self.length - 1) + (self.passes - 1) * STANDING_FRAMES
    }

    /// Steps of the first pass, which shows every image that is shown at all.
    pub fn pass_length(&self) -> u64 {
        self.length
    }

    /// Index in the recording of the frame that is shown at `step`; it is also the sequence number's frame.
    pub fn frame_index(&self, step: u64) -> u64 {
        let place = self.place(step);
        self.frame_at(place.pass, place.moved)
    }

    /// Time of `step`: the recording's own in the first pass, and going on by the same intervals afterwards.
    fn timestamp_ns(&self, step: u64, time_of_frame: impl Fn(u64) -> TimestampNs) -> TimestampNs {
        let place = self.place(step);
        let (first_ns, last_ns) = (time_of_frame(self.first), time_of_frame(self.first + self.length - 1));
        let pass_ns = last_ns - first_ns;
        let standing_ns = match self.length {
            1 => LONE_FRAME_INTERVAL_NS,
            length => pass_ns / (length - 1),
        };
        let moved_ns =
            time_of_frame(self.frame_at(place.pass, place.moved)).abs_diff(time_of_frame(self.frame_at(place.pass, 0)));
        first_ns + place.pass * (pass_ns + STANDING_FRAMES * standing_ns) + moved_ns + place.stood * standing_ns
    }

    fn place(&self, step: u64) -> Place {
        let Some(after_first) = step.checked_sub(1) else { return Place { pass: 0, moved: 0, stood: 0 } };
        let moves = self.length - 1;
        let (pass, within) = (after_first / (moves + STANDING_FRAMES), after_first % (moves + STANDING_FRAMES));
        Place { pass, moved: (within + 1).min(moves), stood: (within + 1).saturating_sub(moves) }
    }

    fn frame_at(&self, pass: u64, moved: u64) -> u64 {
        match pass % 2 {
            0 => self.first + moved,
            _ => self.first + self.length - 1 - moved,
        }
    }
}

/// Plays a part of a recording, once or to and fro.
pub struct Playback<Frames> {
    frames: Frames,
    schedule: Schedule,
    step: u64,
}

impl<Frames: IndexedFrames> Playback<Frames> {
    /// Prepares the playback.
    ///
    /// # Errors
    /// [`SourceError::Range`] when nothing would be played.
    pub fn new(frames: Frames, range: &PlaybackRange) -> Result<Self, SourceError> {
        let schedule = Schedule::new(frames.n_frames(), range)?;
        Ok(Self { frames, schedule, step: 0 })
    }
}

impl<Frames: IndexedFrames> FrameSource for Playback<Frames> {
    fn format(&self) -> SourceFormat {
        SourceFormat { n_frames: Some(self.schedule.n_steps()), ..self.frames.format() }
    }

    fn next_frame(&mut self, pixels: &mut [u8]) -> Result<Option<FrameInfo>, SourceError> {
        if self.step == self.schedule.n_steps() {
            return Ok(None);
        }
        let index = self.schedule.frame_index(self.step);
        let timestamp_ns = self.schedule.timestamp_ns(self.step, |index| self.frames.info(index).timestamp_ns);
        self.step += 1;
        self.frames.read_frame(index, pixels)?;
        Ok(Some(FrameInfo { timestamp_ns, ..self.frames.info(index) }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn schedule(n_frames: u64, start: u64, frames: Option<u64>, passes: u64) -> Schedule {
        Schedule::new(n_frames, &PlaybackRange { start, frames, passes }).expect("something to play")
    }

    fn played(schedule: &Schedule) -> Vec<u64> {
        (0..schedule.n_steps()).map(|step| schedule.frame_index(step)).collect()
    }

    #[test]
    fn a_part_is_played_once() {
        let check = |n_frames, start, frames, expected: &[u64]| {
            assert_eq!(played(&schedule(n_frames, start, frames, 1)), expected);
        };
        check(3, 0, None, &[0, 1, 2]);
        check(5, 2, None, &[2, 3, 4]);
        check(5, 1, Some(2), &[1, 2]);
        check(5, 3, Some(9), &[3, 4]);
        check(1, 0, None, &[0]);
    }

    #[test]
    fn nothing_to_play_is_refused_with_the_numbers() {
        let check = |start, frames, passes| {
            let error = Schedule::new(5, &PlaybackRange { start, frames, passes }).expect_err("nothing to play");
            assert!(error.to_string().contains("of 5 frames leaves none"), "{error}");
        };
        check(5, None, 1);
        check(0, Some(0), 1);
        check(0, None, 0);
    }

    #[test]
    fn ping_pong_turns_with_standing_frames_and_time_goes_on() {
        let schedule = schedule(9, 1, Some(3), 3);
        let mut expected = vec![1, 2, 3];
        expected.extend([3; 10]);
        expected.extend([2, 1]);
        expected.extend([1; 10]);
        expected.extend([2, 3]);
        assert_eq!(played(&schedule), expected);

        // Uneven intervals of 10 and 30 ns, 20 ns on average.
        let time_of_frame = |index: u64| [0, 100, 110, 140][index as usize];
        let times: Vec<u64> = (0..schedule.n_steps()).map(|step| schedule.timestamp_ns(step, time_of_frame)).collect();
        assert!(times.is_sorted_by(|a, b| a < b), "{times:?}");
        assert_eq!(times[..4], [100, 110, 140, 160]);
        assert_eq!(times[12..16], [340, 370, 380, 400]);
        assert_eq!(times.last(), Some(&(380 + 200 + 40)));
    }

    #[test]
    fn a_lone_frame_stands_for_every_turn() {
        let schedule = schedule(1, 0, None, 3);
        assert_eq!(played(&schedule), [0; 21]);
        assert_eq!(schedule.timestamp_ns(20, |_| 7), 7 + 20 * LONE_FRAME_INTERVAL_NS);
    }
}
