//! Adam.

use super::{Case, counters, exact, picture, reals, words_of};
use crate::splat::kernel_constants::TEXEL_NUMBERS;
use crate::splat::kernels::Kernel;
use crate::splat::layout::{Splat, ViewBlock};
use crate::splat::program::Buffer;

pub fn cases() -> Vec<Case> {
    vec![step_params(), step_sky()]
}

fn step_params() -> Case {
    let rates = [0.1, 0.1, 0.1, 0.2, 0.2, 0.2, 0.3, 0.3, 0.3, 0.3, 0.4, 0.5, 0.5, 0.5];
    // The second step, after a gradient of 3, with one of -1: the means are 0.9 0.3 - 0.1 and 0.999 0.009 + 0.001, and
    // their corrections 1 - 0.9^2 and 1 - 0.999^2.
    let stepped = rates.map(|rate| 1.0 - rate * 0.400_218_6);
    let two = |first: [f32; 14], second: [f32; 14]| reals([first, second].concat());
    Case {
        kernel: Kernel::StepParams,
        nth_stage: 0,
        view: ViewBlock {
            candidate_capacity: 2,
            offset_rate: 0.1,
            log_scale_rate: 0.2,
            rotation_rate: 0.3,
            opacity_rate: 0.4,
            color_rate: 0.5,
            ..picture(16, 16)
        },
        before: vec![
            (Buffer::Counters, words_of(&[counters(2)])),
            (Buffer::Candidates, exact([1, 0])),
            // The second candidate, Gaussian 0, does not meet the picture.
            (Buffer::Splats, words_of(&[Splat::default(), Splat { columns_px: u32::MAX, ..Splat::default() }])),
            (Buffer::Effective, reals([-1.0; 28])),
            (Buffer::Params, reals([1.0; 28])),
            (Buffer::ParamFirst, reals([0.3; 28])),
            (Buffer::ParamSecond, reals([0.009; 28])),
            (Buffer::ParamSteps, exact([5, 1])),
        ],
        after: vec![
            (Buffer::Params, two([1.0; 14], stepped)),
            (Buffer::ParamFirst, two([0.3; 14], [0.17; 14])),
            (Buffer::ParamSecond, two([0.009; 14], [0.009_991; 14])),
            (Buffer::ParamSteps, exact([5, 2])),
        ],
        mutation: ["n.value - rate", "n.value + rate"],
    }
}

fn step_sky() -> Case {
    let n = TEXEL_NUMBERS as usize;
    // The numbers of the second chunk row, all of them `otherwise` but for the first four.
    let numbers = |otherwise: f32, first: [f32; 4]| {
        let mut all = vec![otherwise; 2 * n];
        all[n..n + 4].copy_from_slice(&first);
        reals(all)
    };
    let mut gradients = vec![0.0; n];
    gradients[..2].copy_from_slice(&[1.0, -1.0]);
    // The first step moves by the rate, and not beyond 1; without a gradient now, what was learnt before goes on; without
    // any nothing happens.
    Case {
        kernel: Kernel::StepSky,
        nth_stage: 0,
        view: ViewBlock { first_texel: TEXEL_NUMBERS / 3, background_rate: 0.1, background_step: 1, ..picture(16, 16) },
        before: vec![
            (Buffer::TexelGrads, reals(gradients)),
            (Buffer::Texels, numbers(0.5, [0.5, 0.95, 0.5, 0.5])),
            (Buffer::TexelFirst, numbers(0.0, [0.0, 0.0, 0.0, 0.2])),
            (Buffer::TexelSecond, numbers(0.0, [0.0, 0.0, 0.0, 0.004])),
        ],
        after: vec![
            (Buffer::Texels, numbers(0.5, [0.4, 1.0, 0.5, 0.5 - 0.18 / 3.996_f32.sqrt()])),
            (Buffer::TexelFirst, numbers(0.0, [0.1, -0.1, 0.0, 0.18])),
            (Buffer::TexelSecond, numbers(0.0, [0.001, 0.001, 0.0, 0.003_996])),
        ],
        mutation: ["clamp(after.value, 0.0, 1.0)", "max(after.value, 0.0)"],
    }
}
