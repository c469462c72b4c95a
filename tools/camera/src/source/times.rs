//! When each frame was taken.

use std::path::Path;

use kilogs_core::conventions::TimestampNs;

use super::SourceError;

const NS_PER_S: f64 = 1e9;

/// Reads `times.txt`: one time per line, s, rising.
pub(super) fn read_times(path: &Path) -> Result<Vec<TimestampNs>, SourceError> {
    let text = std::fs::read_to_string(path).map_err(|e| {
        SourceError::file(path, format!("{e}; give the frame rate with --fps where the recording has no times"))
    })?;
    parse_times(&text).map_err(|reason| SourceError::file(path, format!("{reason}; mend the file or give --fps")))
}

/// Times of frames at a constant rate.
pub(super) fn times_at_rate(fps: f64, n_frames: usize) -> Result<Vec<TimestampNs>, SourceError> {
    if !(fps.is_finite() && fps > 0.0 && fps <= 1e6) {
        return Err(SourceError::Range(format!("--fps {fps} is not a frame rate above 0, for example 10")));
    }
    Ok((0..n_frames).map(|index| (index as f64 / fps * NS_PER_S).round() as TimestampNs).collect())
}

/// Brings times and images together: line i belongs to image i, or to the image with number i where the folder is a
/// part of a longer recording.
pub(super) fn assign_times(
    times_path: &Path,
    times: Vec<TimestampNs>,
    image_numbers: &[Option<u64>],
) -> Result<Vec<TimestampNs>, SourceError> {
    if times.len() == image_numbers.len() {
        return Ok(times);
    }
    let by_number: Option<Vec<TimestampNs>> =
        image_numbers.iter().map(|number| times.get(usize::try_from((*number)?).ok()?).copied()).collect();
    by_number.ok_or_else(|| {
        let (n_times, n_images) = (times.len(), image_numbers.len());
        SourceError::file(
            times_path,
            format!("{n_times} times for {n_images} images, and the images' numbers are no lines of it either; mend the file or give --fps"),
        )
    })
}

fn parse_times(text: &str) -> Result<Vec<TimestampNs>, String> {
    let mut times = Vec::new();
    let mut previous_s = f64::NEG_INFINITY;
    for (line, number) in text.lines().zip(1..).filter(|(line, _)| !line.trim().is_empty()) {
        let time_s: f64 = line.trim().parse().map_err(|_| format!("line {number}: \"{line}\" is not a time in s"))?;
        if !(time_s.is_finite() && time_s >= 0.0) {
            return Err(format!("line {number}: {time_s} s is not a time from 0 on"));
        }
        let time_ns = (time_s * NS_PER_S).round() as TimestampNs;
        if times.last().is_some_and(|&previous_ns| time_ns <= previous_ns) {
            return Err(format!("line {number}: time goes backwards, {time_s} s is not after {previous_s} s"));
        }
        previous_s = time_s;
        times.push(time_ns);
    }
    Ok(times)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_read_to_the_nanosecond() {
        assert_eq!(parse_times("0.0\n1.037359e-01\n\n2\n"), Ok(vec![0, 103_735_900, 2_000_000_000]));
        assert_eq!(parse_times(""), Ok(vec![]));
    }

    #[test]
    fn a_bad_time_is_named_by_its_line() {
        let check = |text: &str, expected: &str| {
            let reason = parse_times(text).expect_err("a bad time");
            assert!(reason.contains(expected), "{reason}");
        };
        check("0\n1\n1\n", "line 3: time goes backwards, 1 s is not after 1 s");
        check("0\n\n2\n1\n", "line 4: time goes backwards");
        check("0\nNaN\n", "line 2: NaN s");
        check("inf\n", "line 1: inf s");
        check("-1\n", "line 1: -1 s");
        check("0\nabc\n", "line 2: \"abc\"");
    }

    #[test]
    fn a_rate_must_be_one() {
        assert_eq!(times_at_rate(10.0, 3).ok(), Some(vec![0, 100_000_000, 200_000_000]));
        for fps in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(times_at_rate(fps, 3).is_err(), "{fps}");
        }
    }

    #[test]
    fn times_go_to_images_by_order_or_by_number() {
        let check = |n_times: u64, numbers: &[u64], expected: Option<&[u64]>| {
            let times = (0..n_times).map(|i| 100 + i).collect();
            let numbers: Vec<Option<u64>> = numbers.iter().map(|&number| Some(number)).collect();
            let assigned = assign_times(Path::new("times.txt"), times, &numbers);
            assert_eq!(assigned.ok().as_deref(), expected);
        };
        check(2, &[7, 8], Some(&[100, 101]));
        check(9, &[7, 8], Some(&[107, 108]));
        check(8, &[7, 8], None);
        check(1, &[0, 1], None);
        let unnumbered = assign_times(Path::new("times.txt"), vec![1, 2], &[None]);
        assert!(unnumbered.is_err_and(|e| e.to_string().contains("2 times for 1 images")));
    }
}
