//! Reads a budget file strictly: what it does not know is an error, and so is what it cannot keep.

use super::capacities::contradiction;
use super::human_size::parse_bytes;
use super::rows::{Location, ROWS, Row, RowSpec, WhenFull};
use super::{Budget, BudgetError, Entry};
use std::ops::Range;
use toml::de::{DeTable, DeValue};
use toml::{Spanned, map::Map};

type Table<'t> = Map<Spanned<std::borrow::Cow<'t, str>>, Spanned<DeValue<'t>>>;

const TOTAL_KEYS: [&str; 2] = ["host_bytes", "device_bytes"];
const ROW_KEYS: [&str; 4] = ["capacity", "where", "when_full", "why"];

/// Reads the text of a budget file; `file` is its name in error messages.
///
/// # Errors
/// [`BudgetError`] naming file, line, row and what to write instead.
pub(super) fn parse(text: &str, file: &str) -> Result<Budget, BudgetError> {
    let reader = Reader { text, file };
    let document = DeTable::parse(text).map_err(|error| {
        let line = error.span().map_or(1, |span| reader.line(&span));
        BudgetError::Syntax { file: file.to_owned(), line, reason: error.message().to_owned() }
    })?;
    let document = document.get_ref();
    reader.refuse_unknown_sections(document)?;
    let total = reader.table(document, "total")?;
    reader.refuse_unknown_keys(total, "[total]", &TOTAL_KEYS)?;
    let mut entries = Vec::with_capacity(Row::COUNT);
    for spec in &ROWS {
        entries.push(reader.row(document, spec)?);
    }
    let budget = Budget {
        file: file.to_owned(),
        host_bytes: reader.total_bytes(total, "host_bytes")?,
        device_bytes: reader.total_bytes(total, "device_bytes")?,
        entries,
    };
    match contradiction(&budget) {
        None => Ok(budget),
        Some((row, problem, fix)) => {
            let line = reader.line_of_row(document, row);
            Err(BudgetError::Row { file: file.to_owned(), line, row: format!("[{row}]"), problem, fix })
        }
    }
}

struct Reader<'t> {
    text: &'t str,
    file: &'t str,
}

