//! The scalar of the training step: `f32` for training, `f64` for checking its gradients.

use crate::lanes::{Lanes, Plain};
use std::fmt::Debug;
use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub};

/// An instruction set for which generic code is compiled; see [`crate::simd`].
pub(crate) trait Isa: 'static {
    /// Its vectors.
    type F32: Lanes<f32>;
    /// Vectors of sums in a matrix product's register block, and the most of them in one row: as many as there are registers
    /// for.
    const BLOCK: (usize, usize);

    /// Runs a kernel compiled for the set, as a function of its own. Only for a set that the processor has.
    fn call<K: Kernel>(kernel: K);
}

/// A piece of work for any instruction set. What it calls is inlined, or called in the same way.
pub(crate) trait Kernel {
    fn run<I: Isa>(self);
}

/// What the compiler may use without asking the processor.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Baseline;

impl Isa for Baseline {
    type F32 = Plain<f32, 8>;
    const BLOCK: (usize, usize) = if cfg!(target_arch = "aarch64") { (12, 2) } else { (4, 1) };

    #[inline(never)]
    fn call<K: Kernel>(kernel: K) {
        kernel.run::<Self>();
    }
}

/// A floating point number.
pub(crate) trait Real:
    Copy
    + Default
    + PartialOrd
    + Debug
    + Send
    + Sync
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + 'static
{
    /// Vectors of it under an instruction set.
    type V<I: Isa>: Lanes<Self>;
    /// Vectors of four.
    type Quad: Lanes<Self>;
    const ZERO: Self;
    const ONE: Self;
    fn of(v: f64) -> Self;
    fn of_int(v: i32) -> Self;
    fn sqrt(self) -> Self;
    /// `e^x`; in `f32` a polynomial that vectorises, with a relative error below 2e-7 for |x| < 87 and clamped beyond.
    fn exp(self) -> Self;
    /// Truncation towards zero; values out of range are clamped, NaN gives 0.
    fn trunc_int(self) -> i32;
    /// `self * b + c`, fused where that is one instruction of the baseline: elsewhere `mul_add` is a library call.
    fn madd(self, b: Self, c: Self) -> Self;
    /// The larger of the number and zero; zero for NaN.
    fn positive(self) -> Self;
    /// `v` where `self` is positive, else zero. Bits, not a branch: a branch becomes a masked store, which is slow.
    fn gate(self, v: Self) -> Self;
}

#[cfg(target_arch = "x86_64")]
type QuadF32 = crate::simd::x86::F32x4;
#[cfg(not(target_arch = "x86_64"))]
type QuadF32 = Plain<f32, 4>;

macro_rules! impl_real {
    ($t:ty, $bits:ty, $exp:expr, $vector:ty, $quad:ty) => {
        impl Real for $t {
            type V<I: Isa> = $vector;
            type Quad = $quad;
            const ZERO: Self = 0.0;
            const ONE: Self = 1.0;
            #[inline(always)]
            fn of(v: f64) -> Self {
                v as $t
            }
            #[inline(always)]
            fn of_int(v: i32) -> Self {
                v as $t
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                <$t>::sqrt(self)
            }
            #[inline(always)]
            fn exp(self) -> Self {
                ($exp)(self)
            }
            #[inline(always)]
            fn trunc_int(self) -> i32 {
                self as i32
            }
            #[inline(always)]
            fn madd(self, b: Self, c: Self) -> Self {
                if cfg!(any(target_feature = "fma", target_arch = "aarch64")) {
                    self.mul_add(b, c)
                } else {
                    self * b + c
                }
            }
            #[inline(always)]
            fn positive(self) -> Self {
                <$t>::max(self, 0.0)
            }
            #[inline(always)]
            fn gate(self, v: Self) -> Self {
                <$t>::from_bits(v.to_bits() & (0 as $bits).wrapping_sub((self > 0.0) as $bits))
            }
        }
    };
}
impl_real!(f32, u32, exp_f32, I::F32, QuadF32);
impl_real!(f64, u64, f64::exp, Plain<f64, 8>, Plain<f64, 4>);

/// `2^n e^r` with `n` the integer next to `x / ln 2`, and for `e^r` the polynomial of the Cephes library (Moshier).
#[inline(always)]
fn exp_f32(x: f32) -> f32 {
    /// Adding it leaves the nearest integer in the low bits.
    const ROUND: f32 = 12_582_912.0;
    // ln 2 in two parts, the first with few bits, so that its multiples are exact.
    const LN_2: (f32, f32) = (0.693_359_4, -2.121_944_4e-4);
    const TERMS: [f32; 6] = [1.987_569_2e-4, 1.398_2e-3, 8.333_452e-3, 4.166_579_6e-2, 1.666_666_5e-1, 0.5];
    let x = x.clamp(-87.0, 88.0);
    let shifted = x.madd(std::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    let r = n.madd(-LN_2.1, n.madd(-LN_2.0, x));
    let mut p = TERMS[0];
    for t in &TERMS[1..] {
        p = p.madd(r, *t);
    }
    let e = (p * r).madd(r, r) + 1.0;
    e * f32::from_bits(shifted.to_bits().wrapping_add(127) << 23)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exponential_is_exact_to_single_precision() {
        let mut worst: f64 = 0.0;
        for i in -86_900..86_900 {
            let x = i as f32 * 1e-3;
            let exact = f64::from(x).exp();
            worst = worst.max((f64::from(Real::exp(x)) - exact).abs() / exact);
        }
        assert!(worst < 2e-7, "{worst:.1e}");
        assert!(Real::exp(f32::NAN).is_nan());
        assert!(Real::exp(-1e30f32) < 1e-37 && Real::exp(1e30f32) > 1e37);
    }
}
