//! Matchers that need no prediction: how long they take, and what they find in pictures that differ in known ways.

use super::clock::Times;
use super::images::simd_levels;
use super::median;
use super::pictures::{Difference, Pair, SIZE, pyramid, pyramid_storage, view};
use kilogs_core::correspondence::{
    DenseCapacities, DenseMatcher, DenseNode, DenseSettings, DenseStorage, DescriptorMatcher,
    DescriptorMatcherSettings, DescriptorStorage, ImagePair, PairMatcher, PixelMatch,
};
use kilogs_core::features::corners::{CornerSettings, detect};
use kilogs_core::features::descriptors::{extract, half_step_bytes};
use kilogs_core::features::hamming::match_mutually;
use kilogs_core::features::lk::{Flow, LkSettings, track_there_and_back};
use kilogs_core::features::{
    Corner, ExtractScratch, ExtractSettings, Feature, FeatureMatch, HammingSettings, Nearest, SimdLevel,
};
use kilogs_core::frame::Pyramid;
use std::hint::black_box;

const FEATURES: usize = 2000;

/// What the second picture differs by from the first.
const DIFFERENCES: [Difference; 9] = [
    Difference { name: "zoom 1.05, turn, shift of 7 px, noise 2", ..Difference::PLAIN },
    Difference {
        name: "the same, noise 10 on a quarter of the contrast",
        contrast: 0.25,
        noise: 10.0,
        ..Difference::PLAIN
    },
    Difference { name: "the same, an eighth of the light", gain: 0.125, ..Difference::PLAIN },
    Difference { name: "the same, gain 2, bias 30", gain: 2.0, bias: 30.0, ..Difference::PLAIN },
    Difference { name: "the same, motion blur of 13 px", blur_px: 13, ..Difference::PLAIN },
    Difference { name: "shift of 100 px", zoom: 1.0, turn_rad: 0.0, shift_px: [100.0, -12.0], ..Difference::PLAIN },
    Difference {
        name: "shift of 100 px, noise 10, half the contrast",
        zoom: 1.0,
        turn_rad: 0.0,
        shift_px: [100.0, -12.0],
        contrast: 0.5,
        noise: 10.0,
        ..Difference::PLAIN
    },
    Difference { name: "zoom 1.4", zoom: 1.4, turn_rad: 0.0, ..Difference::PLAIN },
    Difference { name: "turn of 30 deg", zoom: 1.0, turn_rad: 0.52, ..Difference::PLAIN },
];

struct Memory {
    half_step: Vec<u8>,
    corners: Vec<Corner>,
    features: [Vec<Feature>; 2],
    nearest: Vec<Nearest>,
    pairs: Vec<FeatureMatch>,
    volumes: [Vec<u8>; 2],
    planes: Vec<f32>,
    nodes: [Vec<DenseNode>; 2],
}

const CAPACITIES: DenseCapacities = DenseCapacities { width: SIZE[0], height: SIZE[1] };

impl Memory {
    fn new() -> Self {
        Self {
            half_step: vec![0; half_step_bytes(SIZE[0], SIZE[1])],
            corners: vec![Corner::NONE; FEATURES],
            features: [vec![Feature::NONE; FEATURES], vec![Feature::NONE; FEATURES]],
            nearest: vec![Nearest::NONE; 2 * FEATURES],
            pairs: vec![FeatureMatch::default(); FEATURES],
            volumes: [vec![0; CAPACITIES.volume_bytes()], vec![0; CAPACITIES.volume_bytes()]],
            planes: vec![0.0; CAPACITIES.planes()],
            nodes: [vec![DenseNode::NONE; CAPACITIES.nodes()], vec![DenseNode::NONE; CAPACITIES.nodes()]],
        }
    }

    fn dense(&mut self, simd: SimdLevel) -> DenseMatcher<'_> {
        let ([volume, pooled], [nodes, moved_nodes]) = (&mut self.volumes, &mut self.nodes);
        let storage = DenseStorage { volume, pooled, planes: &mut self.planes, nodes, moved_nodes };
        DenseMatcher::new(simd, DenseSettings::STANDARD, CAPACITIES, storage).expect("sized")
    }

    fn descriptors(&mut self, simd: SimdLevel) -> DescriptorMatcher<'_> {
        let [keyframe, current] = &mut self.features;
        let storage = DescriptorStorage {
            half_step: &mut self.half_step,
            corners: &mut self.corners,
            keyframe,
            current,
            nearest: &mut self.nearest,
            matches: &mut self.pairs,
        };
        DescriptorMatcher::new(simd, DescriptorMatcherSettings::STANDARD, SIZE, storage).expect("sized")
    }
}

