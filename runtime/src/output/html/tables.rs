//! The figures of `report.json` as tiles and tables.

use super::Escaped;
use crate::budget::HumanBytes;
use crate::output::Report;
use crate::output::report::{MemoryRow, Percentiles};
use serde_json::Value;
use std::fmt;
use std::io::{self, Write};

/// A figure with so many decimals, or a dash when it is unknown.
pub(super) struct Figure(pub(super) Option<f64>, pub(super) usize);

impl fmt::Display for Figure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0.filter(|value| value.is_finite()) {
            Some(value) => write!(f, "{value:.*}", self.1),
            None => f.write_str("–"),
        }
    }
}

/// The figures that say at a glance how the run went.
pub(super) fn write_tiles(page: &mut impl Write, report: &Report) -> io::Result<()> {
    let (frames, memory) = (&report.frames, &report.memory);
    let bytes = |bytes: Option<u64>| bytes.map_or_else(|| "–".to_owned(), |bytes| HumanBytes(bytes).to_string());
    let cap = format!("of {} allowed", HumanBytes(memory.budget_host_bytes));
    let percentile = |p: Percentiles| (format!("{} ms", Figure(p.p50, 1)), format!("p95 {} ms", Figure(p.p95, 1)));
    let (median, p95) = percentile(report.time.tracking_ms);
    let not_tracked = format!("{} doubtful, {} lost, {} dropped", frames.doubtful, frames.lost, frames.dropped);
    let heldout = format!("held out {} dB", Figure(report.mapping.psnr_heldout_db, 2));
    writeln!(page, "<div class=\"tiles\">")?;
    for (name, value, detail) in [
        ("frames tracked", format!("{} / {}", frames.tracked, frames.received), not_tracked),
        (
            "path length",
            format!("{} m", Figure(Some(report.tracking.path_length_m), 1)),
            format!("{} keyframes", frames.keyframes),
        ),
        ("tracking, median", median, p95),
        ("peak memory", bytes(memory.rss_peak_bytes), cap),
        ("PSNR, training views", format!("{} dB", Figure(report.mapping.psnr_train_db, 2)), heldout),
        ("Gaussians", grouped(report.mapping.gaussians), format!("{} anchors", grouped(report.mapping.anchors_total))),
    ] {
        writeln!(page, "<div><span>{name}</span><b>{value}</b><small>{detail}</small></div>")?;
    }
    writeln!(page, "</div>")
}

/// Every figure of the report.
pub(super) fn write(page: &mut impl Write, report: &Report) -> io::Result<()> {
    let value = serde_json::to_value(report).map_err(io::Error::from)?;
    writeln!(page, "<section><h2>All figures</h2><div class=\"tables\">")?;
    for section in ["frames", "time", "memory", "tracking", "mapping", "backend"] {
        let Some(members) = value.get(section).and_then(Value::as_object) else { continue };
        writeln!(page, "<table><caption>{section}</caption><tbody>")?;
        for (key, member) in members {
            match member {
                Value::Object(parts) => {
                    for (part, number) in parts {
                        row(page, &format!("{key}.{part}"), key, number)?;
                    }
                }
                Value::Array(_) => {}
                other => row(page, key, key, other)?,
            }
        }
        writeln!(page, "</tbody></table>")?;
    }
    writeln!(page, "</div></section>")?;
    write_plan(page, &report.memory.plan)
}

fn row(page: &mut impl Write, name: &str, key: &str, value: &Value) -> io::Result<()> {
    let text = match value {
        Value::Null => "–".to_owned(),
        Value::String(text) => Escaped(text).to_string(),
        Value::Number(number) => match number.as_u64() {
            Some(bytes) if key.ends_with("_bytes") => HumanBytes(bytes).to_string(),
            Some(count) => grouped(count),
            None => Figure(number.as_f64(), 3).to_string(),
        },
        other => other.to_string(),
    };
    writeln!(page, "<tr><th>{name}</th><td>{text}</td></tr>")
}

/// The memory plan with a bar per row: planned bytes, and how much of them was ever used.
fn write_plan(page: &mut impl Write, plan: &[MemoryRow]) -> io::Result<()> {
    if plan.is_empty() {
        return Ok(());
    }
    let largest = plan.iter().map(|row| row.bytes).max().unwrap_or(0).max(1);
    let of_largest = |part: u64| part as f64 / largest as f64;
    writeln!(
        page,
        "<section><h2>Memory plan</h2><table class=\"plan\"><thead><tr><th>row</th><th>where</th><th>when full</th>\
         <th>planned</th><th>used at most</th><th>planned (light) and used (dark)</th></tr></thead><tbody>"
    )?;
    for row in plan {
        writeln!(
            page,
            "<tr><th>{}</th><td>{}</td><td>{}</td><td class=\"number\">{}</td><td class=\"number\">{}</td>\
             <td class=\"bar\"><i style=\"--part:{:.4}\"></i><b style=\"--part:{:.4}\"></b></td></tr>",
            Escaped(&row.row),
            Escaped(&row.location),
            Escaped(&row.when_full),
            HumanBytes(row.bytes),
            row.used_peak.map_or_else(|| "–".to_owned(), |bytes| HumanBytes(bytes).to_string()),
            of_largest(row.bytes),
            of_largest(row.used_peak.unwrap_or(0).min(row.bytes)),
        )?;
    }
    writeln!(page, "</tbody></table></section>")
}

/// Digits in groups of three, with a thin space that does not break.
fn grouped(count: u64) -> String {
    let digits = count.to_string();
    let mut text = String::with_capacity(digits.len() + digits.len() / 3 * '\u{202f}'.len_utf8());
    for (k, digit) in digits.chars().enumerate() {
        if k > 0 && (digits.len() - k).is_multiple_of(3) {
            text.push('\u{202f}');
        }
        text.push(digit);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_come_in_threes_and_the_unknown_is_a_dash() {
        for (count, expected) in [(0, "0"), (999, "999"), (1000, "1 000"), (1_234_567, "1 234 567")] {
            assert_eq!(grouped(count).replace('\u{202f}', " "), expected);
        }
        assert_eq!(Figure(None, 2).to_string(), "–");
        assert_eq!(Figure(Some(f64::INFINITY), 2).to_string(), "–");
        assert_eq!(Figure(Some(17.256), 2).to_string(), "17.26");
    }
}
