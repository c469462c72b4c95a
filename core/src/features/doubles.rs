//! Four 64-bit numbers in a SIMD register, written out once for AVX2 and once for all.
//!
//! Every operation rounds as IEEE 754 says and none is fused, so that both give the same bits. Closures handed to functions
//! of the standard library are not compiled for the instructions: code with these numbers is written without them.

use super::lanes::Plain;
use core::ops::{Add, Div, Mul, Sub};
use nalgebra::Vector3;

/// Numbers of a register.
pub(crate) const FOUR: usize = 4;

/// Four numbers; operators act on each of them.
pub(crate) trait Doubles:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self>
{
    fn values(self) -> [f64; FOUR];
    fn abs(self) -> Self;
    /// The larger one of each pair; `floor` where the other one is no number.
    fn at_least(self, floor: Self) -> Self;
    /// `then` where `self < limit`, else `otherwise`.
    fn if_less(self, limit: Self, then: Self, otherwise: Self) -> Self;
    /// Columns of the rows.
    fn transpose(rows: [Self; FOUR]) -> [Self; FOUR];
}

/// Makes [`Doubles`].
pub(crate) trait DoublesKernel: Copy {
    /// Four numbers.
    type Doubles: Doubles;

    fn doubles(self, values: [f64; FOUR]) -> Self::Doubles;
    fn all(self, value: f64) -> Self::Doubles;
    /// The byte of every word above its lowest `SHIFT` bits.
    fn bytes<const SHIFT: i32>(self, words: [u32; FOUR]) -> Self::Doubles;
}

/// A register for each component of a vector, filled with it.
#[inline(always)]
pub(crate) fn all_of<K: DoublesKernel>(kernel: K, vector: &Vector3<f64>) -> [K::Doubles; 3] {
    [kernel.all(vector.x), kernel.all(vector.y), kernel.all(vector.z)]
}

/// `a + weight (b - a)`.
#[inline(always)]
pub(crate) fn blend<D: Doubles>(a: D, b: D, weight: D) -> D {
    a + weight * (b - a)
}

/// Four numbers in plain loops.
#[derive(Clone, Copy)]
pub(crate) struct PlainDoubles([f64; FOUR]);

#[inline(always)]
fn map(a: PlainDoubles, b: PlainDoubles, f: impl Fn(f64, f64) -> f64) -> PlainDoubles {
    let mut out = a;
    for (out, &b) in out.0.iter_mut().zip(&b.0) {
        *out = f(*out, b);
    }
    out
}

impl Add for PlainDoubles {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        map(self, other, f64::add)
    }
}

impl Sub for PlainDoubles {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        map(self, other, f64::sub)
    }
}

impl Mul for PlainDoubles {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        map(self, other, f64::mul)
    }
}

impl Div for PlainDoubles {
    type Output = Self;
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        map(self, other, f64::div)
    }
}

impl Doubles for PlainDoubles {
    #[inline(always)]
    fn values(self) -> [f64; FOUR] {
        self.0
    }

    #[inline(always)]
    fn abs(self) -> Self {
        map(self, self, |a, _| a.abs())
    }

    #[inline(always)]
    fn at_least(self, floor: Self) -> Self {
        map(self, floor, |a, floor| if a > floor { a } else { floor })
    }

    #[inline(always)]
    fn if_less(self, limit: Self, then: Self, otherwise: Self) -> Self {
        let mut out = otherwise;
        for (i, out) in out.0.iter_mut().enumerate() {
            *out = if self.0[i] < limit.0[i] { then.0[i] } else { *out };
        }
        out
    }

    #[inline(always)]
    fn transpose(rows: [Self; FOUR]) -> [Self; FOUR] {
        let mut columns = [Self([0.0; FOUR]); FOUR];
        for (i, row) in rows.iter().enumerate() {
            for (column, &value) in columns.iter_mut().zip(&row.0) {
                column.0[i] = value;
            }
        }
        columns
    }
}

impl DoublesKernel for Plain {
    type Doubles = PlainDoubles;

    #[inline(always)]
    fn doubles(self, values: [f64; FOUR]) -> PlainDoubles {
        PlainDoubles(values)
    }

    #[inline(always)]
    fn all(self, value: f64) -> PlainDoubles {
        PlainDoubles([value; FOUR])
    }

    #[inline(always)]
    fn bytes<const SHIFT: i32>(self, words: [u32; FOUR]) -> PlainDoubles {
        let mut values = [0.0; FOUR];
        for (value, word) in values.iter_mut().zip(words) {
            *value = f64::from(word >> SHIFT & 0xff);
        }
        PlainDoubles(values)
    }
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use super::{Add, Div, Doubles, DoublesKernel, FOUR, Mul, Sub};
    use core::arch::x86_64::{__m128i, __m256d};
    use pulp::cast;
    use pulp::x86::V3;

    /// A register, and the proof that the machine has it.
    #[derive(Clone, Copy)]
    pub(crate) struct AvxDoubles(V3, __m256d);

    impl Add for AvxDoubles {
        type Output = Self;
        #[inline(always)]
        fn add(self, other: Self) -> Self {
            Self(self.0, self.0.avx._mm256_add_pd(self.1, other.1))
        }
    }

    impl Sub for AvxDoubles {
        type Output = Self;
        #[inline(always)]
        fn sub(self, other: Self) -> Self {
            Self(self.0, self.0.avx._mm256_sub_pd(self.1, other.1))
        }
    }

    impl Mul for AvxDoubles {
        type Output = Self;
        #[inline(always)]
        fn mul(self, other: Self) -> Self {
            Self(self.0, self.0.avx._mm256_mul_pd(self.1, other.1))
        }
    }

