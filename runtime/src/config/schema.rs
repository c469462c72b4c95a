//! What a setting may be. `default.toml` says the same to people; a test compares the two.

use crate::settings::Settings;
use std::fmt;

/// One setting.
pub(super) struct Setting {
    pub(super) key: &'static str,
    pub(super) kind: Kind,
}

/// What values a setting takes, and how an allowed one is put into [`Settings`].
pub(super) enum Kind {
    /// A number in a range.
    Number { range: Range, put: fn(&mut Settings, f64) },
    /// A whole number in a range.
    Whole { range: Range, put: fn(&mut Settings, f64) },
    /// One of some words; `planned` ones are known but not available in this version.
    Choice { available: &'static [&'static str], planned: &'static [&'static str], put: fn(&mut Settings, &str) },
    /// True or false; `planned` is the value that is not available in this version.
    Switch { planned: Option<bool>, put: fn(&mut Settings, bool) },
    /// Any text.
    Text { put: fn(&mut Settings, &str) },
}

/// Types of the fields that numbers are put into; the range has made sure that they fit.
pub(super) trait Scalar {
    fn of(value: f64) -> Self;
}

macro_rules! scalars {
    ($($type:ty),*) => {$(
        impl Scalar for $type {
            fn of(value: f64) -> Self {
                value as Self
            }
        }
    )*};
}

scalars!(f32, f64, u8, u32, usize);

/// From `low` to `high`, with or without the ends.
#[derive(Clone, Copy)]
pub(super) struct Range {
    low: f64,
    low_belongs: bool,
    high: f64,
    high_belongs: bool,
}

impl Range {
    /// `[low, high]`.
    pub(super) const fn closed(low: f64, high: f64) -> Self {
        Self { low, low_belongs: true, high, high_belongs: true }
    }

    /// `(low, high]`.
    pub(super) const fn open_closed(low: f64, high: f64) -> Self {
        Self { low, low_belongs: false, high, high_belongs: true }
    }

    /// `[low, high)`.
    pub(super) const fn closed_open(low: f64, high: f64) -> Self {
        Self { low, low_belongs: true, high, high_belongs: false }
    }

    /// `(low, high)`.
    pub(super) const fn open(low: f64, high: f64) -> Self {
        Self { low, low_belongs: false, high, high_belongs: false }
    }

    fn contains(&self, value: f64) -> bool {
        let above = value > self.low || (self.low_belongs && value == self.low);
        let below = value < self.high || (self.high_belongs && value == self.high);
        above && below
    }
}

impl fmt::Display for Range {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let open = if self.low_belongs { '[' } else { '(' };
        let close = if self.high_belongs { ']' } else { ')' };
        write!(f, "{open}{}, {}{close}", self.low, self.high)
    }
}

impl Setting {
    /// Puts `value` into `settings`.
    ///
    /// # Errors
    /// Why the value is not allowed, and what is.
    pub(super) fn put(&self, settings: &mut Settings, value: &toml::Value) -> Result<(), String> {
        match &self.kind {
            Kind::Number { range, put } => {
                let number = as_number(value).ok_or_else(|| format!("not a number; the range is {range}"))?;
                within(range, number).map(|()| put(settings, number))
            }
            Kind::Whole { range, put } => {
                let number = value.as_integer().ok_or_else(|| format!("not a whole number; the range is {range}"))?;
                within(range, number as f64).map(|()| put(settings, number as f64))
            }
            Kind::Choice { available, planned, put } => {
                let word = value.as_str().unwrap_or_default();
                let possible = format!("write {}", available.join(" or "));
                match (available.contains(&word), planned.contains(&word)) {
                    (true, _) => {
                        put(settings, word);
                        Ok(())
                    }
                    (false, true) => Err(not_available(&possible)),
                    (false, false) => Err(format!("not a choice; {possible}")),
                }
            }
            Kind::Switch { planned, put } => match value.as_bool() {
                None => Err("neither true nor false".to_owned()),
                Some(on) if *planned == Some(on) => Err(not_available(&format!("write {}", !on))),
                Some(on) => {
                    put(settings, on);
                    Ok(())
                }
            },
            Kind::Text { put } => value.as_str().ok_or_else(|| "not a text".to_owned()).map(|text| put(settings, text)),
        }
    }

    /// What `default.toml` has to say about the values of this setting.
    #[cfg(test)]
    pub(super) fn values_in_words(&self) -> String {
        match &self.kind {
            Kind::Number { range, .. } | Kind::Whole { range, .. } => format!("Range {range}"),
            Kind::Choice { available, planned, .. } => {
                let mut all: Vec<_> = available.iter().chain(*planned).copied().collect();
                all.sort_unstable();
                all.join(", ")
            }
            Kind::Switch { .. } => "One of true, false".to_owned(),
            Kind::Text { .. } => "Any text".to_owned(),
        }
    }
}

fn within(range: &Range, number: f64) -> Result<(), String> {
    if range.contains(number) { Ok(()) } else { Err(format!("not in the range {range}")) }
}

fn not_available(possible: &str) -> String {
    format!("not available in this version; {possible}")
}

/// Whole numbers are numbers too.
fn as_number(value: &toml::Value) -> Option<f64> {
    value.as_float().or_else(|| value.as_integer().map(|integer| integer as f64))
}
