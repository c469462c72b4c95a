//! What this machine can do at most, measured beside the rest so that it suffers from the same neighbors.

use pulp::{Arch, Simd, WithSimd};
use std::hint::black_box;
use std::time::Instant;

/// Upper bounds for all threads together.
#[derive(Clone, Copy)]
pub struct Machine {
    /// Bytes read and written per second by `a = b + s c` on arrays far larger than any cache.
    pub bytes_per_s: f64,
    /// Single-precision operations per second of fused multiply-adds on registers.
    pub flops_per_s: f64,
}

/// Elements of each array of the triad: 64 MiB.
const TRIAD_ELEMENTS: usize = 16 << 20;
const TRIAD_ROUNDS: usize = 6;

/// Independent accumulators: enough to hide the latency of two fused multiply-add units.
const ACCUMULATORS: usize = 10;
const FMA_ROUNDS: usize = 20_000_000;

impl Machine {
    /// Takes a second or two.
    pub fn measure(threads: usize) -> Self {
        let bytes_per_s = together(threads, || triad(TRIAD_ELEMENTS / threads));
        let flops_per_s = together(threads, || Arch::new().dispatch(MultiplyAdds));
        Self { bytes_per_s, flops_per_s }
    }
}

/// Sum of what `threads` runs of `work` at the same time achieved.
fn together(threads: usize, work: impl Fn() -> f64 + Sync) -> f64 {
    std::thread::scope(|scope| {
        let running: Vec<_> = (0..threads).map(|_| scope.spawn(&work)).collect();
        running.into_iter().map(|thread| thread.join().unwrap_or(f64::NAN)).sum()
    })
}

/// Best of some rounds, bytes per second (McCalpin's STREAM triad, without its count of write-allocates).
fn triad(n: usize) -> f64 {
    let (b, c) = (vec![1.0f32; n], vec![2.0f32; n]);
    let mut a = vec![0.0f32; n];
    let mut best_s = f64::INFINITY;
    for _ in 0..TRIAD_ROUNDS {
        let start = Instant::now();
        for ((a, b), c) in a.iter_mut().zip(&b).zip(&c) {
            *a = b + 3.0 * c;
        }
        black_box(&mut a);
        best_s = best_s.min(start.elapsed().as_secs_f64());
    }
    (3 * n * size_of::<f32>()) as f64 / best_s
}

struct MultiplyAdds;

impl WithSimd for MultiplyAdds {
    type Output = f64;
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> f64 {
        let start = Instant::now();
        // Numbers that the compiler cannot know, so that nothing is computed before the clock is read.
        let (factor, term) = (simd.splat_f32s(black_box(0.999)), simd.splat_f32s(black_box(1e-3)));
        let mut sums = [simd.splat_f32s(black_box(1.0)); ACCUMULATORS];
        for _ in 0..FMA_ROUNDS {
            for sum in &mut sums {
                *sum = simd.mul_add_f32s(*sum, factor, term);
            }
        }
        // Without this the sums would be computed after the clock has been read.
        let sums = black_box(sums);
        let seconds = start.elapsed().as_secs_f64();
        black_box(sums);
        (2 * ACCUMULATORS * S::F32_LANES * FMA_ROUNDS) as f64 / seconds
    }
}
