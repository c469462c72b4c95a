//! What the wheels say, beside the frames: a text file with a reading per line.

use std::fs::File;
use std::io::{BufRead, BufReader, Lines};
use std::path::{Path, PathBuf};

use super::{FrameInfo, FrameSource, SourceError, SourceFormat};
use crate::ipc::Speed;

/// The file that is looked for in a recorded folder.
pub const SPEED_FILE_NAME: &str = "speed.txt";

const NS_PER_S: f64 = 1e9;
/// No vehicle of ours is faster, m/s.
const MAX_SPEED_M_PER_S: f64 = 200.0;

/// Readings of a file in their order. The file is read as the frames come, whatever its length.
pub struct SpeedFile {
    path: PathBuf,
    lines: Lines<BufReader<File>>,
    n_lines: u64,
}

impl SpeedFile {
    /// The file that was named, or the one beside the images of a recording that is played once, where there is one.
    ///
    /// # Errors
    /// [`SourceError::Range`] where a named file tells of one of several passes, else as [`SpeedFile::open`].
    pub fn of_recording(dataset: &Path, named: Option<&Path>, passes: u64) -> Result<Option<Self>, SourceError> {
        let beside = dataset.join(SPEED_FILE_NAME);
        match named {
            Some(file) if passes > 1 => {
                let problem =
                    format!("--speed {} tells of one pass; leave out --ping-pong, or --speed", file.display());
                Err(SourceError::Range(problem))
            }
            Some(file) => Self::open(file).map(Some),
            None if passes == 1 && beside.is_file() => Self::open(&beside).map(Some),
            None => Ok(None),
        }
    }

    /// Checks the whole file: `t_seconds metres_per_second sigma` on a line, on the clock of the frames, in the order of
    /// time. Empty lines and what follows a `#` are left out.
    ///
    /// # Errors
    /// [`SourceError::File`] with the line that cannot be believed.
    pub fn open(path: &Path) -> Result<Self, SourceError> {
        let mut previous: Option<Speed> = None;
        let mut checked = Self::at_start(path)?;
        while let Some(reading) = checked.read().map_err(|reason| SourceError::file(path, reason))? {
            if let Some(previous) = previous.filter(|previous| previous.timestamp_ns >= reading.timestamp_ns) {
                let [found_s, before_s] = [reading, previous].map(|reading| reading.timestamp_ns as f64 / NS_PER_S);
                let reason = format!(
                    "line {}: time goes backwards, {found_s} s is not after {before_s} s; sort the lines by time",
                    checked.n_lines
                );
                return Err(SourceError::file(path, reason));
            }
            previous = Some(reading);
        }
        match previous {
            Some(_) => Self::at_start(path),
            None => Err(SourceError::file(path, "there is no reading in it; remove the file, or leave out --speed")),
        }
    }

    fn at_start(path: &Path) -> Result<Self, SourceError> {
        let file = File::open(path).map_err(|e| SourceError::file(path, e.to_string()))?;
        Ok(Self { path: path.to_owned(), lines: BufReader::new(file).lines(), n_lines: 0 })
    }

    fn read(&mut self) -> Result<Option<Speed>, String> {
        for line in self.lines.by_ref() {
            self.n_lines += 1;
            let line = line.map_err(|e| format!("line {}: {e}", self.n_lines))?;
            let text = line.split('#').next().unwrap_or_default().trim();
            if !text.is_empty() {
                return parse(text).map(Some).map_err(|reason| format!("line {}: {reason}", self.n_lines));
            }
        }
        Ok(None)
    }
}

impl Iterator for SpeedFile {
    type Item = Speed;

    /// The readings end where the file was spoilt after it was checked.
    fn next(&mut self) -> Option<Speed> {
        self.read().unwrap_or_else(|reason| {
            log::warn!("reading {}: {reason}; the readings end here", self.path.display());
            None
        })
    }
}

fn parse(text: &str) -> Result<Speed, String> {
    let numbers: Vec<f64> = text.split_whitespace().map_while(|word| word.parse().ok()).collect();
    let [time_s, metres_per_second, sigma] = numbers[..] else {
        return Err(format!("\"{text}\" is not three numbers: time in s, speed in m/s, its standard deviation in m/s"));
    };
    if text.split_whitespace().count() != 3 {
        return Err(format!("\"{text}\" has more than time, speed and standard deviation"));
    }
    if !(0.0..1e9).contains(&time_s) {
        return Err(format!("{time_s} s is not a time from 0 on, on the clock of the frames"));
    }
    if metres_per_second.is_nan() || metres_per_second.abs() > MAX_SPEED_M_PER_S {
        return Err(format!("{metres_per_second} m/s is not a speed of at most {MAX_SPEED_M_PER_S} m/s"));
    }
    if !(sigma > 0.0 && sigma <= MAX_SPEED_M_PER_S) {
        return Err(format!("{sigma} m/s is not a standard deviation above 0"));
    }
    Ok(Speed { timestamp_ns: (time_s * NS_PER_S).round() as u64, metres_per_second, standard_deviation: sigma })
}

