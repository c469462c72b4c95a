//! Sizes as people write them: `384 MiB`, `2 GiB`, `4096`.

use std::fmt;

const UNITS: [(&str, u64); 4] = [("GiB", 1 << 30), ("MiB", 1 << 20), ("KiB", 1 << 10), ("B", 1)];

/// A text that is not a size.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("\"{0}\" is not a size; write a whole number and B, KiB, MiB or GiB, such as \"384 MiB\"")]
pub struct NotASize(pub String);

/// Bytes of a text such as `384 MiB` or `4096`.
///
/// # Errors
/// [`NotASize`] for anything but a whole number followed by nothing, `B`, `KiB`, `MiB` or `GiB`, and for a size
/// above 2^64 bytes.
pub fn parse_bytes(text: &str) -> Result<u64, NotASize> {
    let not_a_size = || NotASize(text.to_owned());
    let trimmed = text.trim();
    let (digits, unit_bytes) = UNITS
        .iter()
        .find_map(|(unit, bytes)| trimmed.strip_suffix(unit).map(|digits| (digits.trim_end(), *bytes)))
        .unwrap_or((trimmed, 1));
    if digits.is_empty() || !digits.bytes().all(|byte| byte.is_ascii_digit()) {
        return Err(not_a_size());
    }
    digits.parse::<u64>().ok().and_then(|count| count.checked_mul(unit_bytes)).ok_or_else(not_a_size)
}

/// Shows a number of bytes in the largest unit that keeps it at one or above.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HumanBytes(pub u64);

impl fmt::Display for HumanBytes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (unit, unit_bytes) =
            UNITS.iter().copied().find(|(_, unit_bytes)| self.0 >= *unit_bytes).unwrap_or(("B", 1));
        let text = if self.0.is_multiple_of(unit_bytes) {
            format!("{} {unit}", self.0 / unit_bytes)
        } else {
            format!("{:.1} {unit}", self.0 as f64 / unit_bytes as f64)
        };
        f.pad(&text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_as_written() {
        let check = |text: &str, expected: Option<u64>| assert_eq!(parse_bytes(text).ok(), expected, "{text:?}");
        check("384 MiB", Some(384 << 20));
        check("2GiB", Some(2 << 30));
        check(" 16 KiB ", Some(16 << 10));
        check("7 B", Some(7));
        check("4096", Some(4096));
        check("", None);
        check("MiB", None);
        check("-1 MiB", None);
        check("1.5 GiB", None);
        check("12 MB", None);
        check("99999999999 GiB", None);
    }

    #[test]
    fn sizes_are_shown_in_the_unit_that_fits() {
        let check = |bytes: u64, expected: &str| assert_eq!(HumanBytes(bytes).to_string(), expected);
        check(0, "0 B");
        check(1023, "1023 B");
        check(1024, "1 KiB");
        check(1536, "1.5 KiB");
        check(512 << 20, "512 MiB");
        check((2 << 30) + (512 << 20), "2.5 GiB");
        assert_eq!(format!("{:>8}", HumanBytes(1024)), "   1 KiB");
    }
}
