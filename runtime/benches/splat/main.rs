//! `cargo xtask bench splat`: times a training step and the scores of a view stage by stage, on every backend there is, beside what the machine
//! could do at most. Prints tables and judges nothing.

mod machine;
mod scene;
mod work;

use clap::Parser;
use kilogs::splat::cpu::{CpuBackend, SimdLevel};
use kilogs::splat::device::{DeviceBackend, Executor};
use kilogs::splat::vulkan::{DeviceRequest, VulkanDevice, VulkanExecutor};
use kilogs::splat::wgpu::WgpuExecutor;
use kilogs::splat::{
    AnchorScore, Capacities, DecoderRates, DepthTarget, RenderStats, RenderTarget, SplatBackend, StageTimes,
    StepSettings, TargetImage, TrainingView,
};
use machine::Machine;
use scene::{GAUSSIANS_PER_ANCHOR, SIZES, Scene, Size};
use std::sync::Arc;
use std::time::{Duration, Instant};
use work::{Counts, least_work};

#[derive(Parser)]
#[command(name = "cargo xtask bench splat", about = "Times a training step and the scores of a view, stage by stage")]
struct Options {
    /// Only sizes whose name contains this, for example `50k`.
    #[arg(long, value_name = "TEXT")]
    size: Option<String>,
    /// Only backends whose name contains this, for example `avx2`.
    #[arg(long, value_name = "TEXT")]
    backend: Option<String>,
    /// Threads of the processor's backend.
    #[arg(long, default_value_t = std::thread::available_parallelism().map_or(1, usize::from))]
    threads: usize,
    /// Seconds per table.
    #[arg(long, default_value_t = 3.0)]
    seconds: f64,
    /// Seed of the scenes.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Train a learned decoder, too.
    #[arg(long)]
    decoder: bool,
    /// Find the gradient of the camera's pose, too.
    #[arg(long)]
    pose: bool,
    /// Given by `cargo bench`.
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() {
    let options = Options::parse();
    let machine = Machine::measure(options.threads);
    println!(
        "{} threads: {:.1} GB/s, {:.0} GFLOP/s at most\n",
        options.threads,
        machine.bytes_per_s * 1e-9,
        machine.flops_per_s * 1e-9
    );
    let wanted = |name: &str, text: &Option<String>| text.as_deref().is_none_or(|text| name.contains(text));
    for size in SIZES.iter().filter(|size| wanted(&size.name(), &options.size)) {
        let scene = Scene::new(size, options.seed);
        for (name, open) in backends(options.threads) {
            if !wanted(&name, &options.backend) {
                continue;
            }
            match open(Capacities { learned_decoder: options.decoder, ..capacities(size) }) {
                Ok(mut backend) => print_tables(&name, size, &scene, backend.as_mut(), &machine, &options),
                Err(reason) => println!("{} on {name}: left out, {reason}\n", size.name()),
            }
        }
    }
}

type Open = Box<dyn Fn(Capacities) -> Result<Box<dyn SplatBackend>, String>>;

/// Every backend that was built, by name.
fn backends(threads: usize) -> Vec<(String, Open)> {
    let mut all = vec![("vulkan".to_owned(), open_vulkan()), ("wgpu".to_owned(), open_wgpu())];
    let levels = [SimdLevel::Avx512, SimdLevel::Avx2, SimdLevel::Neon, SimdLevel::Baseline];
    let processors = levels.into_iter().filter(|level| level.is_available()).map(|level| {
        let open: Open = Box::new(move |capacities| {
            let backend = CpuBackend::new(capacities, threads, level, |_| ()).map_err(|e| e.to_string())?;
            Ok(Box::new(backend) as Box<dyn SplatBackend>)
        });
        (format!("cpu {level}"), open)
    });
    all.extend(processors);
    all
}

/// Device memory that a table may take.
const DEVICE_BYTES: usize = 4 << 30;

fn open_vulkan() -> Open {
    Box::new(|capacities| {
        let device = VulkanDevice::open(DeviceRequest::Any).map(Arc::new).map_err(|e| e.to_string())?;
        let executor = VulkanExecutor::new(&device, &capacities, DEVICE_BYTES as u64).map_err(|e| e.to_string())?;
        timed(capacities, executor)
    })
}

fn open_wgpu() -> Open {
    Box::new(|capacities| {
        let executor = WgpuExecutor::open(&capacities, DEVICE_BYTES).map_err(|e| e.to_string())?;
        timed(capacities, executor)
    })
}

/// A device backend that waits for every stage: what a step takes beyond its stages is the waiting.
fn timed<E: Executor + 'static>(capacities: Capacities, executor: E) -> Result<Box<dyn SplatBackend>, String> {
    let mut backend = DeviceBackend::new(capacities, executor).map_err(|e| e.to_string())?;
    backend.time_stages(true);
    Ok(Box::new(backend))
}

fn capacities(size: &Size) -> Capacities {
    let anchors = size.n_gaussians / GAUSSIANS_PER_ANCHOR;
    let mut capacities = Capacities::for_map(anchors, GAUSSIANS_PER_ANCHOR, size.width_px, size.height_px);
    // Small pictures put many Gaussians into few tiles.
    capacities.pairs = capacities.visible_gaussians * 16;
    capacities.row_entries = capacities.visible_gaussians * 6;
    capacities
}

