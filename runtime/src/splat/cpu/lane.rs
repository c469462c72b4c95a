//! One number per lane: the mathematics of every kernel is written once over this trait and runs on `f64`
//! (checks against finite differences) and on SIMD vectors of `f32` (everything else).

/// An array of 2, 3 or 4 from an expression of the index, without a closure: a closure is compiled without the
/// instruction set of the kernel that it is in, and would call what should be one instruction.
macro_rules! each {
    ($i:ident in 2 => $element:expr) => {
        [
            {
                let $i = 0usize;
                $element
            },
            {
                let $i = 1usize;
                $element
            },
        ]
    };
    ($i:ident in 3 => $element:expr) => {
        [
            {
                let $i = 0usize;
                $element
            },
            {
                let $i = 1usize;
                $element
            },
            {
                let $i = 2usize;
                $element
            },
        ]
    };
    ($i:ident in 4 => $element:expr) => {
        [
            {
                let $i = 0usize;
                $element
            },
            {
                let $i = 1usize;
                $element
            },
            {
                let $i = 2usize;
                $element
            },
            {
                let $i = 3usize;
                $element
            },
        ]
    };
}
pub(super) use each;

use crate::splat::kernel_constants::EXP2_COEFFICIENTS;
use core::ops::{Add, Div, Mul, Neg, Sub};
use pulp::Simd;

/// Numbers that a kernel works on side by side.
pub trait Lane:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> + Neg<Output = Self>
{
    /// A truth value per lane.
    type Mask: Copy;

    /// The same constant in every lane (of the same kind as `self`).
    fn constant(self, value: f64) -> Self;
    /// `self * factor + addend`, fused where the machine can.
    fn mul_add(self, factor: Self, addend: Self) -> Self;
    /// Square root.
    fn sqrt(self) -> Self;
    /// Magnitude.
    fn abs(self) -> Self;
    /// The smaller one.
    fn min(self, other: Self) -> Self;
    /// The larger one.
    fn max(self, other: Self) -> Self;
    /// `2^self`; the SIMD version has a relative error below 3e-7 for results that are normal numbers, saturates
    /// below at 2^-126 and above at 2^127.
    fn exp2(self) -> Self;
    /// `self < other`.
    fn lt(self, other: Self) -> Self::Mask;
    /// Both.
    fn and(self, a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// `if_true` where the mask is set, `self` elsewhere.
    fn replace(self, mask: Self::Mask, if_true: Self) -> Self;

    /// Zero.
    #[inline(always)]
    fn zero(self) -> Self {
        self.constant(0.0)
    }

    /// `e^self`.
    #[inline(always)]
    fn exp(self) -> Self {
        (self * self.constant(core::f64::consts::LOG2_E)).exp2()
    }

    /// Logistic function.
    #[inline(always)]
    fn sigmoid(self) -> Self {
        self.constant(1.0) / (self.constant(1.0) + (-self).exp())
    }

    /// -1, 0 or 1.
    #[inline(always)]
    fn signum(self) -> Self {
        let zero = self.zero();
        zero.replace(zero.lt(self), self.constant(1.0)).replace(self.lt(zero), self.constant(-1.0))
    }

    /// Into `low..=high`.
    #[inline(always)]
    fn clamp(self, low: Self, high: Self) -> Self {
        self.max(low).min(high)
    }
}

impl Lane for f64 {
    type Mask = bool;

    #[inline(always)]
    fn constant(self, value: f64) -> Self {
        value
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, addend: Self) -> Self {
        self * factor + addend
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        self.sqrt()
    }
    #[inline(always)]
    fn abs(self) -> Self {
        self.abs()
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        self.min(other)
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.max(other)
    }
    #[inline(always)]
    fn exp2(self) -> Self {
        self.exp2()
    }
    #[inline(always)]
    fn lt(self, other: Self) -> bool {
        self < other
    }
    #[inline(always)]
    fn and(self, a: bool, b: bool) -> bool {
        a & b
    }
    #[inline(always)]
    fn replace(self, mask: bool, if_true: Self) -> Self {
        if mask { if_true } else { self }
    }
}

/// A SIMD vector of `f32` together with the proof that the machine has it.
#[derive(Clone, Copy)]
pub struct Wide<S: Simd> {
    simd: S,
    /// The numbers.
    pub v: S::f32s,
}

impl<S: Simd> Wide<S> {
    /// Wraps a vector.
    #[inline(always)]
    pub fn new(simd: S, v: S::f32s) -> Self {
        Self { simd, v }
    }

