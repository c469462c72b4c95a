//! The tables of an output folder.

use crate::step::StepFailed;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// A table with a heading, cells between commas.
pub(super) struct Table {
    path: PathBuf,
    text: String,
}

impl Table {
    /// Reads a whole table.
    pub fn read(path: &Path) -> Result<Self, StepFailed> {
        let broken = |error| StepFailed::Broken(format!("reading {}: {error}", path.display()));
        Ok(Self { path: path.to_owned(), text: std::fs::read_to_string(path).map_err(broken)? })
    }

    /// The cells of these columns, row by row; a row that ends early has empty ones.
    pub fn rows<const N: usize>(&self, columns: [&str; N]) -> Result<impl Iterator<Item = [&str; N]>, StepFailed> {
        let mut lines = self.text.lines();
        let heading = lines.next().unwrap_or_default();
        let mut indices = [0; N];
        for (index, column) in indices.iter_mut().zip(columns) {
            *index = heading.split(',').position(|name| name == column).ok_or_else(|| {
                StepFailed::Broken(format!("reading {}: it has no column {column}", self.path.display()))
            })?;
        }
        Ok(lines.map(move |line| {
            let cells: Vec<&str> = line.split(',').collect();
            indices.map(|index| cells.get(index).copied().unwrap_or_default())
        }))
    }

    /// A cell as a number.
    pub fn number<Number: FromStr>(&self, cell: &str) -> Result<Number, StepFailed> {
        let broken = || StepFailed::Broken(format!("reading {}: \"{cell}\" is no number", self.path.display()));
        cell.parse().map_err(|_| broken())
    }
}
