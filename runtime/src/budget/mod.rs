//! How much memory the program may use, decided before the wheels turn.
//!
//! A [`Budget`] is a file: one capacity per container, one cap per kind of memory. A [`Plan`] is what these
//! capacities cost for a given camera. Every container is built from `budget.capacity(Row::...)`, and nothing
//! grows afterwards.

mod capacities;
mod bytes_each;
mod command;
mod human_size;
mod parse;
mod plan;
mod rows;
mod usage;

pub use bytes_each::{ComputeMemory, MappingPlan, PlanInput, row_behind_buffer};
pub use command::{BudgetArgs, PlanCameraArgs, run};
pub use human_size::{HumanBytes, NotASize, parse_bytes};
pub use plan::{Domain, Plan, PlanRow};
pub use rows::{Location, ROWS, Row, RowSpec, WhenFull};
pub use usage::Usage;

use std::path::{Path, PathBuf};

/// The budget files that are part of the binary; the first is the default.
pub const PROFILES: [(&str, &str); 3] = [
    ("memory_budget.toml", include_str!("../../../memory_budget.toml")),
    ("1080p-2gib.toml", include_str!("../../profiles/1080p-2gib.toml")),
    ("tiny.toml", include_str!("../../profiles/tiny.toml")),
];

/// What a file grants one row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Entry {
    /// How many elements.
    pub capacity: u64,
    /// Where they lie.
    pub location: Location,
    /// What happens to the one that does not fit.
    pub when_full: WhenFull,
}

/// A budget file, read and checked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Budget {
    file: String,
    host_bytes: u64,
    device_bytes: u64,
    /// In the order of [`ROWS`].
    entries: Vec<Entry>,
}

impl Budget {
    /// Reads `file`; without one `memory_budget.toml` of the current folder, and the built-in default where there is none.
    ///
    /// The name of a built-in profile (see [`PROFILES`]) is taken from the binary when no such file exists.
    ///
    /// # Errors
    /// [`BudgetError`] naming file, row and what to write instead.
    pub fn load(file: Option<&Path>) -> Result<Self, BudgetError> {
        let path = file.unwrap_or_else(|| Path::new(PROFILES[0].0));
        match std::fs::read_to_string(path) {
            Ok(text) => Self::parse(&text, &path.display().to_string()),
            Err(error) => match PROFILES.iter().find(|(name, _)| Path::new(name) == path) {
                Some((name, text)) if error.kind() == std::io::ErrorKind::NotFound => Self::parse(text, name),
                _ => Err(BudgetError::Unreadable { file: path.to_owned(), source: error }),
            },
        }
    }

    /// The shipped default: KITTI size in 512 MiB.
    ///
    /// # Errors
    /// Never for a released binary: a test reads every built-in profile.
    pub fn builtin() -> Result<Self, BudgetError> {
        let (name, text) = PROFILES[0];
        Self::parse(text, name)
    }

    /// Reads the text of a budget file; `file` is its name in messages.
    ///
    /// # Errors
    /// [`BudgetError`] naming file, row and what to write instead.
    pub fn parse(text: &str, file: &str) -> Result<Self, BudgetError> {
        parse::parse(text, file)
    }

    /// The same budget with room for another number of Gaussians: the rows that follow from it change in proportion.
    ///
    /// # Errors
    /// [`BudgetError::Row`] when a row would leave its range.
    pub fn with_max_gaussians(&self, max_gaussians: usize) -> Result<Self, BudgetError> {
        let per_anchor = self.capacity(Row::MapGaussiansPerAnchor).max(1);
        let (before, after) = (self.capacity(Row::MapAnchors).max(1), max_gaussians.div_ceil(per_anchor));
        let mut changed = self.clone();
        let following = [Row::MapVoxels, Row::SplatVisibleGaussians, Row::SplatRowEntries, Row::SplatPairs];
        for row in [Row::MapAnchors].into_iter().chain(following) {
            let scaled = u128::from(self.entry(row).capacity) * after as u128 / before as u128;
            let capacity = u64::try_from(scaled).unwrap_or(u64::MAX);
            let range = &row.spec().range;
            if !range.contains(&capacity) {
                let (least, most) = (*range.start(), *range.end());
                return Err(BudgetError::Scaled { max_gaussians, row, capacity, least, most });
            }
            changed.entries[row as usize].capacity = capacity;
        }
        let new_anchors = &mut changed.entries[Row::MapNewAnchors as usize];
        new_anchors.capacity = new_anchors.capacity.min(after as u64);
        Ok(changed)
    }

