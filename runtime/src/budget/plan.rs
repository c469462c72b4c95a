//! What a budget costs for a given camera, row by row, and whether that fits.

use super::bytes_each::{ComputeMemory, Cost, PlanInput, cost_each};
use super::human_size::HumanBytes;
use super::rows::{Location, ROWS, Row, WhenFull};
use super::{Budget, BudgetError};
use crate::mapping::PAGE_KEYFRAMES;
use std::fmt;

/// A kind of memory with a cap of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Domain {
    /// Resident memory of this process and of the capture process.
    Host,
    /// Memory of a compute device that has its own.
    Device,
}

impl Domain {
    fn cap_key(self) -> &'static str {
        match self {
            Self::Host => "host_bytes",
            Self::Device => "device_bytes",
        }
    }
}

impl fmt::Display for Domain {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Host => "host",
            Self::Device => "device",
        })
    }
}

/// One line of the plan.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PlanRow {
    /// Which row.
    pub row: Row,
    /// How many elements.
    pub capacity: u64,
    /// Bytes of one of them.
    pub bytes_each: u64,
    /// Bytes of all of them, once.
    pub bytes: u64,
    /// Where the file puts them.
    pub location: Location,
    /// What happens when it is full.
    pub when_full: WhenFull,
    host_bytes: u64,
    device_bytes: u64,
    arena_bytes: u64,
}

/// All rows with their costs.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    file: String,
    input: PlanInput,
    rows: Vec<PlanRow>,
    host_cap_bytes: u64,
    device_cap_bytes: u64,
}

impl Plan {
    /// Costs of `budget` for the camera and backend in `input`; does not judge them, see [`Plan::check`].
    pub fn compute(budget: &Budget, input: &PlanInput) -> Self {
        let rows = ROWS.iter().map(|spec| plan_row(spec.row, budget, input)).collect();
        Self {
            file: budget.file().to_owned(),
            input: *input,
            rows,
            host_cap_bytes: budget.host_bytes(),
            device_cap_bytes: budget.device_bytes(),
        }
    }

    /// Refuses a plan that does not fit.
    ///
    /// # Errors
    /// [`BudgetError::Window`] names the row that does not hold the mapper's window, [`BudgetError::OverCap`] the largest
    /// row of the memory that is too small, and the capacity that fits.
    pub fn check(&self) -> Result<(), BudgetError> {
        self.check_window()?;
        for (domain, cap) in [(Domain::Host, self.host_cap_bytes), (Domain::Device, self.device_cap_bytes)] {
            let needed = self.bytes_in(domain);
            if needed > cap {
                return Err(BudgetError::OverCap {
                    file: self.file.clone(),
                    domain,
                    cap_key: domain.cap_key(),
                    needed,
                    cap,
                    culprit: self.culprit(domain, needed, cap),
                });
            }
        }
        Ok(())
    }

    fn check_window(&self) -> Result<(), BudgetError> {
        let window = self.input.mapping.window;
        let needs = [
            (Row::MapKeyframeImages, window + 1, "a keyframe is pruned when it has left the window"),
            (
                Row::MapKeyframes,
                window + PAGE_KEYFRAMES as usize,
                "a page of keyframes leaves before their rows are taken",
            ),
        ];
        for (row, needed, why) in needs {
            let capacity = self.rows.iter().find(|planned| planned.row == row).map_or(0, |planned| planned.capacity);
            if capacity < needed as u64 {
                return Err(BudgetError::Window { file: self.file.clone(), row, capacity, window, needed, why });
            }
        }
        Ok(())
    }

    /// Every row, in the order of the data flow.
    pub fn rows(&self) -> &[PlanRow] {
        &self.rows
    }

    /// Planned bytes of host memory: both processes, each with its view of the shared frames.
    pub fn host_bytes(&self) -> u64 {
        self.bytes_in(Domain::Host)
    }

    /// Planned bytes of a device with its own memory; 0 when the backend has none.
    pub fn device_bytes(&self) -> u64 {
        self.bytes_in(Domain::Device)
    }

    /// Planned bytes of a device backend's arena, wherever it lies; 0 without a device.
    pub fn arena_bytes(&self) -> u64 {
        self.rows.iter().fold(0, |sum, row| sum.saturating_add(row.arena_bytes))
    }

    /// Planned bytes of shared memory, counted once.
    pub fn ipc_bytes(&self) -> u64 {
        let shared = self.rows.iter().filter(|row| row.location == Location::Ipc);
        shared.fold(0, |sum, row| sum.saturating_add(row.bytes))
    }

