//! One row of a window in SIMD registers: thirty-two 16-bit integers, written out once for AVX2 and once for all.
//!
//! Every operation is an exact integer operation, so that both give the same bits.

use super::doubles::DoublesKernel;

/// Pixels of a row: a 21-px window rounded up to whole registers.
pub(crate) const LANES: usize = 32;

/// Which SIMD instructions the machine has: a token made once at start-up by the caller.
/// The results have the same bits on every level.
#[derive(Clone, Copy, Debug)]
pub enum SimdLevel {
    /// What the compiler makes of plain loops.
    Scalar,
    /// AVX2, written out.
    #[cfg(target_arch = "x86_64")]
    Avx2(pulp::x86::V3),
}

impl SimdLevel {
    /// The best level of this machine.
    #[expect(clippy::new_without_default, reason = "a detection is not a default")]
    pub fn new() -> Self {
        #[cfg(target_arch = "x86_64")]
        if let Some(token) = pulp::x86::V3::try_new() {
            return Self::Avx2(token);
        }
        Self::Scalar
    }

    /// Runs `task` with the kernels of this level, compiled for its instructions.
    #[inline(always)]
    pub(crate) fn run<T: KernelTask>(self, task: T) {
        match self {
            Self::Scalar => task.run(Plain),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2(token) => pulp::Simd::vectorize(token, Vectorized { task, kernel: token }),
        }
    }
}

/// Work that is compiled once per SIMD level. All it calls must be `#[inline(always)]`.
pub(crate) trait KernelTask {
    /// Does the work with the operations of `kernel`.
    fn run<K: Kernel>(self, kernel: K);
}

#[cfg(target_arch = "x86_64")]
struct Vectorized<T, K> {
    task: T,
    kernel: K,
}

#[cfg(target_arch = "x86_64")]
impl<T: KernelTask, K: Kernel> pulp::WithSimd for Vectorized<T, K> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _simd: S) {
        self.task.run(self.kernel);
    }
}

/// Operations on rows of sixteen-bit lanes; all wrap on overflow, which the callers' bounds exclude.
pub(crate) trait Kernel: DoublesKernel {
    /// A row of [`LANES`] lanes.
    type Row: Copy;
    /// Sums of neighbouring pairs of lanes.
    type Sums: Copy;

    fn load(self, lanes: &[i16; LANES]) -> Self::Row;
    fn store(self, row: Self::Row, lanes: &mut [i16; LANES]);
    fn splat(self, value: i16) -> Self::Row;
    fn add(self, a: Self::Row, b: Self::Row) -> Self::Row;
    fn subtract(self, a: Self::Row, b: Self::Row) -> Self::Row;
    fn and(self, a: Self::Row, b: Self::Row) -> Self::Row;
    /// Divides by 2^N, towards minus infinity.
    fn shift_right<const N: i32>(self, a: Self::Row) -> Self::Row;
    /// `a + (b - a) * weight`, rounded; the weight is in units of 2^-15, differences must fit.
    fn blend(self, a: Self::Row, b: Self::Row, weight: Self::Row) -> Self::Row;
    /// Bytes times 2^N.
    fn widen<const N: i32>(self, pixels: &[u8; LANES]) -> Self::Row;
    fn zero(self) -> Self::Sums;
    /// `sums[k] + a[2k] b[2k] + a[2k + 1] b[2k + 1]`.
    fn add_products(self, sums: Self::Sums, a: Self::Row, b: Self::Row) -> Self::Sums;
    fn total(self, sums: Self::Sums) -> i64;
    /// Square root, correctly rounded. (A root from elsewhere may be encoded without VEX, which stalls AVX code.)
    fn sqrt(self, value: f64) -> f64;
}

/// Plain loops, for every machine.
#[derive(Clone, Copy)]
pub(crate) struct Plain;

#[inline(always)]
fn map_lanes(a: [i16; LANES], b: [i16; LANES], f: impl Fn(i16, i16) -> i16) -> [i16; LANES] {
    let mut out = [0; LANES];
    for i in 0..LANES {
        out[i] = f(a[i], b[i]);
    }
    out
}

impl Kernel for Plain {
    type Row = [i16; LANES];
    type Sums = [i32; LANES / 2];

    #[inline(always)]
    fn load(self, lanes: &[i16; LANES]) -> Self::Row {
        *lanes
    }

    #[inline(always)]
    fn store(self, row: Self::Row, lanes: &mut [i16; LANES]) {
        *lanes = row;
    }

    #[inline(always)]
    fn splat(self, value: i16) -> Self::Row {
        [value; LANES]
    }

    #[inline(always)]
    fn add(self, a: Self::Row, b: Self::Row) -> Self::Row {
        map_lanes(a, b, i16::wrapping_add)
    }

    #[inline(always)]
    fn subtract(self, a: Self::Row, b: Self::Row) -> Self::Row {
        map_lanes(a, b, i16::wrapping_sub)
    }

    #[inline(always)]
    fn and(self, a: Self::Row, b: Self::Row) -> Self::Row {
        map_lanes(a, b, |a, b| a & b)
    }

    #[inline(always)]
    fn shift_right<const N: i32>(self, a: Self::Row) -> Self::Row {
        map_lanes(a, a, |a, _| a >> N)
    }

