//! The scalar of the training step: `f32` for training, `f64` for checking its gradients.

use std::fmt::Debug;
use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub};

/// A floating point number. `FMA` says whether the code runs where fused multiply-add is one instruction:
/// elsewhere `mul_add` would be a library call per element.
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
    const ZERO: Self;
    const ONE: Self;
    fn of(v: f64) -> Self;
    fn sqrt(self) -> Self;
    fn exp(self) -> Self;
    /// Truncation towards zero; values out of range are clamped, NaN gives 0.
    fn trunc_int(self) -> i32;
    fn madd<const FMA: bool>(self, b: Self, c: Self) -> Self;
    /// The larger of the number and zero; zero for NaN.
    fn positive(self) -> Self;
    /// `v` where `self` is positive, else zero. Bits, not a branch: a branch becomes a masked store, which is slow.
    fn gate(self, v: Self) -> Self;
}

macro_rules! impl_real {
    ($t:ty, $bits:ty) => {
        impl Real for $t {
            const ZERO: Self = 0.0;
            const ONE: Self = 1.0;
            #[inline(always)]
            fn of(v: f64) -> Self {
                v as $t
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                <$t>::sqrt(self)
            }
            #[inline(always)]
            fn exp(self) -> Self {
                <$t>::exp(self)
            }
            #[inline(always)]
            fn trunc_int(self) -> i32 {
                self as i32
            }
            #[inline(always)]
            fn positive(self) -> Self {
                <$t>::max(self, 0.0)
            }
            #[inline(always)]
            fn gate(self, v: Self) -> Self {
                <$t>::from_bits(v.to_bits() & (0 as $bits).wrapping_sub((self > 0.0) as $bits))
            }
            #[inline(always)]
            fn madd<const FMA: bool>(self, b: Self, c: Self) -> Self {
                if FMA { self.mul_add(b, c) } else { self * b + c }
            }
        }
    };
}
impl_real!(f32, u32);
impl_real!(f64, u64);