    /// The same number in every lane.
    #[inline(always)]
    pub fn splat(simd: S, value: f32) -> Self {
        Self { simd, v: simd.splat_f32s(value) }
    }

    /// The first lanes of a slice; lanes beyond its end are 0.
    #[inline(always)]
    pub fn load(simd: S, from: &[f32]) -> Self {
        match S::as_simd_f32s(from).0.first() {
            Some(&v) => Self { simd, v },
            None => Self { simd, v: simd.partial_load_f32s(from) },
        }
    }

    /// Writes as many lanes as the slice holds.
    #[inline(always)]
    pub fn store(self, to: &mut [f32]) {
        match S::as_mut_simd_f32s(to).0.first_mut() {
            Some(v) => *v = self.v,
            None => self.simd.partial_store_f32s(to, self.v),
        }
    }

    /// Sum over the lanes, in a fixed order.
    #[inline(always)]
    pub fn sum(self) -> f32 {
        self.simd.reduce_sum_f32s(self.v)
    }

    /// Whether any lane of the mask is set.
    #[inline(always)]
    pub fn any(self, mask: S::m32s) -> bool {
        self.simd.first_true_m32s(mask) < S::F32_LANES
    }

    /// `2^self` without the guards at the ends: `self` must be in -126..=127.
    #[inline(always)]
    pub fn exp2_in_range(self) -> Self {
        let Self { simd, v } = self;
        // Adding 1.5 * 2^23 leaves round(v) in the low bits of the sum.
        let magic = simd.splat_f32s(12_582_912.0);
        let shifted = simd.add_f32s(v, magic);
        let fraction = simd.sub_f32s(v, simd.sub_f32s(shifted, magic));
        let mut power = simd.splat_f32s(EXP2_COEFFICIENTS[0]);
        for &coefficient in &EXP2_COEFFICIENTS[1..] {
            power = simd.mul_add_e_f32s(power, fraction, simd.splat_f32s(coefficient));
        }
        let exponent = simd.wrapping_dyn_shl_u32s(simd.transmute_u32s_f32s(shifted), simd.splat_u32s(23));
        let bits = simd.add_u32s(simd.transmute_u32s_f32s(power), exponent);
        Self { simd, v: simd.transmute_f32s_u32s(bits) }
    }
}

macro_rules! operator {
    ($trait:ident, $method:ident, $simd_method:ident) => {
        impl<S: Simd> $trait for Wide<S> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Self { simd: self.simd, v: self.simd.$simd_method(self.v, other.v) }
            }
        }
    };
}

operator!(Add, add, add_f32s);
operator!(Sub, sub, sub_f32s);
operator!(Mul, mul, mul_f32s);
operator!(Div, div, div_f32s);

impl<S: Simd> Neg for Wide<S> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self { simd: self.simd, v: self.simd.neg_f32s(self.v) }
    }
}

impl<S: Simd> Lane for Wide<S> {
    type Mask = S::m32s;

    #[inline(always)]
    fn constant(self, value: f64) -> Self {
        Self::splat(self.simd, value as f32)
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, addend: Self) -> Self {
        // Without a fused instruction this is a product and a sum, never a call into a library.
        Self { simd: self.simd, v: self.simd.mul_add_e_f32s(self.v, factor.v, addend.v) }
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self { simd: self.simd, v: self.simd.sqrt_f32s(self.v) }
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self { simd: self.simd, v: self.simd.abs_f32s(self.v) }
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self { simd: self.simd, v: self.simd.min_f32s(self.v, other.v) }
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self { simd: self.simd, v: self.simd.max_f32s(self.v, other.v) }
    }
    #[inline(always)]
    fn exp2(self) -> Self {
        self.clamp(self.constant(-126.0), self.constant(127.0)).exp2_in_range()
    }
    #[inline(always)]
    fn lt(self, other: Self) -> S::m32s {
        self.simd.less_than_f32s(self.v, other.v)
    }
    #[inline(always)]
    fn and(self, a: S::m32s, b: S::m32s) -> S::m32s {
        self.simd.and_m32s(a, b)
    }
    #[inline(always)]
    fn replace(self, mask: S::m32s, if_true: Self) -> Self {
        Self { simd: self.simd, v: self.simd.select_f32s(mask, if_true.v, self.v) }
    }
}
