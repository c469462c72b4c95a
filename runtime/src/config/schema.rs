//! What each setting may be. `default.toml` says the same to people; a test compares the two.

use std::fmt;

/// One setting.
pub(super) struct Setting {
    pub(super) key: &'static str,
    pub(super) kind: Kind,
}

/// What values a setting takes.
pub(super) enum Kind {
    /// A number in a range.
    Number(Range),
    /// One of some words; `planned` ones are known but not available in this version.
    Choice { available: &'static [&'static str], planned: &'static [&'static str] },
    /// True or false; `planned` is the value that is not available in this version.
    Switch { planned: Option<bool> },
}

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
    const fn closed(low: f64, high: f64) -> Self {
        Self { low, low_belongs: true, high, high_belongs: true }
    }

    pub(super) fn contains(&self, value: f64) -> bool {
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

const fn choice(key: &'static str, available: &'static [&'static str], planned: &'static [&'static str]) -> Setting {
    Setting { key, kind: Kind::Choice { available, planned } }
}

const fn switch(key: &'static str, planned: Option<bool>) -> Setting {
    Setting { key, kind: Kind::Switch { planned } }
}

const fn number(key: &'static str, range: Range) -> Setting {
    Setting { key, kind: Kind::Number(range) }
}

/// Every setting, in the order of `default.toml`.
pub(super) const SETTINGS: &[Setting] = &[
    choice("tracking.pose_models", &["both", "essential", "pnp"], &[]),
    choice("tracking.dynamic_filter", &["off", "paper", "region"], &[]),
    choice("tracking.dense_fallback", &["off"], &["on"]),
    choice("tracking.bundle_adjustment", &["off", "on"], &[]),
    choice("tracking.matcher", &["classical"], &["xfeat", "disk"]),
    switch("mapping.enabled", None),
    number("mapping.resolution", Range::closed(0.125, 1.0)),
    switch("loop_closure.enabled", Some(true)),
];

impl Setting {
    pub(super) fn find(key: &str) -> Option<&'static Self> {
        SETTINGS.iter().find(|setting| setting.key == key)
    }

    /// Why `value` is not allowed, or nothing.
    pub(super) fn objection(&self, value: &toml::Value) -> Option<String> {
        match &self.kind {
            Kind::Number(range) => match as_number(value) {
                Some(number) if range.contains(number) => None,
                Some(_) => Some(format!("not in the range {range}")),
                None => Some(format!("not a number; the range is {range}")),
            },
            Kind::Choice { available, planned } => {
                let word = value.as_str().unwrap_or_default();
                if available.contains(&word) {
                    return None;
                }
                let possible = format!("write {}", available.join(" or "));
                let known = planned.contains(&word);
                Some(if known { not_available(&possible) } else { format!("not a choice; {possible}") })
            }
            Kind::Switch { planned } => match value.as_bool() {
                None => Some("neither true nor false".to_owned()),
                Some(on) if *planned == Some(on) => Some(not_available(&format!("write {}", !on))),
                Some(_) => None,
            },
        }
    }

    /// What `default.toml` has to say about the values of this setting.
    #[cfg(test)]
    pub(super) fn values_in_words(&self) -> String {
        match &self.kind {
            Kind::Number(range) => format!("Range {range}"),
            Kind::Choice { available, planned } => {
                let mut all: Vec<_> = available.iter().chain(*planned).copied().collect();
                all.sort_unstable();
                all.join(", ")
            }
            Kind::Switch { .. } => "One of true, false".to_owned(),
        }
    }
}

fn not_available(possible: &str) -> String {
    format!("not available in this version; {possible}")
}

/// Whole numbers are numbers too.
pub(super) fn as_number(value: &toml::Value) -> Option<f64> {
    value.as_float().or_else(|| value.as_integer().map(|integer| integer as f64))
}