    impl Div for AvxDoubles {
        type Output = Self;
        #[inline(always)]
        fn div(self, other: Self) -> Self {
            Self(self.0, self.0.avx._mm256_div_pd(self.1, other.1))
        }
    }

    impl Doubles for AvxDoubles {
        #[inline(always)]
        fn values(self) -> [f64; FOUR] {
            cast(self.1)
        }

        #[inline(always)]
        fn abs(self) -> Self {
            let sign = self.0.avx._mm256_set1_pd(-0.0);
            Self(self.0, self.0.avx._mm256_andnot_pd(sign, self.1))
        }

        #[inline(always)]
        fn at_least(self, floor: Self) -> Self {
            Self(self.0, self.0.avx._mm256_max_pd(self.1, floor.1))
        }

        #[inline(always)]
        fn if_less(self, limit: Self, then: Self, otherwise: Self) -> Self {
            const LESS_ORDERED_QUIET: i32 = core::arch::x86_64::_CMP_LT_OQ;
            let mask = self.0.avx._mm256_cmp_pd::<LESS_ORDERED_QUIET>(self.1, limit.1);
            Self(self.0, self.0.avx._mm256_blendv_pd(otherwise.1, then.1, mask))
        }

        #[inline(always)]
        fn transpose([a, b, c, d]: [Self; FOUR]) -> [Self; FOUR] {
            let (token, avx) = (a.0, a.0.avx);
            let (ab_even, ab_odd) = (avx._mm256_unpacklo_pd(a.1, b.1), avx._mm256_unpackhi_pd(a.1, b.1));
            let (cd_even, cd_odd) = (avx._mm256_unpacklo_pd(c.1, d.1), avx._mm256_unpackhi_pd(c.1, d.1));
            [
                Self(token, avx._mm256_permute2f128_pd::<0x20>(ab_even, cd_even)),
                Self(token, avx._mm256_permute2f128_pd::<0x20>(ab_odd, cd_odd)),
                Self(token, avx._mm256_permute2f128_pd::<0x31>(ab_even, cd_even)),
                Self(token, avx._mm256_permute2f128_pd::<0x31>(ab_odd, cd_odd)),
            ]
        }
    }

    impl DoublesKernel for V3 {
        type Doubles = AvxDoubles;

        #[inline(always)]
        fn doubles(self, values: [f64; FOUR]) -> AvxDoubles {
            AvxDoubles(self, cast(values))
        }

        #[inline(always)]
        fn all(self, value: f64) -> AvxDoubles {
            AvxDoubles(self, self.avx._mm256_set1_pd(value))
        }

        #[inline(always)]
        fn bytes<const SHIFT: i32>(self, words: [u32; FOUR]) -> AvxDoubles {
            let words: __m128i = cast(words);
            let byte =
                self.sse2._mm_and_si128(self.sse2._mm_srli_epi32::<SHIFT>(words), self.sse2._mm_set1_epi32(0xff));
            AvxDoubles(self, self.avx._mm256_cvtepi32_pd(byte))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::features::SimdLevel;
    use crate::features::lanes::{Kernel, KernelTask};

    /// Bits of every operation on two quadruples of numbers.
    struct Everything<'a> {
        a: [f64; FOUR],
        b: [f64; FOUR],
        found: &'a mut [[u64; FOUR]; 14],
    }

    impl KernelTask for Everything<'_> {
        fn run<K: Kernel>(self, kernel: K) {
            let (a, b, one) = (kernel.doubles(self.a), kernel.doubles(self.b), kernel.all(1.0));
            let [t0, t1, t2, t3] = Doubles::transpose([a, b, a - b, one]);
            let words = [0x0403_0201, 0xff00_ff80, u32::MAX, 7];
            let all = [
                a + b,
                a - b,
                a * b,
                a / b,
                a.abs(),
                a.at_least(b),
                a.if_less(b, one, b),
                a,
                t0,
                t1,
                t2,
                t3,
                kernel.bytes::<0>(words),
                kernel.bytes::<24>(words),
            ];
            *self.found = all.map(|four| four.values().map(f64::to_bits));
        }
    }

    #[test]
    fn every_level_gives_the_bits_of_plain_arithmetic() {
        let a = [1.0 / 3.0, -7.25, f64::NAN, 1e300];
        let b = [3.0, -7.25, 0.5, f64::INFINITY];
        for simd in [SimdLevel::new(), SimdLevel::Scalar] {
            let mut found = [[0; FOUR]; 14];
            simd.run(Everything { a, b, found: &mut found });
            for i in 0..FOUR {
                let (a, b) = (a[i], b[i]);
                let larger = if a > b { a } else { b };
                let chosen = if a < b { 1.0 } else { b };
                let expected = [a + b, a - b, a * b, a / b, a.abs(), larger, chosen, a];
                for (k, expected) in expected.iter().enumerate() {
                    let value = f64::from_bits(found[k][i]);
                    let is_same = value.to_bits() == expected.to_bits() || value.is_nan() && expected.is_nan();
                    assert!(is_same, "{simd:?}, operation {k}, number {i}: {value} for {expected}");
                }
            }
            let column = found[8].map(f64::from_bits);
            assert_eq!(column, [a[0], b[0], a[0] - b[0], 1.0], "{simd:?}");
            assert_eq!(found[12].map(f64::from_bits), [1.0, 128.0, 255.0, 7.0], "{simd:?}");
            assert_eq!(found[13].map(f64::from_bits), [4.0, 255.0, 255.0, 0.0], "{simd:?}");
        }
    }
}
