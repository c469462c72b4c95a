//! Corners, pyramids and tracks on pictures.

use super::clock::Times;
use super::median;
use super::pictures::{Difference, Pair, pyramid, pyramid_storage, view};
use kilogs_core::features::corners::{Corner, CornerSettings, detect};
use kilogs_core::features::lk::{Flow, LkSettings, track};
use kilogs_core::features::{LkVerdict, SimdLevel};
use kilogs_core::frame::Pyramid;
use std::hint::black_box;
use std::path::Path;

const POINTS: usize = 1000;
/// Finds at least [`POINTS`] corners in a street.
const DENSE: CornerSettings =
    CornerSettings { cell_px: 16.0, min_distance_px: 5.0, min_eigenvalue: 0.3, border_px: 11.0 };

/// Two settings of the search, as the peers' tables have them.
const SEARCHES: [(&str, LkSettings); 3] = [
    ("30 steps, 0.01 px on every level", LkSettings { coarse_converged_px: 0.01, ..LkSettings::STANDARD }),
    (
        "10 steps, 0.03 px on every level",
        LkSettings { max_steps: 10, converged_px: 0.03, coarse_converged_px: 0.03, ..LkSettings::STANDARD },
    ),
    ("as the tracker searches", LkSettings::STANDARD),
];

/// Every level of this machine.
pub fn simd_levels() -> Vec<(&'static str, SimdLevel)> {
    let mut levels = vec![("scalar", SimdLevel::Scalar)];
    match SimdLevel::new() {
        SimdLevel::Scalar => {}
        #[cfg(target_arch = "x86_64")]
        best @ SimdLevel::Avx2(_) => levels.push(("avx2", best)),
    }
    levels
}

fn points(pair: &Pair) -> Vec<[f32; 2]> {
    let mut corners = vec![Corner::NONE; 4 * POINTS];
    let found = detect(SimdLevel::new(), view(&pair.first), &DENSE, std::iter::empty(), &mut corners);
    corners.truncate(found.n_found);
    corners.sort_by(|a, b| b.min_eigenvalue.total_cmp(&a.min_eigenvalue));
    corners.iter().take(POINTS).map(|corner| corner.pixel).collect()
}

/// The moved picture and the points for the peers; their pixel centres are whole numbers.
pub fn store(recorded: &Pair, folder: &Path) -> std::io::Result<()> {
    std::fs::write(folder.join("moved.gray"), &recorded.with_difference(&Difference::SMALL).second)?;
    let line = |p: &[f32; 2]| {
        let [x, y] = Difference::SMALL.target_px(*p);
        format!("{} {} {} {}\n", p[0] - 0.5, p[1] - 0.5, x - 0.5, y - 0.5)
    };
    std::fs::write(folder.join("points.txt"), points(recorded).iter().map(line).collect::<String>())
}

/// Times and errors of everything that looks at pixels.
pub fn print_table(recorded: &Pair, rounds: usize) {
    let known = recorded.with_difference(&Difference::SMALL);
    let mut storage = [pyramid_storage(), pyramid_storage(), pyramid_storage()];
    let [a, b, c] = &mut storage;
    let (first, second, moved) = (pyramid(&recorded.first, a), pyramid(&recorded.second, b), pyramid(&known.second, c));
    let points = points(recorded);
    println!("| 1241x376, {} points | SIMD | ms | accuracy |\n|---|---|---:|---|", points.len());
    let mut storage = pyramid_storage();
    let pyramids = Times::of(0..rounds, |_| {
        black_box(pyramid(&recorded.first, &mut storage));
    });
    println!("| pyramid, 4 levels | - | {} | - |", pyramids.text());
    for (level, simd) in simd_levels() {
        let mut corners = vec![Corner::NONE; 4 * POINTS];
        let mut n_found = 0;
        let times = Times::of(0..rounds, |_| {
            let empty = std::iter::empty();
            n_found =
                detect(simd, view(&recorded.first), &CornerSettings::STANDARD, empty, black_box(&mut corners)).n_found;
        });
        println!("| corners, one per 20-px cell | {level} | {} | {n_found} found |", times.text());
        for (name, settings) in SEARCHES {
            let mut flows = Vec::new();
            let times = Times::of(0..rounds, |_| search(simd, [&first, &second], &settings, &points, &mut flows));
            let n_found = flows.iter().filter(|flow| flow.verdict.is_found()).count();
            search(simd, [&first, &moved], &settings, &points, &mut flows);
            println!(
                "| PyrLK 21x21, 4 levels, {name} | {level} | {} | {n_found} found; moved picture: {} |",
                times.text(),
                errors(&flows)
            );
        }
    }
    println!();
}

fn search(
    simd: SimdLevel,
    [source, target]: [&Pyramid<'_>; 2],
    settings: &LkSettings,
    points: &[[f32; 2]],
    flows: &mut Vec<Flow>,
) {
    flows.clear();
    flows.extend(points.iter().map(|&point| Flow::new(point, point)));
    track(simd, source, target, settings, black_box(flows));
}

fn errors(flows: &[Flow]) -> String {
    let of = |flow: &Flow| {
        let [x, y] = Difference::SMALL.target_px(flow.source_px);
        (f64::from(flow.target_px[0]) - x).hypot(f64::from(flow.target_px[1]) - y)
    };
    let found = flows.iter().filter(|flow| matches!(flow.verdict, LkVerdict::Found { .. }));
    let errors_px: Vec<f64> = found.map(of).collect();
    let good = errors_px.iter().filter(|&&error_px| error_px < 0.5).count();
    format!("{} found, {good} within 0.5 px, median error {:.4} px", errors_px.len(), median(errors_px))
}