    /// The same for a map whose anchors have so many Gaussians.
    #[must_use]
    pub fn with_gaussians_per_anchor(&self, gaussians_per_anchor: u32) -> Self {
        let mut changed = self.clone();
        changed.entries[Row::MapGaussiansPerAnchor as usize].capacity = u64::from(gaussians_per_anchor);
        changed
    }

    /// Where the budget came from.
    pub fn file(&self) -> &str {
        &self.file
    }

    /// What the file grants a row.
    pub fn entry(&self, row: Row) -> Entry {
        self.entries[row as usize]
    }

    /// How many elements a row may hold.
    pub fn capacity(&self, row: Row) -> usize {
        usize::try_from(self.entry(row).capacity).unwrap_or(usize::MAX)
    }

    /// Cap of this process, the shared frames and the capture process together.
    pub fn host_bytes(&self) -> u64 {
        self.host_bytes
    }

    /// Cap of a compute device with its own memory.
    pub fn device_bytes(&self) -> u64 {
        self.device_bytes
    }
}

/// Why a budget cannot be used. Every text names the file, the row and what to do; the exit code is 2.
#[derive(Debug, thiserror::Error)]
pub enum BudgetError {
    /// The file is not there or not readable.
    #[error(
        "reading the budget {}: {source}; give another with --budget FILE, or leave the option out for the built-in one",
        file.display()
    )]
    Unreadable {
        /// The file.
        file: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file is not TOML.
    #[error("{file}:{line}: not valid TOML: {reason}")]
    Syntax {
        /// The file.
        file: String,
        /// Line, from 1.
        line: usize,
        /// What the parser says.
        reason: String,
    },
    /// A section, a row or a key is not there.
    #[error("{file}: {row} is missing: {fix}")]
    Missing {
        /// The file.
        file: String,
        /// The section, row or key.
        row: String,
        /// What to write.
        fix: String,
    },
    /// A row says something that cannot be done.
    #[error("{file}:{line}: {row} {problem}: {fix}")]
    Row {
        /// The file.
        file: String,
        /// Line, from 1.
        line: usize,
        /// The row.
        row: String,
        /// What is wrong.
        problem: String,
        /// What to write instead.
        fix: String,
    },
    /// A number of Gaussians that asks too little or too much of a row.
    #[error(
        "--max-gaussians {max_gaussians}: [{row}] would get a capacity of {capacity}, which must be {least} to {most}"
    )]
    Scaled {
        /// What was asked for.
        max_gaussians: usize,
        /// The row that cannot follow.
        row: Row,
        /// What it would have to be.
        capacity: u64,
        /// Least that it can be.
        least: u64,
        /// Most that it can be.
        most: u64,
    },
    /// Rows that do not hold the keyframes that the settings want to train together.
    #[error(
        "{file}: [{row}] capacity {capacity} is too small for mapping.window = {window}: {why}; \
         write at least {needed}, or lower mapping.window"
    )]
    Window {
        /// The file.
        file: String,
        /// The row that is too small.
        row: Row,
        /// What it grants.
        capacity: u64,
        /// Keyframes that are trained together.
        window: usize,
        /// Least that it must grant.
        needed: usize,
        /// What for.
        why: &'static str,
    },
    /// The capacities cost more than the cap for this camera.
    #[error("{file}: {domain} memory: the plan needs {}, [total] {cap_key} is {}; {culprit}", HumanBytes(*needed), HumanBytes(*cap))]
    OverCap {
        /// The file.
        file: String,
        /// Which memory.
        domain: Domain,
        /// Key of the cap in `[total]`.
        cap_key: &'static str,
        /// Bytes the plan needs.
        needed: u64,
        /// Bytes the file allows.
        cap: u64,
        /// The row to change, and to what.
        culprit: String,
    },
}

#[cfg(test)]
mod tests;
