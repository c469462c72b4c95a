//! Numbers as text, the same bytes on every machine.

use kilogs_core::conventions::TimestampNs;
use std::fmt;

/// A timestamp in seconds with all its nanoseconds; integers only, so nothing is rounded.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Seconds(pub TimestampNs);

const NS_PER_S: u64 = 1_000_000_000;

impl fmt::Display for Seconds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{:09}", self.0 / NS_PER_S, self.0 % NS_PER_S)
    }
}

/// A coordinate with nine decimals, never a negative zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Coordinate(pub f64);

const HALF_LAST_DECIMAL: f64 = 0.5e-9;

impl fmt::Display for Coordinate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let value = if self.0.abs() <= HALF_LAST_DECIMAL { 0.0 } else { self.0 };
        write!(f, "{value:.9}")
    }
}

/// A measured number with three decimals, or nothing when it was not measured (NaN or infinite).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Measured(pub f32);

impl fmt::Display for Measured {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0.is_finite() { write!(f, "{:.3}", self.0) } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_one_spelling() {
        let check = |text: String, expected: &str| assert_eq!(text, expected);
        check(Seconds(1_700_000_000_000_000_001).to_string(), "1700000000.000000001");
        check(Seconds(103_600_000).to_string(), "0.103600000");
        check(Coordinate(-1e-12).to_string(), "0.000000000");
        check(Coordinate(-0.5e-9).to_string(), "0.000000000");
        check(Coordinate(-12.25).to_string(), "-12.250000000");
        check(Measured(1.23456).to_string(), "1.235");
        check(Measured(f32::NAN).to_string(), "");
    }
}
