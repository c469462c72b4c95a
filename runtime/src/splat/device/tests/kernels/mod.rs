//! Every kernel alone, on numbers that can be followed by hand.
//!
//! A case says what the buffers hold, and what they hold afterwards; the words behind that must not be touched. It also
//! names one operator of the kernel's text and what to put in its place: with that, the same case must fail.

mod backward;
mod bin;
mod blend;
mod cull;
mod decoder;
mod loss;
mod optimizer;
mod project;
mod score;
mod sky;
mod sort;
mod ssim;

use super::devices::{on_every_executor, wgpu_executor};
use crate::splat::Capacities;
use crate::splat::device::Executor;
use crate::splat::kernels::{KERNELS, Kernel};
use crate::splat::layout::{Counters, ViewBlock};
use crate::splat::program::{Buffer, Part, WorkSize, buffer_plan};
use zerocopy::{Immutable, IntoBytes};

/// A kernel on hand-sized buffers.
pub struct Case {
    kernel: Kernel,
    /// Which of the kernel's stages runs, in the order of the program.
    nth_stage: usize,
    view: ViewBlock,
    before: Vec<(Buffer, Vec<Word>)>,
    after: Vec<(Buffer, Vec<Word>)>,
    /// A piece of the kernel's text that occurs once, and what is put there to break it.
    mutation: [&'static str; 2],
}

/// All cases, a family of kernels after the other.
fn cases() -> Vec<Case> {
    [
        cull::cases(),
        project::cases(),
        sort::cases(),
        bin::cases(),
        decoder::cases(),
        blend::cases(),
        sky::cases(),
        loss::cases(),
        score::cases(),
        ssim::cases(),
        backward::cases(),
        optimizer::cases(),
    ]
    .into_iter()
    .flatten()
    .collect()
}

/// Four bytes of a buffer, and how they are compared.
#[derive(Clone, Copy, Debug)]
pub enum Word {
    /// Exactly.
    U(u32),
    /// To within 1e-4 of itself: a sum in fixed point.
    I(i32),
    /// To within 1e-5 of itself or 1e-6.
    F(f32),
}

impl Word {
    fn bits(self) -> u32 {
        match self {
            Self::U(v) => v,
            Self::I(v) => v as u32,
            Self::F(v) => v.to_bits(),
        }
    }

