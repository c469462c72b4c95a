//! The charts as SVG. Colors are marks that `style.css` replaces, so that one drawing suits light and dark pages.

use crate::output::{DriveBucket, N_STAGES};
use plotters::coord::Shift;
use plotters::prelude::*;
use std::error::Error;
use std::io;

/// Canvas width in drawing units; the page scales it down, which hides that plotters draws on whole units.
const WIDTH: u32 = 1600;
/// Canvas of a chart that shares its row with another one.
const HALF_WIDTH: u32 = 800;
const HALF_HEIGHT: u32 = 420;
const MARGIN: u32 = 24;
const X_LABELS: u32 = 64;
const Y_LABELS: u32 = 110;
const FONT: (&str, u32) = ("sans-serif", 26);
const LINE: u32 = 4;
const DOT: u32 = 12;
const THIN_LINE: u32 = 2;

/// Marks of the axes' parts and of the series, the same as in `style.css`.
const AXIS: RGBColor = RGBColor(0x10, 0x10, 0x10);
const GRID: RGBColor = RGBColor(0x20, 0x20, 0x20);
const PATH: RGBColor = RGBColor(0x30, 0x30, 0x30);
const LIVE: RGBColor = RGBColor(0x40, 0x40, 0x40);
const START: RGBColor = RGBColor(0x50, 0x50, 0x50);
const END: RGBColor = RGBColor(0x60, 0x60, 0x60);
const MEMORY: RGBColor = RGBColor(0x70, 0x70, 0x70);
const CAP: RGBColor = RGBColor(0x80, 0x80, 0x80);
const STAGES: [RGBColor; N_STAGES] = [
    RGBColor(0x91, 0x91, 0x91),
    RGBColor(0x92, 0x92, 0x92),
    RGBColor(0x93, 0x93, 0x93),
    RGBColor(0x94, 0x94, 0x94),
    RGBColor(0x95, 0x95, 0x95),
];

/// Classes of the stages' legend entries, in the order of the stages.
pub(super) const STAGE_CLASSES: [&str; N_STAGES] = ["stage0", "stage1", "stage2", "stage3", "stage4"];

/// Columns of the time chart: few enough that keyframes and the frames between them are averaged.
const TIME_COLUMNS: usize = 64;

type Canvas<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Drawn = Result<(), Box<dyn Error>>;

/// Path from above with equal scales; the longer side of the drive lies across the page.
pub(super) fn trajectory(final_path: &[[f64; 2]], live_path: &[[f64; 2]]) -> io::Result<String> {
    let extent = |axis: usize| Span::of(final_path.iter().chain(live_path).map(|point| point[axis]));
    let (x, z) = (extent(0), extent(1));
    let z_across = z.length() > x.length();
    // With z across, right of the vehicle is down, as if the page were turned: no mirror image.
    let turn = |&[x, z]: &[f64; 2]| if z_across { (z, -x) } else { (x, z) };
    let (across, up) = if z_across { (z, x.negated()) } else { (x, z) };

    let plot_width = f64::from(WIDTH - Y_LABELS - 2 * MARGIN);
    let (across, up, plot_height) = equal_scales(across, up, plot_width);
    let height = plot_height as u32 + X_LABELS + 2 * MARGIN;
    let draw = |canvas: Canvas<'_>| -> Drawn {
        let mut chart = ChartBuilder::on(&canvas)
            .margin(MARGIN)
            .x_label_area_size(X_LABELS)
            .y_label_area_size(Y_LABELS)
            .build_cartesian_2d(across.from..across.to, up.from..up.to)?;
        let up_label = |value: &f64| label_m(if z_across { -value } else { *value });
        chart
            .configure_mesh()
            .axis_style(AXIS)
            .bold_line_style(GRID)
            .light_line_style(TRANSPARENT)
            .label_style(FONT)
            .x_labels(10)
            .y_labels((plot_height / 120.0).ceil() as usize + 1)
            .x_desc(if z_across { "z, m" } else { "x, m" })
            .y_desc(if z_across { "x, m" } else { "z, m" })
            .x_label_formatter(&|value| label_m(*value))
            .y_label_formatter(&up_label)
            .draw()?;
        chart.draw_series(LineSeries::new(live_path.iter().map(turn), LIVE.stroke_width(THIN_LINE)))?;
        chart.draw_series(LineSeries::new(final_path.iter().map(turn), PATH.stroke_width(LINE)))?;
        let dot = |point: Option<&[f64; 2]>, color: RGBColor| {
            point.map(turn).map(|place| Circle::new(place, DOT, color.filled()))
        };
        chart.draw_series(dot(final_path.first(), START))?;
        chart.draw_series(dot(final_path.last(), END))?;
        Ok(canvas.present()?)
    };
    svg((WIDTH, height), draw)
}