    fn bytes_in(&self, domain: Domain) -> u64 {
        self.rows.iter().fold(0, |sum, row| sum.saturating_add(row.bytes_in(domain)))
    }

    /// The row to change: the largest one, with the capacity at which the plan would fit if there is one.
    fn culprit(&self, domain: Domain, needed: u64, cap: u64) -> String {
        let raise = format!("raise {} to \"{} MiB\"", domain.cap_key(), needed.div_ceil(1 << 20));
        let Some(largest) = self.rows.iter().max_by_key(|row| row.bytes_in(domain)) else { return raise };
        let (row, bytes) = (largest.row, largest.bytes_in(domain));
        let others = needed.saturating_sub(bytes);
        let fitting = cap
            .checked_sub(others)
            .map(|room| u128::from(room) * u128::from(largest.capacity) / u128::from(bytes.max(1)));
        match fitting {
            Some(capacity) if capacity >= u128::from(*row.spec().range.start()) => {
                format!("[{row}] takes {}: set its capacity to at most {capacity}, or {raise}", HumanBytes(bytes))
            }
            _ => format!(
                "[{row}] takes most, {}, but lowering it is not enough: lower others too, or {raise}",
                HumanBytes(bytes)
            ),
        }
    }
}

impl PlanRow {
    fn bytes_in(&self, domain: Domain) -> u64 {
        match domain {
            Domain::Host => self.host_bytes,
            Domain::Device => self.device_bytes,
        }
    }
}

fn plan_row(row: Row, budget: &Budget, input: &PlanInput) -> PlanRow {
    let entry = budget.entry(row);
    let Cost { host, device, arena } = cost_each(row, budget, input);
    let of_all = |bytes: u64| bytes.saturating_mul(entry.capacity);
    let bytes_each = host + device;
    let bytes = of_all(bytes_each);
    // Shared pages count in the resident set of the process that writes them and of the one that reads them.
    let views = if entry.location == Location::Ipc { 2 } else { 1 };
    PlanRow {
        row,
        capacity: entry.capacity,
        bytes_each,
        bytes,
        location: entry.location,
        when_full: entry.when_full,
        host_bytes: of_all(host).saturating_mul(views),
        device_bytes: of_all(device),
        arena_bytes: of_all(arena),
    }
}

impl fmt::Display for Plan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let input = &self.input;
        writeln!(
            f,
            "Memory plan of {} for a camera of {} x {} px, {} a frame, training images at {} of that size\n",
            self.file,
            input.width,
            input.height,
            HumanBytes(input.frame_bytes),
            input.mapping.resolution
        )?;
        writeln!(
            f,
            "{:<27} {:>10} {:>10} {:>10}  {:<6} {:<16} one element is",
            "row", "capacity", "each", "bytes", "where", "when full"
        )?;
        for row in &self.rows {
            let counts_bytes = row.row.counts_bytes();
            let capacity = if counts_bytes { "-".to_owned() } else { row.capacity.to_string() };
            writeln!(
                f,
                "{:<27} {:>10} {:>10} {:>10}  {:<6} {:<16} {}",
                row.row,
                capacity,
                HumanBytes(row.bytes_each),
                HumanBytes(row.bytes),
                row.location.name(),
                row.when_full.name(),
                row.row.spec().element
            )?;
        }
        let judge = |needed: u64, cap: u64| if needed > cap { "DOES NOT FIT" } else { "fits" };
        let (host, device) = (self.host_bytes(), self.device_bytes());
        writeln!(
            f,
            "\nhost   {:>10} of {:>8}  {} (this process and the capture process; the {} of shared frames count in both)",
            HumanBytes(host),
            HumanBytes(self.host_cap_bytes),
            judge(host, self.host_cap_bytes),
            HumanBytes(self.ipc_bytes())
        )?;
        let own = match input.compute {
            ComputeMemory::Cpu => " (the CPU computes)".to_owned(),
            ComputeMemory::OwnDevice => format!(" (its arena is {})", HumanBytes(self.arena_bytes())),
            ComputeMemory::SharedDevice => {
                format!(
                    " (the device uses host memory: its arena of {} is counted there)",
                    HumanBytes(self.arena_bytes())
                )
            }
        };
        write!(
            f,
            "device {:>10} of {:>8}  {}{own}",
            HumanBytes(device),
            HumanBytes(self.device_cap_bytes),
            judge(device, self.device_cap_bytes)
        )
    }
}
