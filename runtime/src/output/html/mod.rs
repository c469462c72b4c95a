//! `report.html`: the run for people, in one file that needs no network and no script.
//!
//! The page is streamed: charts are small, and pictures go through memory one after the other.

mod charts;
mod path;
mod tables;

use super::{DriveChart, OutputError, RenderedKeyframe, Report, STAGES};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use std::fmt::{self, Display};
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

const STYLE: &str = include_str!("style.css");

/// Pictures that the page embeds at most; more are thinned evenly.
const MAX_PICTURES: usize = 12;

/// Name of the page in an output folder.
const REPORT_HTML: &str = "report.html";

/// Writes `report.html` into the output folder, whose trajectory files are already there.
///
/// # Errors
/// [`OutputError`] when the disk does not take it, or a file of the run cannot be read back.
pub fn write_html(
    dir: &Path,
    report: &Report,
    chart: &DriveChart,
    pictures: &[RenderedKeyframe],
) -> Result<(), OutputError> {
    let mut charts = Vec::new();
    drive(&mut charts, report, chart).map_err(OutputError::write(&dir.join(REPORT_HTML)))?;
    write_page(dir, report, &charts, pictures)
}

/// Writes the `report.html` that is there anew, with other figures and pictures; the charts of the drive are taken over.
///
/// # Errors
/// [`OutputError`] as [`write_html`].
pub fn rewrite_html(dir: &Path, report: &Report, pictures: &[RenderedKeyframe]) -> Result<(), OutputError> {
    let Ok(page) = std::fs::read_to_string(dir.join(REPORT_HTML)) else { return Ok(()) };
    let charts = page.split_once(DRIVE_BEGINS).and_then(|(_, rest)| rest.split_once(SECTION_ENDS));
    let charts = charts.map_or_else(String::new, |(charts, _)| [DRIVE_BEGINS, charts, SECTION_ENDS, "\n"].concat());
    write_page(dir, report, charts.as_bytes(), pictures)
}

fn write_page(dir: &Path, report: &Report, drive: &[u8], pictures: &[RenderedKeyframe]) -> Result<(), OutputError> {
    let path = dir.join(REPORT_HTML);
    let final_path = path::thinned(&dir.join("trajectory_tum.txt"))?;
    let live_path = match report.tracking.loops {
        0 => Vec::new(),
        _ => path::thinned(&dir.join("odometry_tum.txt"))?,
    };
    let file = File::create(&path).map_err(OutputError::write(&path))?;
    let mut page = BufWriter::new(file);
    let body = |page: &mut BufWriter<File>| -> io::Result<()> {
        begin(page, report)?;
        trajectory(page, &final_path, &live_path)?;
        page.write_all(drive)?;
        pictures_of(page, pictures)?;
        tables::write(page, report)?;
        writeln!(page, "</main></body></html>")?;
        page.flush()
    };
    body(&mut page).map_err(OutputError::write(&path))
}

fn begin(page: &mut impl Write, report: &Report) -> io::Result<()> {
    writeln!(
        page,
        "<!DOCTYPE html><html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
         <meta name=\"color-scheme\" content=\"light dark\"><title>KiloGS run</title>\
         <style>{STYLE}</style></head><body><main>\
         <header><h1>KiloGS run</h1><code>{}</code></header>",
        Escaped(&report.command)
    )?;
    tables::write_tiles(page, report)
}

fn trajectory(page: &mut impl Write, final_path: &[[f64; 2]], live_path: &[[f64; 2]]) -> io::Result<()> {
    writeln!(page, "<section><h2>Trajectory</h2>")?;
    if final_path.is_empty() {
        return writeln!(page, "<p class=\"note\">No frame has a pose.</p></section>");
    }
    let mut legend = vec![("path", "estimated path"), ("start", "start"), ("end", "end")];
    if !live_path.is_empty() {
        legend.insert(1, ("live", "live odometry, before loop closures"));
    }
    figure(page, &charts::trajectory(final_path, live_path)?, &legend)?;
    writeln!(
        page,
        "<p class=\"note\">Seen from above, axes of equal scale; the first camera is the origin, x points to its \
         right, z ahead of it.</p></section>"
    )
}

/// What only the section of the drive begins with.
const DRIVE_BEGINS: &str = "<section class=\"pair\">";
const SECTION_ENDS: &str = "</section>";

fn drive(page: &mut impl Write, report: &Report, chart: &DriveChart) -> io::Result<()> {
    if chart.buckets().is_empty() {
        return Ok(());
    }
    writeln!(page, "{DRIVE_BEGINS}<div><h2>Time per frame</h2>")?;
    let class_of = |k: usize| charts::STAGE_CLASSES.get(k).copied().unwrap_or("path");
    let legend: Vec<_> = STAGES.iter().enumerate().map(|(k, &(_, name))| (class_of(k), name)).collect();
    figure(page, &charts::time_per_stage(chart.buckets())?, &legend)?;
    writeln!(page, "</div><div><h2>Memory</h2>")?;
    let legend = [("memory", "resident in this process"), ("cap", "cap of the budget")];
    figure(page, &charts::memory(chart.buckets(), report.memory.budget_host_bytes)?, &legend)?;
    writeln!(page, "</div>{SECTION_ENDS}")
}

fn figure(page: &mut impl Write, svg: &str, legend: &[(&str, &str)]) -> io::Result<()> {
    writeln!(page, "<figure class=\"chart\"><figcaption>")?;
    for (class, name) in legend {
        write!(page, "<span><i class=\"{class}\"></i>{name}</span>")?;
    }
    writeln!(page, "</figcaption>{svg}</figure>")
}

fn pictures_of(page: &mut impl Write, pictures: &[RenderedKeyframe]) -> io::Result<()> {
    if pictures.is_empty() {
        return Ok(());
    }
    let shown = pictures.len().min(MAX_PICTURES);
    writeln!(page, "<section><h2>Camera and map</h2><p class=\"note\">Left what the camera saw, right the map.</p>")?;
    for k in 0..shown {
        let picture = &pictures[k * pictures.len() / shown];
        let seconds = picture.timestamp_ns as f64 * 1e-9;
        write!(
            page,
            "<figure class=\"view\"><figcaption>frame {} at {seconds:.2} s: PSNR {} dB, SSIM {}</figcaption><div>",
            picture.frame_index,
            tables::Figure(Some(picture.quality.psnr_db), 2),
            tables::Figure(Some(picture.quality.ssim), 3),
        )?;
        for (file, alt) in [(&picture.camera_file, "camera"), (&picture.render_file, "map")] {
            let jpeg = std::fs::read(file)?;
            write!(page, "<img alt=\"{alt}\" src=\"data:image/jpeg;base64,{}\">", STANDARD.encode(jpeg))?;
        }
        writeln!(page, "</div></figure>")?;
    }
    writeln!(page, "</section>")
}

/// Text that must not be taken for markup.
struct Escaped<'a>(&'a str);

impl Display for Escaped<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for character in self.0.chars() {
            match character {
                '<' => f.write_str("&lt;")?,
                '>' => f.write_str("&gt;")?,
                '&' => f.write_str("&amp;")?,
                '"' => f.write_str("&quot;")?,
                other => write!(f, "{other}")?,
            }
        }
        Ok(())
    }
}

#[cfg(test)]
#[path = "tests.rs"]
mod tests;
