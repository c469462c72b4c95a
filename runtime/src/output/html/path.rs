//! The path of a trajectory file in the ground plane, with a bounded number of points.

use crate::output::OutputError;
use std::fs::File;
use std::io::{self, BufRead, BufReader};
use std::path::Path;

/// More points than a chart has pixels across.
const MAX_POINTS: usize = 4096;

/// Columns of x and z in a TUM file.
const X_COLUMN: usize = 1;
const Z_COLUMN: usize = 3;

/// Points `[x, z]`, m, of a TUM file: all of them, or evenly thinned; the last one is always there.
pub(super) fn thinned(path: &Path) -> Result<Vec<[f64; 2]>, OutputError> {
    let file = File::open(path).map_err(OutputError::read_back(path))?;
    read(BufReader::new(file)).map_err(OutputError::read_back(path))
}

fn read(lines: impl BufRead) -> io::Result<Vec<[f64; 2]>> {
    let mut points = Vec::with_capacity(MAX_POINTS + 1);
    let (mut stride, mut last) = (1, None);
    for (k, line) in lines.lines().enumerate() {
        let line = line?;
        let coordinate = |column: usize| line.split(' ').nth(column).and_then(|text| text.parse::<f64>().ok());
        let (Some(x), Some(z)) = (coordinate(X_COLUMN), coordinate(Z_COLUMN)) else {
            return Err(io::Error::other(format!("line {} is no pose", k + 1)));
        };
        last = Some([x, z]);
        if k % stride != 0 {
            continue;
        }
        if points.len() == MAX_POINTS {
            let mut place = 0;
            points.retain(|_| {
                place += 1;
                place % 2 == 1
            });
            stride *= 2;
        }
        points.push([x, z]);
    }
    if points.last() != last.as_ref() {
        points.extend(last);
    }
    Ok(points)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_path_is_thinned_evenly_and_keeps_its_ends() {
        for (n, n_kept, stride) in [(0, 0, 1), (1, 1, 1), (4096, 4096, 1), (4097, 2049, 2), (20_000, 2501, 8)] {
            let text: String = (0..n).map(|k| format!("0.1 {k}.0 5 -{k}.5 0 0 0 1\n")).collect();
            let points = read(text.as_bytes()).expect("a trajectory");
            assert_eq!(points.len(), n_kept, "{n}");
            assert_eq!(points.first().map(|p| p[0]), (n > 0).then_some(0.0));
            assert_eq!(points.last().map(|p| p[0]), (n > 0).then(|| f64::from(n - 1)));
            assert!(points.windows(2).rev().skip(1).all(|w| w[1][0] - w[0][0] == stride as f64), "{n}");
            assert!(points.iter().all(|p| p[1] == -(p[0] + 0.5)));
        }
        assert!(read("0.1 2 3\n".as_bytes()).is_err());
    }
}