/// Times of the matchers and of their parts.
pub fn print_times(recorded: &Pair, rounds: usize) {
    let mut storage = [pyramid_storage(), pyramid_storage()];
    let [a, b] = &mut storage;
    let (first, second) = (pyramid(&recorded.first, a), pyramid(&recorded.second, b));
    println!("| 1241x376 | SIMD | ms | found |\n|---|---|---:|---:|");
    for (level, simd) in simd_levels() {
        let mut memory = Memory::new();
        let mut n = [0; 2];
        let Memory { half_step, corners, features, nearest, pairs, .. } = &mut memory;
        let mut scratch = ExtractScratch { half_step, corners };
        let mut describe = |i: usize, image| {
            n[i] = extract(simd, image, &ExtractSettings::STANDARD, &mut scratch, black_box(&mut features[i]));
        };
        describe(1, &second);
        let times = Times::of(0..rounds, |_| describe(0, &first));
        println!("| corners of four sizes, with descriptors | {level} | {} | {} |", times.text(), n[0]);
        let (of_first, of_second) = (&features[0][..n[0]], &features[1][..n[1]]);
        let mut n_pairs = 0;
        let times = Times::of(0..rounds, |_| {
            let settings = HammingSettings::STANDARD;
            n_pairs = match_mutually(simd, of_first, of_second, &settings, nearest, black_box(pairs));
        });
        println!("| matching {} x {} of 256 bits | {level} | {} | {n_pairs} |", n[0], n[1], times.text());
        let timed = |name: &str, matcher: &mut dyn PairMatcher| {
            let mut matches = vec![PixelMatch::default(); FEATURES];
            let mut n = 0;
            let times = Times::of(0..rounds, |round| {
                let pair = ImagePair { keyframe: &first, keyframe_ordinal: round as u32, current: &second };
                n = matcher.match_pair(&pair, black_box(&mut matches));
            });
            println!("| {name} | {level} | {} | {n} |", times.text());
        };
        timed("descriptor matcher, a new keyframe each time", &mut memory.descriptors(simd));
        timed("dense matcher", &mut memory.dense(simd));
    }
    println!();
}

/// What tracks and both matchers find in pictures of known flow.
pub fn print_errors(recorded: &Pair) {
    println!("| second picture | tracks (LK) | descriptors | dense |\n|---|---:|---:|---:|");
    for difference in &DIFFERENCES {
        let pair = recorded.with_difference(difference);
        let mut storage = [pyramid_storage(), pyramid_storage()];
        let [a, b] = &mut storage;
        let (first, second) = (pyramid(&pair.first, a), pyramid(&pair.second, b));
        let mut memory = Memory::new();
        let simd = SimdLevel::new();
        let found = |matcher: &mut dyn PairMatcher| {
            let mut matches = vec![PixelMatch::default(); FEATURES];
            let pair = ImagePair { keyframe: &first, keyframe_ordinal: 0, current: &second };
            let n = matcher.match_pair(&pair, &mut matches);
            errors(difference, matches.iter().take(n).map(|m| (m.keyframe_px, m.current_px)))
        };
        let descriptors = found(&mut memory.descriptors(simd));
        let dense = found(&mut memory.dense(simd));
        let tracks = tracks(&pair, [&first, &second]);
        let tracks = errors(difference, tracks.iter().map(|flow| (flow.source_px, flow.target_px)));
        println!("| {} | {tracks} | {descriptors} | {dense} |", difference.name);
    }
    println!();
}

fn tracks(pair: &Pair, [first, second]: [&Pyramid<'_>; 2]) -> Vec<Flow> {
    let simd = SimdLevel::new();
    let mut corners = vec![Corner::NONE; FEATURES];
    let found = detect(simd, view(&pair.first), &CornerSettings::STANDARD, std::iter::empty(), &mut corners);
    let start = |corner: &Corner| Flow::new(corner.pixel, corner.pixel);
    let mut flows: Vec<Flow> = corners.iter().take(found.n_found).map(start).collect();
    track_there_and_back(simd, first, second, &LkSettings::STANDARD, &mut flows);
    flows.retain(|flow| flow.verdict.is_found());
    flows
}

/// `number, share within 3 px, median error`.
fn errors(difference: &Difference, matches: impl Iterator<Item = ([f32; 2], [f32; 2])>) -> String {
    const RIGHT_PX: f64 = 3.0;
    let of = |(source, target): ([f32; 2], [f32; 2])| {
        let [x, y] = difference.target_px(source);
        (f64::from(target[0]) - x).hypot(f64::from(target[1]) - y)
    };
    let errors_px: Vec<f64> = matches.map(of).collect();
    let n = errors_px.len();
    let n_right = errors_px.iter().filter(|&&error_px| error_px < RIGHT_PX).count();
    match n {
        0 => "0".into(),
        _ => format!("{n}, {:.1} %, {:.2} px", 100.0 * n_right as f64 / n as f64, median(errors_px)),
    }
}