    fn accepts(self, bits: u32) -> bool {
        match self {
            Self::U(v) => v == bits,
            Self::I(v) => (f64::from(v) - f64::from(bits as i32)).abs() <= 1e-4 * f64::from(v).abs(),
            Self::F(v) => (v - f32::from_bits(bits)).abs() <= 1e-6 + 1e-5 * v.abs(),
        }
    }
}

/// Words to be compared exactly.
fn exact(words: impl IntoIterator<Item = u32>) -> Vec<Word> {
    words.into_iter().map(Word::U).collect()
}

/// Words to be compared as fixed point.
fn fixed(words: impl IntoIterator<Item = i32>) -> Vec<Word> {
    words.into_iter().map(Word::I).collect()
}

/// Words to be compared as reals.
fn reals(words: impl IntoIterator<Item = f32>) -> Vec<Word> {
    words.into_iter().map(Word::F).collect()
}

/// The words of structs, to be compared exactly.
fn words_of<T: IntoBytes + Immutable>(values: &[T]) -> Vec<Word> {
    exact(values.as_bytes().as_chunks().0.iter().map(|&bytes| u32::from_le_bytes(bytes)))
}

/// Counters with some candidates, all of them visible.
fn counters(candidates: u32) -> Counters {
    Counters { candidates_needed: candidates, candidates, visible: candidates, ..Counters::default() }
}

/// The view of a picture of this size.
fn picture(width: u32, height: u32) -> ViewBlock {
    ViewBlock {
        width,
        height,
        tile_columns: width.div_ceil(16),
        tile_rows: height.div_ceil(16),
        candidate_capacity: 8,
        entry_capacity: 8,
        pair_capacity: 8,
        k: 1,
        ..ViewBlock::default()
    }
}

/// Room for every case.
fn capacities() -> Capacities {
    Capacities {
        keyframe_rows: 2,
        chunk_rows: 2,
        visible_gaussians: 4096,
        training_pixels: 64,
        learned_decoder: true,
        ..Capacities::for_map(300 * 256, 3, 272, 272)
    }
}

/// What lies in a buffer before a case, and behind what it uses.
const SENTINEL: u32 = 0xdead_beef;
/// Words behind the expected ones that must not be touched.
const GUARD: usize = 16;

impl Case {
    /// Runs the kernel; what differs from the expectation, if anything.
    fn run(&self, executor: &mut dyn Executor) -> Result<(), String> {
        let plan = buffer_plan(&capacities());
        let room = |buffer: Buffer| plan[buffer as usize].bytes() / size_of::<u32>();
        let mut set = |buffer: Buffer, words: &[u32]| {
            let padded: Vec<u32> = words.iter().copied().chain([SENTINEL; GUARD]).take(room(buffer)).collect();
            assert!(words.len() <= padded.len(), "{buffer:?} has no room for {} words", words.len());
            executor.upload(buffer, 0, padded.as_bytes()).expect("upload");
        };
        set(
            Buffer::View,
            self.view.as_bytes().as_chunks().0.iter().map(|&b| u32::from_le_bytes(b)).collect::<Vec<_>>().as_slice(),
        );
        for (digit, buffer) in (0..).zip([Buffer::Digit0, Buffer::Digit1, Buffer::Digit2, Buffer::Digit3]) {
            set(buffer, &[digit]);
        }
        set(Buffer::Dispatch, &[1, 1, 1]);
        for (buffer, words) in &self.after {
            set(*buffer, &vec![SENTINEL; words.len()]);
        }
        for (buffer, words) in &self.before {
            set(*buffer, &words.iter().map(|word| word.bits()).collect::<Vec<_>>());
        }
        let (part, stage) = self.stage();
        let work = WorkSize { slots: self.view.n_slots, width_px: self.view.width, height_px: self.view.height };
        executor.run_stage(part, stage, &work).expect("run");
        self.after.iter().try_for_each(|(buffer, words)| {
            let mut found = vec![0; (words.len() + GUARD).min(room(*buffer))];
            executor.download(*buffer, 0, found.as_mut_bytes()).expect("download");
            let expected = words.iter().copied().chain([Word::U(SENTINEL); GUARD]);
            match expected.zip(&found).position(|(word, &bits)| !word.accepts(bits)) {
                None => Ok(()),
                Some(i) => Err(format!(
                    "{buffer:?}[{i}] = {:#x} = {}, expected {:?}",
                    found[i],
                    f32::from_bits(found[i]),
                    words.get(i).unwrap_or(&Word::U(SENTINEL))
                )),
            }
        })
    }

    fn stage(&self) -> (Part, usize) {
        let stages = Part::ALL.iter().flat_map(|&part| (0..part.stages().len()).map(move |i| (part, i)));
        let mut own = stages.filter(|&(part, i)| part.stages()[i].kernel == self.kernel);
        own.nth(self.nth_stage).expect("the program has this stage")
    }

    fn mutated(&self) -> String {
        let text = self.kernel.spec().wgsl();
        let [from, to] = self.mutation;
        assert_eq!(text.matches(from).count(), 1, "{:?}: \"{from}\" is to occur once", self.kernel);
        text.replace(from, to)
    }
}

#[test]
fn every_kernel_has_a_case() {
    let cases = cases();
    let missing: Vec<_> = (0..KERNELS.len()).filter(|&i| cases.iter().all(|case| case.kernel as usize != i)).collect();
    let names: Vec<_> = missing.into_iter().map(|i| KERNELS[i].name).collect();
    assert!(
        names.is_empty(),
        "no case for {names:?}: add one to the `cases` of a file beside this one. Give the buffers that the kernel reads \
         (`before`) numbers so small that you know what it must write (`after`), and name an operator of its text with \
         which the case must fail (`mutation`)"
    );
}

#[test]
fn kernels_do_what_can_be_followed_by_hand() {
    on_every_executor(&capacities(), |who, executor| {
        for case in cases() {
            case.run(executor).unwrap_or_else(|error| panic!("{:?} on {who}: {error}", case.kernel));
        }
    });
}

#[test]
fn a_wrong_operator_in_any_kernel_is_noticed() {
    let Some(mut executor) = wgpu_executor(&capacities()) else { return };
    for case in cases() {
        executor.replace_kernel(case.kernel, case.mutated()).unwrap_or_else(|e| panic!("{:?}: {e}", case.kernel));
        let [from, to] = case.mutation;
        match case.run(&mut executor) {
            Ok(()) => panic!("{:?} passes with \"{to}\" for \"{from}\"", case.kernel),
            Err(found) => println!("{:?} with \"{to}\": {found}", case.kernel),
        }
        executor.replace_kernel(case.kernel, case.kernel.spec().wgsl()).expect("its own text");
    }
}
