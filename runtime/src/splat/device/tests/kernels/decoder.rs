//! Learned decoders, in the second chunk row, of which three hidden units are used: the first is awake because of a
//! feature, the second because of the direction, the third is asleep.

use super::cull::{anchor, keyframe};
use super::{Case, Word, counters, exact, picture, reals, words_of};
use crate::splat::kernel_constants::{DECODER_PIECES, FEATURE_LEN, HIDDEN, INPUTS, N_PARAMS};
use crate::splat::kernels::Kernel;
use crate::splat::layout::{DeviceAnchor, ViewBlock};
use crate::splat::program::Buffer;

pub fn cases() -> Vec<Case> {
    vec![decode_anchors(), decode_anchors_backward(), step_decoder()]
}

/// Numbers of the first layer, its biases being the weights of a last input that is 1.
const FIRST_LAYER: u32 = (INPUTS + 1) * HIDDEN;
/// Numbers of a decoder of one Gaussian.
const LEN: usize = (FIRST_LAYER + (HIDDEN + 1) * N_PARAMS) as usize;
/// Input that is 1 straight ahead.
const AHEAD: u32 = FEATURE_LEN + 2;

/// Place of a weight of the first layer.
fn w1(input: u32, unit: u32) -> usize {
    (input * HIDDEN + unit) as usize
}

/// Place of a weight of the second layer; unit [`HIDDEN`] has the biases.
fn w2(unit: u32, output: u32) -> usize {
    (FIRST_LAYER + unit * N_PARAMS + output) as usize
}

/// `n` times a decoder's numbers, of which these are not 0.
fn numbers(n: usize, nonzero: &[(usize, f32)]) -> Vec<Word> {
    let mut all = vec![0.0; n * LEN];
    nonzero.iter().for_each(|&(at, value)| all[at] = value);
    reals(all)
}

/// Units 2 1.5 - 1 = 2, 0.5 and -1.
fn weights() -> Vec<Word> {
    let weights = [
        (w1(0, 0), 2.0),
        (w1(INPUTS, 0), -1.0),
        (w1(AHEAD, 1), 0.5),
        // Directions to the side and logarithms of the distance are 0, but for their gradients.
        (w1(FEATURE_LEN, 1), 8.0),
        (w1(FEATURE_LEN + 3, 0), 6.0),
        (w1(INPUTS, 2), -1.0),
        (w2(0, 3), 0.25),
        (w2(1, 11), 4.0),
        (w2(2, 3), 1.0),
        (w2(HIDDEN, 0), 0.125),
    ];
    numbers(2, &weights.map(|(at, value)| (LEN + at, value)))
}

fn feature(first: f32) -> Vec<Word> {
    reals((0..FEATURE_LEN).map(|i| if i == 0 { first } else { 0.0 }))
}

/// An anchor straight ahead, at the distance where the logarithm counts as 0, and what is common to both cases.
fn before(effective: [f32; N_PARAMS as usize]) -> Vec<(Buffer, Vec<Word>)> {
    let in_second_row = DeviceAnchor { packed: anchor(16.0, 0, 1, 1.0).packed | (1 << 16), ..anchor(16.0, 0, 1, 1.0) };
    vec![
        (Buffer::Anchors, words_of(&[in_second_row])),
        (Buffer::Keyframes, words_of(&[keyframe(1.0)])),
        (Buffer::Candidates, exact([0])),
        (Buffer::Counters, words_of(&[counters(1)])),
        (Buffer::Features, feature(1.5)),
        (Buffer::Decoders, weights()),
        (Buffer::Effective, reals(effective.into_iter().flat_map(|v| [v, 9.0]))),
    ]
}

fn view() -> ViewBlock {
    ViewBlock {
        candidate_capacity: 2,
        decoder_rows: 2,
        decoder_row: 1,
        decoder_step: 1,
        feature_rate: 0.1,
        hidden_rate: 0.1,
        output_offset_rate: 0.2,
        output_log_scale_rate: 0.3,
        output_rotation_rate: 0.4,
        output_opacity_rate: 0.5,
        output_color_rate: 0.6,
        ..picture(16, 16)
    }
}