/// A source with readings of the vehicle's speed beside its frames.
pub struct WithSpeed<Source> {
    source: Source,
    readings: Option<Box<dyn Iterator<Item = Speed>>>,
    ahead: Option<Speed>,
}

impl<Source: FrameSource> WithSpeed<Source> {
    /// Puts both together; `None` tells of no speed.
    pub fn new(source: Source, readings: Option<Box<dyn Iterator<Item = Speed>>>) -> Self {
        Self { source, readings, ahead: None }
    }

    /// The source without its readings.
    pub fn into_source(self) -> Source {
        self.source
    }
}

impl<Source: FrameSource> FrameSource for WithSpeed<Source> {
    fn format(&self) -> SourceFormat {
        self.source.format()
    }

    fn next_frame(&mut self, pixels: &mut [u8]) -> Result<Option<FrameInfo>, SourceError> {
        self.source.next_frame(pixels)
    }

    fn next_speed(&mut self, until_ns: u64) -> Option<Speed> {
        let next = self.ahead.take().or_else(|| self.readings.as_mut()?.next());
        self.ahead = next.filter(|reading| reading.timestamp_ns > until_ns);
        next.filter(|reading| reading.timestamp_ns <= until_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn open(text: &str) -> Result<Vec<(u64, f64, f64)>, String> {
        let file = tempfile::NamedTempFile::new().expect("a temporary file");
        std::fs::write(file.path(), text).expect("a temporary file");
        let readings = SpeedFile::open(file.path()).map_err(|e| e.to_string())?;
        Ok(readings.map(|r| (r.timestamp_ns, r.metres_per_second, r.standard_deviation)).collect())
    }

    #[test]
    fn readings_come_as_they_stand_in_the_file() {
        let found = open("# t v sigma\n0.5 9.25 0.1\n\n0.6 -1 0.2 # reverse gear\n");
        assert_eq!(found, Ok(vec![(500_000_000, 9.25, 0.1), (600_000_000, -1.0, 0.2)]));
    }

    #[test]
    fn a_line_that_cannot_be_believed_is_named() {
        let check = |text: &str, parts: [&str; 2]| {
            let problem = open(text).expect_err(text);
            assert!(parts.iter().all(|part| problem.contains(part)), "{text}: {problem}");
        };
        check("0 1 0.1\n0.1 NaN 0.1\n", ["line 2", "not a speed"]);
        check("0 1 0.1\n0.1 300 0.1\n", ["line 2", "not a speed"]);
        check("0.2 1 0.1\n0.1 1 0.1\n", ["line 2", "sort the lines"]);
        check("0.1 1 0.1\n0.1 1 0.1\n", ["line 2", "backwards"]);
        check("0.1 1\n", ["line 1", "three numbers"]);
        check("0.1 1 0.1 7\n", ["line 1", "three numbers"]);
        check("0.1 1 0.1 m/s\n", ["line 1", "more than"]);
        check("0.1 1 0\n", ["line 1", "standard deviation"]);
        check("0.1 1 inf\n", ["line 1", "standard deviation"]);
        check("-1 1 0.1\n", ["line 1", "clock of the frames"]);
        check("# nothing\n", ["no reading", "leave out --speed"]);
    }

    #[test]
    fn readings_wait_for_their_frame() {
        let reading = |timestamp_ns| Speed { timestamp_ns, ..Speed::default() };
        let readings = [10, 20, 30, 40].map(reading).into_iter();
        let mut source = WithSpeed::new(NoFrames, Some(Box::new(readings) as Box<_>));
        let mut until = |ns| std::iter::from_fn(|| source.next_speed(ns)).map(|r| r.timestamp_ns).collect::<Vec<_>>();
        assert_eq!(
            [until(5), until(20), until(20), until(39), until(99)],
            [vec![], vec![10, 20], vec![], vec![30], vec![40]]
        );
    }

    struct NoFrames;

    impl FrameSource for NoFrames {
        fn format(&self) -> SourceFormat {
            unreachable!("nobody asks")
        }

        fn next_frame(&mut self, _pixels: &mut [u8]) -> Result<Option<FrameInfo>, SourceError> {
            Ok(None)
        }
    }
}