/// Median times of one backend on one size.
struct Measured {
    run_ms: f64,
    stages: Vec<(&'static str, f64)>,
    stats: RenderStats,
}

fn measure_steps(backend: &mut dyn SplatBackend, training: &TrainingView<'_>, options: &Options) -> Measured {
    let mut settings = StepSettings { pose_gradient: options.pose, ..StepSettings::direct(0.0) };
    if backend.capacities().learned_decoder {
        settings.rates.decoder = DecoderRates::METHOD;
        settings.decoder_row = Some(0);
    }
    // Caches, page faults and the device's pipelines.
    let stats = backend.train_step(training, &settings).stats;
    Measured {
        stats,
        ..measure(backend, options.seconds, &mut |backend| {
            backend.train_step(training, &settings);
        })
    }
}

fn measure_scores(backend: &mut dyn SplatBackend, training: &TrainingView<'_>, options: &Options) -> Measured {
    let mut scores = vec![AnchorScore::default(); backend.capacities().anchors];
    let stats = backend.score_view(training, ERROR_THRESHOLD, &mut scores).stats;
    let score = &mut |backend: &mut dyn SplatBackend| {
        backend.score_view(training, ERROR_THRESHOLD, &mut scores);
    };
    Measured { stats, ..measure(backend, options.seconds, score) }
}

/// The lifecycle's (method.md 12).
const ERROR_THRESHOLD: f32 = 0.1;

fn measure(backend: &mut dyn SplatBackend, seconds: f64, run: &mut dyn FnMut(&mut dyn SplatBackend)) -> Measured {
    run(backend);
    let mut runs: Vec<(f64, StageTimes)> = Vec::new();
    let end = Instant::now() + Duration::from_secs_f64(seconds);
    while runs.len() < 3 || Instant::now() < end {
        let start = Instant::now();
        run(backend);
        runs.push((start.elapsed().as_secs_f64() * 1e3, backend.stage_times()));
    }
    let names: Vec<_> = runs[0].1.iter().map(|(name, _)| name).collect();
    let stage = |name| median(runs.iter().flat_map(|(_, times)| times.iter()).filter(|s| s.0 == name).map(|s| s.1));
    let stages = names.into_iter().map(|name| (name, stage(name))).collect();
    Measured { run_ms: median(runs.iter().map(|s| s.0)), stages, stats: RenderStats::default() }
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<_> = values.collect();
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

fn print_tables(
    name: &str,
    size: &Size,
    scene: &Scene,
    backend: &mut dyn SplatBackend,
    machine: &Machine,
    options: &Options,
) {
    scene.write_to(backend);
    let view = size.view();
    let transmittance = mean_transmittance(backend, size);
    let target = target(size);
    let (depth_m, confidence) = (vec![DEPTH_M; size.n_pixels()], vec![1.0; size.n_pixels()]);
    let depth = Some(DepthTarget { depth_m: &depth_m, confidence: &confidence });
    let training = TrainingView { view, target: TargetImage::Rgb8(&target), depth, exposure_slot: Some(0) };
    let steps = measure_steps(backend, &training, options);
    let stats = steps.stats;
    let counts = Counts::new(size, &stats, scene.n_contributions(&view));
    println!("{} on {name}: {:.1} ms per step, {:.2} it/s", size.name(), steps.run_ms, 1e3 / steps.run_ms);
    println!(
        "{} visible, {:.2} pairs per Gaussian, {:.1} contributions per pixel, mean final transmittance {transmittance:.3}, overflow {:?}",
        stats.visible,
        counts.pairs / counts.visible,
        counts.contributions / counts.pixels,
        stats.overflow
    );
    print_stages(&steps, &counts, machine);
    let scores = measure_scores(backend, &training, options);
    println!("{} on {name}: {:.1} ms to score a view", size.name(), scores.run_ms);
    print_stages(&scores, &counts, machine);
}

fn print_stages(measured: &Measured, counts: &Counts, machine: &Machine) {
    println!(
        "| stage | ms | share | MB at least | MFLOP at least | roofline ms | of roofline |\n|---|---:|---:|---:|---:|---:|---:|"
    );
    for &(stage, ms) in &measured.stages {
        let share = format!("{stage} | {ms:.2} | {:.0} %", 100.0 * ms / measured.run_ms);
        match least_work(stage, counts) {
            Some(work) => {
                let roofline_ms = 1e3 * (work.bytes / machine.bytes_per_s).max(work.flops / machine.flops_per_s);
                let (megabytes, megaflops) = (work.bytes * 1e-6, work.flops * 1e-6);
                println!(
                    "| {share} | {megabytes:.1} | {megaflops:.0} | {roofline_ms:.2} | {:.0} % |",
                    100.0 * roofline_ms / ms
                );
            }
            None => println!("| {share} | - | - | - | - |"),
        }
    }
    println!();
}

fn mean_transmittance(backend: &mut dyn SplatBackend, size: &Size) -> f64 {
    let n = size.n_pixels();
    let (mut rgb, mut depth_m, mut transmittance) = (vec![[0.0; 3]; n], vec![0.0; n], vec![0.0; n]);
    let target = RenderTarget { rgb: &mut rgb, depth_m: &mut depth_m, transmittance: &mut transmittance };
    backend.render(&size.view(), target);
    transmittance.iter().map(|&t| f64::from(t)).sum::<f64>() / n as f64
}

/// The depth that steps are told: a wall, because what it takes to compare depths does not depend on them.
const DEPTH_M: f32 = 20.0;

/// A picture with structure at every scale.
fn target(size: &Size) -> Vec<u8> {
    let width = size.width_px as usize;
    let value = |i: usize, channel: usize| {
        let (x, y) = (i % width, i / width);
        ((x * (channel + 1)) ^ (y * 3)) as u8
    };
    (0..size.n_pixels()).flat_map(|i| [0, 1, 2].map(|channel| value(i, channel))).collect()
}
