//! Eight numbers at a time, and the run-time choice of the instructions for them (AVX2, or whatever there is).
//!
//! Both do the same operations in the same order and nothing is fused, so that results are the same bits with and
//! without. The operations are named here instead of left to the compiler because it finds them in long sums only by
//! luck.
#![allow(unsafe_code)]

use std::ops::{Add, Div, Mul, Sub};

use crate::cloud::Cloud;
use crate::jacobian::{MatchSums, RowSums};
use crate::lanes::{self, LANES, Lane};
use crate::matches::Matches;
use crate::options::Gates;
use crate::rays;
use crate::stats::Tally;
use crate::transform::Rigid;
use crate::view::Pixel;

/// Eight numbers of single precision.
pub(crate) trait Vector:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self>
{
    fn load(lane: &Lane) -> Self;
    fn lane(self) -> Lane;
    fn splat(x: f32) -> Self;
    /// The smaller of each two; `other` where one is NaN.
    fn min(self, other: Self) -> Self;
    /// The larger of each two; `other` where one is NaN.
    fn max(self, other: Self) -> Self;
    fn abs(self) -> Self;
    fn sqrt(self) -> Self;
    /// `a < b ? then : otherwise`, false for NaN.
    fn if_less(a: Self, b: Self, then: Self, otherwise: Self) -> Self;
    /// `a <= b ? then : otherwise`, false for NaN.
    fn if_at_most(a: Self, b: Self, then: Self, otherwise: Self) -> Self;
    /// Points and normals of the pixels with these indices, integers below 2^23; zeros if any is out of range.
    fn gather(from: &[Pixel], at: Self) -> [[Self; 3]; 2];

    #[inline(always)]
    fn load3(lanes: &[Lane; 3]) -> [Self; 3] {
        [Self::load(&lanes[0]), Self::load(&lanes[1]), Self::load(&lanes[2])]
    }

    #[inline(always)]
    fn total(self) -> f64 {
        let lane = self.lane();
        let pairs: [f32; 4] = std::array::from_fn(|l| lane[l] + lane[l + 4]);
        f64::from((pairs[0] + pairs[2]) + (pairs[1] + pairs[3]))
    }
}

/// For every processor.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Portable(Lane);

impl Portable {
    #[inline(always)]
    fn each(f: impl Fn(usize) -> f32) -> Self {
        Self(std::array::from_fn(f))
    }
}

macro_rules! portable {
    ($($operation:ident, $name:ident, $symbol:tt, $intrinsic:ident;)*) => {$(
        impl $operation for Portable {
            type Output = Self;
            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                Self::each(|l| self.0[l] $symbol other.0[l])
            }
        }
        #[cfg(target_arch = "x86_64")]
        impl $operation for Avx2 {
            type Output = Self;
            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                // SAFETY: see `Avx2`.
                unsafe { Self(arch::$intrinsic(self.0, other.0)) }
            }
        }
    )*};
}
portable! {
    Add, add, +, _mm256_add_ps;
    Sub, sub, -, _mm256_sub_ps;
    Mul, mul, *, _mm256_mul_ps;
    Div, div, /, _mm256_div_ps;
}

impl Vector for Portable {
    #[inline(always)]
    fn load(lane: &Lane) -> Self {
        Self(*lane)
    }
    #[inline(always)]
    fn lane(self) -> Lane {
        self.0
    }
    #[inline(always)]
    fn splat(x: f32) -> Self {
        Self([x; LANES])
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self::if_less(self, other, self, other)
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self::if_less(other, self, self, other)
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(self.0.map(f32::abs))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(self.0.map(f32::sqrt))
    }
    #[inline(always)]
    fn if_less(a: Self, b: Self, then: Self, otherwise: Self) -> Self {
        Self::each(|l| if a.0[l] < b.0[l] { then.0[l] } else { otherwise.0[l] })
    }
    #[inline(always)]
    fn if_at_most(a: Self, b: Self, then: Self, otherwise: Self) -> Self {
        Self::each(|l| if a.0[l] <= b.0[l] { then.0[l] } else { otherwise.0[l] })
    }
    #[inline(always)]
    fn gather(from: &[Pixel], at: Self) -> [[Self; 3]; 2] {
        let mut gathered = [[Self([0.0; LANES]); 3]; 2];
        let at: [usize; LANES] = std::array::from_fn(|l| at.0[l] as usize);
        if at.iter().all(|&i| i < from.len()) {
            for k in 0..3 {
                gathered[0][k] = Self::each(|l| from[at[l]].point[k]);
                gathered[1][k] = Self::each(|l| from[at[l]].normal[k]);
            }
        }
        gathered
    }
}

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64 as arch;

/// For processors with AVX2. Lives only in code that [`dispatch`] has compiled and chosen for them: that is what makes
/// its operations sound.
#[cfg(target_arch = "x86_64")]
#[derive(Debug, Clone, Copy)]
pub(crate) struct Avx2(arch::__m256);