/// Mean time per frame, the stages on top of each other.
pub(super) fn time_per_stage(buckets: &[DriveBucket]) -> io::Result<String> {
    let columns = merged_columns(buckets);
    let top_ms = columns.iter().map(|column| column.until_stage_ms[N_STAGES - 1]).fold(0.0, f64::max);
    let frames = columns.last().map_or(0.0, |column| column.to_frame);
    let draw = |canvas: Canvas<'_>| -> Drawn {
        let mut chart = frame_chart(&canvas, frames, 1.08 * top_ms.max(1e-3), "ms", &|ms| format!("{ms}"))?;
        for stage in (0..N_STAGES).rev() {
            let bars = columns.iter().map(|column| {
                let below_ms = stage.checked_sub(1).map_or(0.0, |below| column.until_stage_ms[below]);
                let corners = [(column.from_frame, below_ms), (column.to_frame, column.until_stage_ms[stage])];
                Rectangle::new(corners, STAGES[stage].filled())
            });
            chart.draw_series(bars)?;
        }
        Ok(canvas.present()?)
    };
    svg((HALF_WIDTH, HALF_HEIGHT), draw)
}

/// Resident memory over the frames, with the cap.
pub(super) fn memory(buckets: &[DriveBucket], cap_bytes: u64) -> io::Result<String> {
    const MIB: f64 = (1 << 20) as f64;
    let mut frame = 0.0;
    let points: Vec<(f64, f64)> = buckets
        .iter()
        .map(|bucket| {
            frame += bucket.n_frames as f64;
            (frame, bucket.rss_bytes as f64 / MIB)
        })
        .collect();
    let cap_mib = cap_bytes as f64 / MIB;
    let top_mib = points.iter().map(|point| point.1).fold(cap_mib, f64::max).max(1.0);
    let draw = |canvas: Canvas<'_>| -> Drawn {
        let mut chart = frame_chart(&canvas, frame, 1.12 * top_mib, "MiB", &|mib| format!("{mib}"))?;
        chart.draw_series(AreaSeries::new(points.iter().copied(), 0.0, MEMORY.mix(0.2)))?;
        chart.draw_series(LineSeries::new(points.iter().copied(), MEMORY.stroke_width(LINE)))?;
        if cap_bytes > 0 {
            chart.draw_series(LineSeries::new([(0.0, cap_mib), (frame, cap_mib)], CAP.stroke_width(LINE)))?;
        }
        Ok(canvas.present()?)
    };
    svg((HALF_WIDTH, HALF_HEIGHT), draw)
}

type FrameChart<'a, 'b> = ChartContext<
    'a,
    SVGBackend<'b>,
    Cartesian2d<plotters::coord::types::RangedCoordf64, plotters::coord::types::RangedCoordf64>,
>;

/// Axes of a chart over the frames of the drive.
fn frame_chart<'a, 'b>(
    canvas: &'a Canvas<'b>,
    frames: f64,
    top: f64,
    unit: &str,
    label: &dyn Fn(&f64) -> String,
) -> Result<FrameChart<'a, 'b>, Box<dyn Error>>
where
    'b: 'a,
{
    let mut chart = ChartBuilder::on(canvas)
        .margin(MARGIN)
        .x_label_area_size(X_LABELS)
        .y_label_area_size(Y_LABELS)
        .build_cartesian_2d(0.0..frames.max(1.0), 0.0..top)?;
    chart
        .configure_mesh()
        .disable_x_mesh()
        .axis_style(AXIS)
        .bold_line_style(GRID)
        .light_line_style(TRANSPARENT)
        .label_style(FONT)
        .x_labels(6)
        .y_labels(6)
        .x_desc("frame")
        .y_desc(unit)
        .x_label_formatter(&|frame| format!("{frame:.0}"))
        .y_label_formatter(label)
        .draw()?;
    Ok(chart)
}

/// Neighbouring buckets taken together, with the stages' times added up from the first.
struct Column {
    from_frame: f64,
    to_frame: f64,
    until_stage_ms: [f64; N_STAGES],
}