fn decode_anchors() -> Case {
    let mut effective = [1.0; N_PARAMS as usize];
    (effective[0], effective[3], effective[11]) = (1.125, 1.0 + 0.25 * 2.0, 1.0 + 4.0 * 0.5);
    Case {
        kernel: Kernel::DecodeAnchors,
        nth_stage: 0,
        view: view(),
        before: before([1.0; N_PARAMS as usize]),
        after: vec![(Buffer::Effective, reals(effective.into_iter().flat_map(|v| [v, 9.0])))],
        mutation: ["max(low[i], 0.0)", "min(low[i], 0.0)"],
    }
}

fn decode_anchors_backward() -> Case {
    // Gradients of outputs 3 and 11; of the units 0.25 2 and 4 0.5, and nothing of the one that is asleep.
    let mut gradients = [0.0; N_PARAMS as usize];
    (gradients[3], gradients[11]) = (2.0, 0.5);
    let sums = [
        (w1(0, 0), 1.5 * 0.5),
        (w1(0, 1), 1.5 * 2.0),
        (w1(AHEAD, 0), 0.5),
        (w1(AHEAD, 1), 2.0),
        (w1(INPUTS, 0), 0.5),
        (w1(INPUTS, 1), 2.0),
        (w2(0, 3), 2.0 * 2.0),
        (w2(0, 11), 2.0 * 0.5),
        (w2(1, 3), 0.5 * 2.0),
        (w2(1, 11), 0.5 * 0.5),
        (w2(HIDDEN, 3), 2.0),
        (w2(HIDDEN, 11), 0.5),
    ];
    // The first input of the direction has a gradient of 8 2, that of the logarithm 6 0.5; per m, 16 m away, the
    // direction changes by 1/16 and the logarithm by 1 / (3 ln 2) / 16. Other pieces are empty.
    let mut camera = [0.0; 3 * DECODER_PIECES as usize];
    (camera[0], camera[2]) = (1.0, 0.090_168_44);
    // The feature's gradient is 2 0.5; its first step is the rate.
    let moments = |first: f32, second: f32, steps: f32| [feature(first), feature(second), reals([steps])].concat();
    Case {
        kernel: Kernel::DecodeAnchorsBackward,
        nth_stage: 0,
        view: ViewBlock { finds_pose: 1, ..view() },
        before: [before(gradients), vec![(Buffer::FeatureMoments, moments(0.0, 0.0, 0.0))]].concat(),
        after: vec![
            (Buffer::Features, feature(1.4)),
            (Buffer::FeatureMoments, moments(0.1, 0.001, 1.0)),
            (Buffer::DecoderSums, [numbers(DECODER_PIECES as usize, &sums), reals(camera)].concat()),
        ],
        mutation: ["columns.low < drawn", "columns.low >= drawn"],
    }
}

fn step_decoder() -> Case {
    // The first weight's gradient is in the first and the last piece. First steps are the rates.
    let last = (DECODER_PIECES as usize - 1) * LEN;
    let sums = [(w1(0, 0), 0.75), (last + w1(0, 0), 0.25), (w2(5, 3), -2.0), (w2(HIDDEN, 13), 1.0)];
    let second_row = |values: [f32; 3]| {
        let places = [w1(0, 0), w2(5, 3), w2(HIDDEN, 13)].map(|at| LEN + at);
        numbers(2, &[(places[0], values[0]), (places[1], values[1]), (places[2], values[2])])
    };
    Case {
        kernel: Kernel::StepDecoder,
        nth_stage: 0,
        view: view(),
        before: vec![
            (Buffer::DecoderSums, numbers(DECODER_PIECES as usize, &sums)),
            (Buffer::Decoders, second_row([0.5, 0.5, 2.0])),
            (Buffer::DecoderFirst, second_row([0.0; 3])),
            (Buffer::DecoderSecond, second_row([0.0; 3])),
        ],
        after: vec![
            (Buffer::Decoders, second_row([0.4, 0.8, 1.4])),
            (Buffer::DecoderFirst, second_row([0.1, -0.2, 0.1])),
            (Buffer::DecoderSecond, second_row([0.001, 0.004, 0.001])),
        ],
        mutation: ["grad += decoder_sums", "grad -= decoder_sums"],
    }
}