#[cfg(target_arch = "x86_64")]
impl Vector for Avx2 {
    #[inline(always)]
    fn load(lane: &Lane) -> Self {
        // SAFETY: see `Avx2`; a lane holds the eight floats that are read.
        unsafe { Self(arch::_mm256_loadu_ps(lane.as_ptr())) }
    }
    #[inline(always)]
    fn lane(self) -> Lane {
        let mut lane = [0.0; LANES];
        // SAFETY: see `Avx2`; a lane holds the eight floats that are written.
        unsafe { arch::_mm256_storeu_ps(lane.as_mut_ptr(), self.0) };
        lane
    }
    #[inline(always)]
    fn splat(x: f32) -> Self {
        // SAFETY: see `Avx2`.
        unsafe { Self(arch::_mm256_set1_ps(x)) }
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        // SAFETY: see `Avx2`.
        unsafe { Self(arch::_mm256_min_ps(self.0, other.0)) }
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        // SAFETY: see `Avx2`.
        unsafe { Self(arch::_mm256_max_ps(self.0, other.0)) }
    }
    #[inline(always)]
    fn abs(self) -> Self {
        // SAFETY: see `Avx2`.
        unsafe { Self(arch::_mm256_andnot_ps(arch::_mm256_set1_ps(-0.0), self.0)) }
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        // SAFETY: see `Avx2`.
        unsafe { Self(arch::_mm256_sqrt_ps(self.0)) }
    }
    #[inline(always)]
    fn if_less(a: Self, b: Self, then: Self, otherwise: Self) -> Self {
        // SAFETY: see `Avx2`.
        unsafe {
            let mask = arch::_mm256_cmp_ps::<{ arch::_CMP_LT_OQ }>(a.0, b.0);
            Self(arch::_mm256_blendv_ps(otherwise.0, then.0, mask))
        }
    }
    #[inline(always)]
    fn if_at_most(a: Self, b: Self, then: Self, otherwise: Self) -> Self {
        // SAFETY: see `Avx2`.
        unsafe {
            let mask = arch::_mm256_cmp_ps::<{ arch::_CMP_LE_OQ }>(a.0, b.0);
            Self(arch::_mm256_blendv_ps(otherwise.0, then.0, mask))
        }
    }
    #[inline(always)]
    fn gather(from: &[Pixel], at: Self) -> [[Self; 3]; 2] {
        // SAFETY: see `Avx2`. Pixels are read only after every index was found to be from 0 to below `end`.
        unsafe {
            let end = arch::_mm256_set1_epi32(from.len().min(i32::MAX as usize) as i32);
            let index = arch::_mm256_cvttps_epi32(at.0);
            let below = arch::_mm256_cmpgt_epi32(end, index);
            let valid = arch::_mm256_andnot_si256(arch::_mm256_srai_epi32::<31>(index), below);
            if arch::_mm256_movemask_epi8(valid) != -1 {
                return [[Self(arch::_mm256_setzero_ps()); 3]; 2];
            }
            let mut at = [0i32; LANES];
            arch::_mm256_storeu_si256(at.as_mut_ptr().cast(), index);
            // Eight loads and a transposition: gather instructions are slow where processors are patched.
            let first = from.as_ptr();
            let pixel = |l: usize| first.add(at[l] as usize).cast::<f32>();
            [Self::columns(pixel), Self::columns(|l| pixel(l).add(4))]
        }
    }
}

#[cfg(target_arch = "x86_64")]
impl Avx2 {
    /// The first three columns of the 8 x 4 matrix whose rows are read from the pointers.
    #[inline(always)]
    unsafe fn columns(row: impl Fn(usize) -> *const f32) -> [Self; 3] {
        // SAFETY: the caller's pointers are good for four floats each, and see `Avx2`.
        unsafe {
            let two = |l: usize| arch::_mm256_loadu2_m128(row(l + 4), row(l));
            let (a, b, c, d) = (two(0), two(1), two(2), two(3));
            let (xy, xy_next) = (arch::_mm256_unpacklo_ps(a, b), arch::_mm256_unpacklo_ps(c, d));
            let (z, z_next) = (arch::_mm256_unpackhi_ps(a, b), arch::_mm256_unpackhi_ps(c, d));
            [
                Self(arch::_mm256_shuffle_ps::<0b01_00_01_00>(xy, xy_next)),
                Self(arch::_mm256_shuffle_ps::<0b11_10_11_10>(xy, xy_next)),
                Self(arch::_mm256_shuffle_ps::<0b01_00_01_00>(z, z_next)),
            ]
        }
    }
}

macro_rules! dispatch {
    ($(#[$doc:meta])* $name:ident => $($kernel:ident)::+, ($($arg:ident: $ty:ty),*) -> $result:ty) => {
        $(#[$doc])*
        pub(crate) fn $name($($arg: $ty),*) -> $result {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2")]
                fn wide($($arg: $ty),*) -> $result {
                    $($kernel)::+::<Avx2>($($arg),*)
                }
                if std::arch::is_x86_feature_detected!("avx2") {
                    // SAFETY: the feature that `wide` is compiled for was just detected on this processor.
                    return unsafe { wide($($arg),*) };
                }
            }
            $($kernel)::+::<Portable>($($arg),*)
        }
    };
}

dispatch!(
    /// [`lanes::cost`].
    dense_cost => lanes::cost, (blocks: &[lanes::Block], pose: &Rigid<f32>, delta: f32) -> f64
);
dispatch!(
    /// [`lanes::linearise`].
    dense_sums => lanes::linearise, (blocks: &[lanes::Block], pose: &Rigid<f32>, delta: f32) -> (RowSums, f64)
);
dispatch!(
    /// [`lanes::tally`].
    dense_tally => lanes::tally, (blocks: &[lanes::Block], pose: &Rigid<f32>, delta: f32) -> Tally
);
dispatch!(
    /// [`rays::cost`].
    feature_cost => rays::cost, (blocks: &[rays::Block], pair: &rays::Pair) -> f64
);
dispatch!(
    /// [`rays::sums`].
    feature_sums => rays::sums, (blocks: &[rays::Block], pair: &rays::Pair) -> (MatchSums, f64)
);
dispatch!(
    /// [`rays::tally`].
    feature_tally => rays::tally, (blocks: &[rays::Block], pair: &rays::Pair) -> Tally
);
dispatch!(
    /// [`Matches::search`].
    search => Matches::search,
    (matches: &mut Matches, transform: &Rigid<f32>, clouds: (&Cloud<'_>, &Cloud<'_>), gates: &Gates) -> ()
);