fn merged_columns(buckets: &[DriveBucket]) -> Vec<Column> {
    let per_column = buckets.len().div_ceil(TIME_COLUMNS).max(1);
    let mut from_frame = 0.0;
    let column = |group: &[DriveBucket]| {
        let n_frames: u64 = group.iter().map(|bucket| bucket.n_frames).sum();
        let mut until_ms = 0.0;
        let until_stage_ms = std::array::from_fn(|stage| {
            let sum_ms: f64 = group.iter().map(|bucket| bucket.stage_sum_ms[stage]).sum();
            until_ms += sum_ms / n_frames.max(1) as f64;
            until_ms
        });
        let to_frame = from_frame + n_frames as f64;
        Column { from_frame: std::mem::replace(&mut from_frame, to_frame), to_frame, until_stage_ms }
    };
    buckets.chunks(per_column).map(column).collect()
}

/// Where a coordinate begins and ends.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Span {
    from: f64,
    to: f64,
}

impl Span {
    fn of(values: impl Iterator<Item = f64>) -> Self {
        let (from, to) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| (lo.min(v), hi.max(v)));
        if from <= to { Self { from, to } } else { Self { from: 0.0, to: 0.0 } }
    }

    fn length(&self) -> f64 {
        self.to - self.from
    }

    fn negated(&self) -> Self {
        Self { from: -self.to, to: -self.from }
    }

    /// The same middle, another length.
    fn with_length(&self, length: f64) -> Self {
        let middle = 0.5 * (self.from + self.to);
        Self { from: middle - 0.5 * length, to: middle + 0.5 * length }
    }
}

/// Widens the spans so that a metre is as long in both directions, and says how high the plot becomes.
fn equal_scales(across: Span, up: Span, plot_width: f64) -> (Span, Span, f64) {
    const AIR: f64 = 1.08;
    const SMALLEST_M: f64 = 1.0;
    const LOWEST: f64 = 260.0;
    const HIGHEST: f64 = 1000.0;
    let (across_m, up_m) = (AIR * across.length().max(SMALLEST_M), AIR * up.length().max(SMALLEST_M));
    let plot_height = (plot_width * up_m / across_m).clamp(LOWEST, HIGHEST).round();
    let m_per_unit = (across_m / plot_width).max(up_m / plot_height);
    (across.with_length(m_per_unit * plot_width), up.with_length(m_per_unit * plot_height), plot_height)
}

fn label_m(value: f64) -> String {
    // The rounding keeps a label such as 0.30000000000000004 short, the sum a negative zero positive.
    format!("{}", (value * 1000.0).round() / 1000.0 + 0.0)
}

fn svg(size: (u32, u32), draw: impl FnOnce(Canvas<'_>) -> Drawn) -> io::Result<String> {
    let mut text = String::new();
    let canvas = SVGBackend::with_string(&mut text, size).into_drawing_area();
    draw(canvas).map_err(|error| io::Error::other(format!("drawing a chart: {error}")))?;
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_metre_is_as_long_across_as_up() {
        for (across_m, up_m) in [(400.0, 3.0), (100.0, 90.0), (50.0, 500.0), (0.0, 0.0)] {
            let (across, up) = (Span { from: -1.0, to: across_m - 1.0 }, Span { from: 2.0, to: up_m + 2.0 });
            let (wide, high, plot_height) = equal_scales(across, up, 1000.0);
            assert!((wide.length() / 1000.0 - high.length() / plot_height).abs() < 1e-9, "{wide:?} {high:?}");
            assert!(wide.from <= across.from && wide.to >= across.to && high.from <= up.from && high.to >= up.to);
        }
    }

    #[test]
    fn columns_keep_the_mean_time() {
        let bucket = |n_frames: u64, ms: f64| DriveBucket {
            n_frames,
            stage_sum_ms: [ms * n_frames as f64; N_STAGES],
            ..DriveBucket::default()
        };
        let buckets: Vec<_> = (0..130).map(|k| bucket(2, f64::from(k % 3))).collect();
        let columns = merged_columns(&buckets);
        assert_eq!((columns.len(), columns[43].to_frame), (44, 260.0));
        assert_eq!((columns[0].until_stage_ms[0], columns[0].until_stage_ms[N_STAGES - 1]), (1.0, 5.0));
        assert_eq!(columns[1].from_frame, columns[0].to_frame);
    }

    #[test]
    fn charts_of_hardly_anything_are_drawn_too() {
        assert!(trajectory(&[[0.0, 0.0]], &[]).is_ok_and(|svg| svg.contains("<circle")));
        assert!(time_per_stage(&[DriveBucket::default()]).is_ok_and(|svg| svg.contains("<rect")));
        assert!(memory(&[DriveBucket::default()], 0).is_ok_and(|svg| svg.starts_with("<svg")));
    }
}