    #[inline(always)]
    fn blend(self, a: Self::Row, b: Self::Row, weight: Self::Row) -> Self::Row {
        let mut out = [0; LANES];
        for i in 0..LANES {
            let product = i32::from(b[i].wrapping_sub(a[i])) * i32::from(weight[i]);
            out[i] = a[i].wrapping_add((((product >> 14) + 1) >> 1) as i16);
        }
        out
    }

    #[inline(always)]
    fn widen<const N: i32>(self, pixels: &[u8; LANES]) -> Self::Row {
        let mut out = [0; LANES];
        for i in 0..LANES {
            out[i] = i16::from(pixels[i]) << N;
        }
        out
    }

    #[inline(always)]
    fn zero(self) -> Self::Sums {
        [0; LANES / 2]
    }

    #[inline(always)]
    fn add_products(self, mut sums: Self::Sums, a: Self::Row, b: Self::Row) -> Self::Sums {
        for k in 0..LANES / 2 {
            let even = i32::from(a[2 * k]) * i32::from(b[2 * k]);
            let odd = i32::from(a[2 * k + 1]) * i32::from(b[2 * k + 1]);
            sums[k] = sums[k].wrapping_add(even.wrapping_add(odd));
        }
        sums
    }

    #[inline(always)]
    fn total(self, sums: Self::Sums) -> i64 {
        let mut total = 0;
        for sum in sums {
            total += i64::from(sum);
        }
        total
    }

    #[inline(always)]
    fn sqrt(self, value: f64) -> f64 {
        libm::sqrt(value)
    }
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use super::{Kernel, LANES};
    use core::arch::x86_64::{__m128i, __m256i};
    use pulp::cast;
    use pulp::x86::V3;

    impl Kernel for V3 {
        type Row = [__m256i; 2];
        type Sums = [__m256i; 2];

        #[inline(always)]
        fn load(self, lanes: &[i16; LANES]) -> Self::Row {
            cast(*lanes)
        }

        #[inline(always)]
        fn store(self, row: Self::Row, lanes: &mut [i16; LANES]) {
            *lanes = cast(row);
        }

        #[inline(always)]
        fn splat(self, value: i16) -> Self::Row {
            [self.avx._mm256_set1_epi16(value); 2]
        }

        #[inline(always)]
        fn add(self, a: Self::Row, b: Self::Row) -> Self::Row {
            [self.avx2._mm256_add_epi16(a[0], b[0]), self.avx2._mm256_add_epi16(a[1], b[1])]
        }

        #[inline(always)]
        fn subtract(self, a: Self::Row, b: Self::Row) -> Self::Row {
            [self.avx2._mm256_sub_epi16(a[0], b[0]), self.avx2._mm256_sub_epi16(a[1], b[1])]
        }

        #[inline(always)]
        fn and(self, a: Self::Row, b: Self::Row) -> Self::Row {
            [self.avx2._mm256_and_si256(a[0], b[0]), self.avx2._mm256_and_si256(a[1], b[1])]
        }

        #[inline(always)]
        fn shift_right<const N: i32>(self, a: Self::Row) -> Self::Row {
            [self.avx2._mm256_srai_epi16::<N>(a[0]), self.avx2._mm256_srai_epi16::<N>(a[1])]
        }

        #[inline(always)]
        fn blend(self, a: Self::Row, b: Self::Row, weight: Self::Row) -> Self::Row {
            let [d0, d1] = self.subtract(b, a);
            let scaled = [self.avx2._mm256_mulhrs_epi16(d0, weight[0]), self.avx2._mm256_mulhrs_epi16(d1, weight[1])];
            self.add(a, scaled)
        }

        #[inline(always)]
        fn widen<const N: i32>(self, pixels: &[u8; LANES]) -> Self::Row {
            let [p0, p1]: [__m128i; 2] = cast(*pixels);
            let (w0, w1) = (self.avx2._mm256_cvtepu8_epi16(p0), self.avx2._mm256_cvtepu8_epi16(p1));
            [self.avx2._mm256_slli_epi16::<N>(w0), self.avx2._mm256_slli_epi16::<N>(w1)]
        }

        #[inline(always)]
        fn zero(self) -> Self::Sums {
            [self.avx._mm256_setzero_si256(); 2]
        }

        #[inline(always)]
        fn add_products(self, sums: Self::Sums, a: Self::Row, b: Self::Row) -> Self::Sums {
            let products = [self.avx2._mm256_madd_epi16(a[0], b[0]), self.avx2._mm256_madd_epi16(a[1], b[1])];
            [self.avx2._mm256_add_epi32(sums[0], products[0]), self.avx2._mm256_add_epi32(sums[1], products[1])]
        }

        #[inline(always)]
        fn total(self, sums: Self::Sums) -> i64 {
            let widen = |sums: __m256i| {
                let low = self.avx2._mm256_cvtepi32_epi64(self.avx._mm256_castsi256_si128(sums));
                let high = self.avx2._mm256_cvtepi32_epi64(self.avx2._mm256_extracti128_si256::<1>(sums));
                self.avx2._mm256_add_epi64(low, high)
            };
            let sums: [i64; 4] = cast(self.avx2._mm256_add_epi64(widen(sums[0]), widen(sums[1])));
            sums[0] + sums[1] + sums[2] + sums[3]
        }

        #[inline(always)]
        fn sqrt(self, value: f64) -> f64 {
            self.sse2._mm_cvtsd_f64(self.sse2._mm_sqrt_pd(self.sse2._mm_set1_pd(value)))
        }
    }
}
