//! Eight numbers at a time, and the run-time choice of the instructions for them (AVX2, or whatever there is).
//!
//! Both do the same operations in the same order and nothing is fused, so that results are the same bits with and
//! without.
#![allow(unsafe_code)]

use std::ops::{Add, Mul, Sub};

use crate::klt::Track;
use crate::ransac::{triangle::Motion, votes::Votes};
use crate::window::{Chase, Window};

/// Numbers that are computed together.
pub(crate) const LANES: usize = 8;
/// They as they lie in memory.
pub(crate) type Lane = [f32; LANES];

/// Eight numbers of single precision.
pub(crate) trait Vector: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> {
    fn load(lane: &Lane) -> Self;
    fn lane(self) -> Lane;
    fn splat(x: f32) -> Self;
    /// The smaller of each two; `other` where one is NaN.
    fn min(self, other: Self) -> Self;
    /// The larger of each two; `other` where one is NaN.
    fn max(self, other: Self) -> Self;
    /// Rounded towards zero.
    fn truncated(self) -> Self;
    /// `a < b ? then : otherwise`, false for NaN.
    fn if_less(a: Self, b: Self, then: Self, otherwise: Self) -> Self;
    /// The pixels in these columns and rows, those to their right, those below, and those below to the right, of an image
    /// that is `width` wide; zeros if any is not in it.
    fn squares(pixels: &[f32], at: [Self; 2], width: usize) -> [Self; 4];
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

macro_rules! arithmetic {
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
arithmetic! {
    Add, add, +, _mm256_add_ps;
    Sub, sub, -, _mm256_sub_ps;
    Mul, mul, *, _mm256_mul_ps;
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
    fn truncated(self) -> Self {
        Self(self.0.map(f32::trunc))
    }
    #[inline(always)]
    fn if_less(a: Self, b: Self, then: Self, otherwise: Self) -> Self {
        Self::each(|l| if a.0[l] < b.0[l] { then.0[l] } else { otherwise.0[l] })
    }
    #[inline(always)]
    fn squares(pixels: &[f32], [x, y]: [Self; 2], width: usize) -> [Self; 4] {
        let index = |l: usize| (y.0[l] as i32).wrapping_mul(width as i32).wrapping_add(x.0[l] as i32);
        let at: [usize; LANES] = std::array::from_fn(|l| usize::try_from(index(l)).unwrap_or(usize::MAX));
        let last = at.iter().max().and_then(|i| i.checked_add(width)?.checked_add(1));
        if last.is_none_or(|last| last >= pixels.len()) {
            return [Self([0.0; LANES]); 4];
        }
        [0, 1, width, width + 1].map(|offset| Self::each(|l| pixels[at[l] + offset]))
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
    fn truncated(self) -> Self {
        // SAFETY: see `Avx2`.
        unsafe {
            Self(arch::_mm256_round_ps::<{ arch::_MM_FROUND_TO_ZERO | arch::_MM_FROUND_NO_EXC }>(self.0))
        }
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
    fn squares(pixels: &[f32], [x, y]: [Self; 2], width: usize) -> [Self; 4] {
        let room = pixels.len().saturating_sub(width.saturating_add(1)).min(i32::MAX as usize);
        // SAFETY: see `Avx2`. Pixels are read only after every index was found to be from 0 to below `room`, where there
        // still is a pixel below to the right; `at` holds the eight integers that are written.
        unsafe {
            let (x, y) = (arch::_mm256_cvttps_epi32(x.0), arch::_mm256_cvttps_epi32(y.0));
            let row = arch::_mm256_mullo_epi32(y, arch::_mm256_set1_epi32(width as i32));
            let index = arch::_mm256_add_epi32(row, x);
            let below = arch::_mm256_cmpgt_epi32(arch::_mm256_set1_epi32(room as i32), index);
            let valid = arch::_mm256_andnot_si256(arch::_mm256_srai_epi32::<31>(index), below);
            if arch::_mm256_movemask_epi8(valid) != -1 {
                return [Self(arch::_mm256_setzero_ps()); 4];
            }
            let mut at = [0i32; LANES];
            arch::_mm256_storeu_si256(at.as_mut_ptr().cast(), index);
            // Two pixels at a time and a transposition: gather instructions are slow where processors are patched.
            let upper = pixels.as_ptr();
            let lower = upper.add(width);
            let [a, b] = Self::pairs(|l| upper.add(at[l] as usize));
            let [c, d] = Self::pairs(|l| lower.add(at[l] as usize));
            [a, b, c, d]
        }
    }
}

#[cfg(target_arch = "x86_64")]
impl Avx2 {
    /// The floats at eight places, and those next to them.
    #[inline(always)]
    unsafe fn pairs(place: impl Fn(usize) -> *const f32) -> [Self; 2] {
        // SAFETY: the caller's pointers are good for two floats each, and see `Avx2`.
        unsafe {
            let two = |l: usize| {
                let low = arch::_mm_castpd_ps(arch::_mm_load_sd(place(l).cast()));
                arch::_mm_movelh_ps(low, arch::_mm_castpd_ps(arch::_mm_load_sd(place(l + 1).cast())))
            };
            let (a, b) = (arch::_mm256_set_m128(two(4), two(0)), arch::_mm256_set_m128(two(6), two(2)));
            [
                Self(arch::_mm256_shuffle_ps::<0b10_00_10_00>(a, b)),
                Self(arch::_mm256_shuffle_ps::<0b11_01_11_01>(a, b)),
            ]
        }
    }
}

macro_rules! dispatch {
    ($(#[$doc:meta])* $name:ident, ($($arg:ident: $ty:ty),*) -> $result:ty, $wide:expr, $portable:expr) => {
        $(#[$doc])*
        pub(crate) fn $name($($arg: $ty),*) -> $result {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2")]
                fn wide($($arg: $ty),*) -> $result {
                    $wide
                }
                if std::arch::is_x86_feature_detected!("avx2") {
                    // SAFETY: the feature that `wide` is compiled for was just detected on this processor.
                    return unsafe { wide($($arg),*) };
                }
            }
            $portable
        }
    };
}

dispatch!(
    /// [`Window::follow`].
    follow, (window: &mut Window, chase: &Chase<'_>) -> Option<Track>,
    window.follow::<Avx2>(chase), window.follow::<Portable>(chase)
);
dispatch!(
    /// [`Votes::score`].
    score, (votes: &Votes, motion: &Motion) -> f32, votes.score(motion), votes.score(motion)
);

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;
    use rgbd_io::Image;

    use super::*;
    use crate::gray::Pyramid;
    use crate::klt::KltOptions;

    #[test]
    fn every_instruction_set_follows_points_to_the_same_bits() {
        let mut rng = Pcg64Mcg::seed_from_u64(3);
        let wave = |shift: f32| {
            move |x: usize, y: usize| {
                let (x, y) = (x as f32 - shift, y as f32 - 0.5 * shift);
                120.0 + 40.0 * (0.3 * x).sin() + 40.0 * (0.2 * y + 0.1 * x).cos() + 20.0 * (0.9 * x * y).sin()
            }
        };
        let pyramids = [0.0, 1.7].map(|s| Pyramid::new(Image::from_fn(61, 47, wave(s)), 4));
        let options = KltOptions::default();
        let mut window = Window::new(&options);
        let mut found = 0;
        for _ in 0..300 {
            let point = [rng.random_range(-1.0..62.0), rng.random_range(-1.0..48.0)];
            let mut near = |x: f32, by: f32| x + rng.random_range(-by..by);
            let from_target = [near(1.0, 0.5), near(0.0, 0.4), near(0.0, 0.4), near(1.0, 0.5)];
            let guess = [near(point[0], 4.0), near(point[1], 4.0)];
            let chase = Chase {
                from: &pyramids[0],
                to: &pyramids[1],
                max_levels: usize::MAX,
                point,
                guess,
                from_target,
                options: &options,
            };
            let portable = window.follow::<Portable>(&chase);
            assert_eq!(follow(&mut window, &chase), portable);
            found += usize::from(portable.is_some());
        }
        assert!(found > 100, "{found}");
    }
}