impl Reader<'_> {
    fn line(&self, span: &Range<usize>) -> usize {
        self.text.bytes().take(span.start).filter(|byte| *byte == b'\n').count() + 1
    }

    /// Line of the row's capacity.
    fn line_of_row(&self, document: &Table<'_>, row: Row) -> usize {
        let spec = row.spec();
        let section = document.get(spec.section).map(Spanned::get_ref);
        let capacity = section.and_then(|section| section.get(spec.name)?.get_ref().get("capacity"));
        capacity.map_or(1, |value| self.line(&value.span()))
    }

    fn bad<T>(&self, value: &Spanned<T>, row: &str, problem: String, fix: String) -> BudgetError {
        BudgetError::Row {
            file: self.file.to_owned(),
            line: self.line(&value.span()),
            row: row.to_owned(),
            problem,
            fix,
        }
    }

    fn missing(&self, row: &str, fix: String) -> BudgetError {
        BudgetError::Missing { file: self.file.to_owned(), row: row.to_owned(), fix }
    }

    fn refuse_unknown_sections(&self, document: &Table<'_>) -> Result<(), BudgetError> {
        for (key, value) in document {
            let section = key.get_ref().as_ref();
            if section == "total" {
                continue;
            }
            let names: Vec<_> = ROWS.iter().filter(|spec| spec.section == section).map(|spec| spec.name).collect();
            let row = format!("[{section}]");
            if names.is_empty() {
                let mut known: Vec<_> = ROWS.iter().map(|spec| spec.section).collect();
                known.dedup();
                let fix = format!("remove it; the sections are total, {}", known.join(", "));
                return Err(self.bad(key, &row, "unknown section".to_owned(), fix));
            }
            let Some(table) = value.get_ref().as_table() else {
                let fix = format!("write [{section}.{}] and its capacity", names[0]);
                return Err(self.bad(key, &row, "is not a table".to_owned(), fix));
            };
            self.refuse_unknown_keys(table, &row, &names)?;
        }
        Ok(())
    }

    fn refuse_unknown_keys(&self, table: &Table<'_>, row: &str, known: &[&str]) -> Result<(), BudgetError> {
        match table.keys().find(|key| !known.contains(&key.get_ref().as_ref())) {
            None => Ok(()),
            Some(key) => {
                let fix = format!("remove it; known are {}", known.join(", "));
                Err(self.bad(key, row, format!("unknown key \"{}\"", key.get_ref()), fix))
            }
        }
    }

    fn table<'d, 'v>(&self, parent: &'d Table<'v>, name: &str) -> Result<&'d Table<'v>, BudgetError> {
        parent
            .get(name)
            .and_then(|value| value.get_ref().as_table())
            .ok_or_else(|| self.missing(&format!("[{name}]"), format!("add a table [{name}]")))
    }

    fn total_bytes(&self, total: &Table<'_>, key: &str) -> Result<u64, BudgetError> {
        let fix = format!("write {key} = \"512 MiB\" or another size above zero");
        let value = total.get(key).ok_or_else(|| self.missing(&format!("[total] {key}"), fix.clone()))?;
        let bytes = self.number(value, "[total]", key, true)?;
        if bytes == 0 {
            return Err(self.bad(value, "[total]", format!("{key} is zero"), fix));
        }
        Ok(bytes)
    }

    fn row(&self, document: &Table<'_>, spec: &'static RowSpec) -> Result<Entry, BudgetError> {
        let row = format!("[{}.{}]", spec.section, spec.name);
        let absent =
            || self.missing(&row, format!("add it with {}; one element is {}", ROW_KEYS.join(", "), spec.element));
        let section = document.get(spec.section).and_then(|value| value.get_ref().as_table()).ok_or_else(absent)?;
        let table = section.get(spec.name).and_then(|value| value.get_ref().as_table()).ok_or_else(absent)?;
        self.refuse_unknown_keys(table, &row, &ROW_KEYS)?;
        let field = |key: &str| {
            table.get(key).ok_or_else(|| self.missing(&format!("{row} {key}"), format!("add a line {key} = ...")))
        };
        let why = field("why")?;
        if why.get_ref().as_str().is_none_or(|text| text.trim().is_empty()) {
            let fix = "say in a sentence where the capacity comes from".to_owned();
            return Err(self.bad(why, &row, "why is empty".to_owned(), fix));
        }
        Ok(Entry {
            capacity: self.capacity(field("capacity")?, &row, spec)?,
            location: self.location(field("where")?, &row, spec)?,
            when_full: self.when_full(field("when_full")?, &row, spec)?,
        })
    }

    fn capacity(&self, value: &Spanned<DeValue<'_>>, row: &str, spec: &RowSpec) -> Result<u64, BudgetError> {
        let capacity = self.number(value, row, "capacity", spec.row.counts_bytes())?;
        if spec.range.contains(&capacity) {
            return Ok(capacity);
        }
        let problem = match capacity {
            0 => "capacity is zero".to_owned(),
            _ => format!("capacity {capacity} is out of range"),
        };
        Err(self.bad(value, row, problem, choices(&spec.range)))
    }

    fn number(&self, value: &Spanned<DeValue<'_>>, row: &str, key: &str, is_size: bool) -> Result<u64, BudgetError> {
        let fix = match is_size {
            true => format!("write a size such as {key} = \"30 MiB\""),
            false => format!("write a whole number such as {key} = 4096"),
        };
        match value.get_ref() {
            DeValue::Integer(integer) => i128::from_str_radix(integer.as_str(), integer.radix())
                .ok()
                .and_then(|number| u64::try_from(number).ok())
                .ok_or_else(|| {
                    let negative = integer.as_str().starts_with('-');
                    let problem = if negative { "is negative" } else { "is too large" };
                    self.bad(value, row, format!("{key} {} {problem}", integer.as_str()), fix)
                }),
            DeValue::String(text) if is_size => {
                parse_bytes(text).map_err(|not_a_size| self.bad(value, row, format!("{key}: {not_a_size}"), fix))
            }
            other => Err(self.bad(value, row, format!("{key} is a {}", other.type_str()), fix)),
        }
    }

    fn location(&self, value: &Spanned<DeValue<'_>>, row: &str, spec: &RowSpec) -> Result<Location, BudgetError> {
        let written = value.get_ref().as_str().unwrap_or_default();
        let known = Location::ALL.into_iter().find(|location| location.name() == written);
        match known {
            Some(location) if spec.locations.contains(&location) => Ok(location),
            _ => {
                let allowed: Vec<_> = spec.locations.iter().map(|location| location.name()).collect();
                let problem = format!("where = \"{written}\" is not possible for this row");
                Err(self.bad(value, row, problem, format!("write {}", allowed.join(" or "))))
            }
        }
    }

    fn when_full(&self, value: &Spanned<DeValue<'_>>, row: &str, spec: &RowSpec) -> Result<WhenFull, BudgetError> {
        let written = value.get_ref().as_str().unwrap_or_default();
        match WhenFull::ALL.into_iter().find(|policy| policy.name() == written) {
            Some(policy) if policy == spec.when_full => Ok(policy),
            Some(_) => {
                let problem = format!("when_full = \"{written}\" is not what this container can do");
                Err(self.bad(value, row, problem, format!("write \"{}\"", spec.when_full.name())))
            }
            None => {
                let problem = format!("when_full = \"{written}\" is no policy");
                Err(self.bad(value, row, problem, format!("write \"{}\"", spec.when_full.name())))
            }
        }
    }
}

fn choices(range: &std::ops::RangeInclusive<u64>) -> String {
    match (range.start(), range.end()) {
        (only, end) if only == end => format!("choose {only}: this version is built for exactly that"),
        (start, end) => format!("choose {start} to {end}"),
    }
}
