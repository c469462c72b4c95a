//! Intrinsics out of KITTI's `calib.txt`.

use std::path::Path;

use kilogs_core::conventions::PIXEL_CENTER_OFFSET;

use super::SourceError;
use crate::camera_file::Intrinsics;

/// Numbers of a projection row: a 3x4 matrix, row by row. The fourth column (where the camera sits in the rig) is ignored.
const ROW_NUMBERS: usize = 12;

/// Reads the first of `rows` that is present. Other rows are not looked at, damaged or not.
pub(super) fn read_intrinsics(path: &Path, rows: &[&str]) -> Result<Intrinsics, SourceError> {
    let text = std::fs::read_to_string(path).map_err(|e| {
        SourceError::camera(path, format!("{e}; a recording needs a calib.txt, or fx, fy, cx, cy in a camera.toml"))
    })?;
    parse_intrinsics(&text, rows).map_err(|reason| {
        SourceError::camera(path, format!("{reason}; mend the row, or give fx, fy, cx, cy in a camera.toml"))
    })
}

fn parse_intrinsics(text: &str, rows: &[&str]) -> Result<Intrinsics, String> {
    let Some((name, row)) = rows.iter().find_map(|name| Some((name, find_row(text, name)?))) else {
        return Err(format!("there is no row {}", rows.join(" or ")));
    };
    let numbers: Vec<f64> = row
        .split_whitespace()
        .map(|word| match word.parse::<f64>() {
            Ok(number) if number.is_finite() => Ok(number),
            _ => Err(format!("row {name}: \"{word}\" is not a number")),
        })
        .collect::<Result<_, _>>()?;
    let &[fx, _, cx, _, _, fy, cy, ..] = numbers.as_slice() else {
        return Err(format!("row {name} has {} numbers, {ROW_NUMBERS} are needed", numbers.len()));
    };
    if numbers.len() != ROW_NUMBERS {
        return Err(format!("row {name} has {} numbers, {ROW_NUMBERS} are needed", numbers.len()));
    }
    if !(fx > 0.0 && fy > 0.0) {
        return Err(format!("row {name}: focal lengths {fx} and {fy} px are not above 0"));
    }
    Ok(Intrinsics { fx, fy, cx: cx + PIXEL_CENTER_OFFSET, cy: cy + PIXEL_CENTER_OFFSET })
}

fn find_row<'text>(text: &'text str, name: &str) -> Option<&'text str> {
    text.lines().find_map(|line| line.trim().strip_prefix(name)?.strip_prefix(':'))
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD_P0: &str = "P0: 700 0 600 0 0 701 180 0 0 0 1 0\n";
    const GOOD_P2: &str = "P2: 800 0 610 45 0 801 190 0.2 0 0 1 0.003\n";
    const SHORT_P2: &str = "P2: 800 0 610 45 0 801 190 0.2 0 0 0.003\n";

    fn check(text: &str, rows: &[&str], expected: Result<[f64; 4], &str>) {
        let found = parse_intrinsics(text, rows).map(|i| [i.fx, i.fy, i.cx, i.cy]);
        match (&found, expected) {
            (Ok(found), Ok(expected)) => assert_eq!(*found, expected),
            (Err(reason), Err(part)) => assert!(reason.contains(part), "{reason}"),
            _ => panic!("{found:?} instead of {expected:?}"),
        }
    }

    #[test]
    fn pixel_centres_move_by_half_and_the_fourth_column_is_ignored() {
        check(GOOD_P0, &["P0"], Ok([700.0, 701.0, 600.5, 180.5]));
        check(GOOD_P2, &["P2"], Ok([800.0, 801.0, 610.5, 190.5]));
    }

    #[test]
    fn the_first_row_present_counts_and_damage_elsewhere_does_not_matter() {
        check(&[GOOD_P2, GOOD_P0].concat(), &["P0", "P2"], Ok([700.0, 701.0, 600.5, 180.5]));
        check(GOOD_P2, &["P0", "P2"], Ok([800.0, 801.0, 610.5, 190.5]));
        check(&[GOOD_P0, SHORT_P2].concat(), &["P0", "P2"], Ok([700.0, 701.0, 600.5, 180.5]));
    }

    #[test]
    fn damage_in_the_row_that_is_needed_is_named() {
        check(&[GOOD_P0, SHORT_P2].concat(), &["P2"], Err("row P2 has 11 numbers, 12 are needed"));
        check("P0: 700\n", &["P0"], Err("row P0 has 1 numbers"));
        check(&GOOD_P0.replace("180", "NaN"), &["P0"], Err("row P0: \"NaN\" is not a number"));
        check(&GOOD_P0.replace("700", "x"), &["P0"], Err("row P0: \"x\" is not a number"));
        check(&GOOD_P0.replace("700", "-700"), &["P0"], Err("focal lengths -700 and 701 px"));
        check(GOOD_P0, &["P2"], Err("there is no row P2"));
        check("", &["P0", "P2"], Err("there is no row P0 or P2"));
        check("P01: 1\n", &["P0"], Err("there is no row P0"));
    }
}
