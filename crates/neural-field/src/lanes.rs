//! Vectors of numbers, each with its arithmetic: what the inner loops are written in, whatever the instruction set.
//!
//! No closures here and in code built on this: only functions that are always inlined end up in the instruction set of
//! their caller.

use crate::real::Real;

/// Some numbers side by side, as many as a register holds; four of them are a quad.
///
/// Loads and stores panic outside of their slice.
pub(crate) trait Lanes<R>: Copy {
    /// How many, a multiple of four.
    const N: usize;
    /// Eight of the same numbers.
    type Eight: Lanes<R>;

    fn splat(x: R) -> Self;
    /// The same two numbers over and over.
    fn splat_pair(x: &[R; 2]) -> Self;
    fn load(x: &[R], from: usize) -> Self;
    fn store(self, x: &mut [R], from: usize);
    /// Quads that are filled each with one of the numbers from `from`.
    fn spread(x: &[R], from: usize) -> Self;
    /// Quads of the same four numbers, those from `from`.
    fn repeat(x: &[R], from: usize) -> Self;
    /// Quads from several places in `x`: the `k`-th from `from[4 * k + place] + offset`.
    fn load_quads(x: &[R], from: &[u32], place: usize, offset: usize) -> Self;
    /// Quads to several places in `x`: the `k`-th to `(4 * k + place) * stride`.
    fn store_quads(self, x: &mut [R], place: usize, stride: usize);
    /// The numbers as integers; they are from 0 to below 2^31.
    fn store_ints(self, x: &mut [u32], from: usize);
    fn add(self, b: Self) -> Self;
    fn sub(self, b: Self) -> Self;
    fn mul(self, b: Self) -> Self;
    fn div(self, b: Self) -> Self;
    fn sqrt(self) -> Self;
    /// `self * b + c`, rounded once where that is one instruction.
    fn madd(self, b: Self, c: Self) -> Self;
    /// The larger of the number and zero; zero for NaN.
    fn positive(self) -> Self;
    /// The smaller of both; `b` if one is NaN.
    fn min(self, b: Self) -> Self;
    /// Without the fraction; the numbers are below 2^31.
    fn trunc(self) -> Self;
    /// A bit for each number that is smaller than `b`'s.
    fn less(self, b: Self) -> u32;
    /// `v` where `self` is positive, else zero.
    fn gate(self, v: Self) -> Self;
    /// Every quad filled with its number `place`.
    fn splat_in_quads(self, place: usize) -> Self;
    /// Quads of the first halves of the quads of `self` and of `b`.
    fn low_pairs(self, b: Self) -> Self;
    /// Quads of their second halves.
    fn high_pairs(self, b: Self) -> Self;
    /// Transposes the matrices that four vectors' quads at the same place form.
    fn transpose_quads(rows: [Self; 4]) -> [Self; 4];
    /// Sums in eight parts.
    fn eight(self) -> Self::Eight;
    /// The sum of all.
    fn total(self) -> R;
}

/// `N` numbers in plain code, which the compiler may or may not turn into vectors.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Plain<R, const N: usize>([R; N]);

/// A function of [`Lanes`] on [`Plain`], number by number.
macro_rules! each {
    ($name:ident($($arg:ident),*), $l:ident, $out:ident => $value:expr) => {
        #[inline(always)]
        fn $name(self, $($arg: Self),*) -> Self {
            let mut $out = self;
            for $l in 0..N {
                $out.0[$l] = $value;
            }
            $out
        }
    };
}

impl<R: Real, const N: usize> Lanes<R> for Plain<R, N> {
    const N: usize = N;
    type Eight = Plain<R, 8>;

    #[inline(always)]
    fn splat(x: R) -> Self {
        Self([x; N])
    }

    #[inline(always)]
    fn splat_pair(x: &[R; 2]) -> Self {
        let mut v = [R::ZERO; N];
        for l in 0..N {
            v[l] = x[l % 2];
        }
        Self(v)
    }

    #[inline(always)]
    fn load(x: &[R], from: usize) -> Self {
        let mut v = [R::ZERO; N];
        v.copy_from_slice(&x[from..from + N]);
        Self(v)
    }

    #[inline(always)]
    fn store(self, x: &mut [R], from: usize) {
        x[from..from + N].copy_from_slice(&self.0);
    }

    #[inline(always)]
    fn spread(x: &[R], from: usize) -> Self {
        let (x, mut v) = (&x[from..from + N / 4], [R::ZERO; N]);
        for l in 0..N {
            v[l] = x[l / 4];
        }
        Self(v)
    }

    #[inline(always)]
    fn repeat(x: &[R], from: usize) -> Self {
        let (x, mut v) = (&x[from..from + 4], [R::ZERO; N]);
        for l in 0..N {
            v[l] = x[l % 4];
        }
        Self(v)
    }

    #[inline(always)]
    fn load_quads(x: &[R], from: &[u32], place: usize, offset: usize) -> Self {
        let mut v = [R::ZERO; N];
        for k in 0..N / 4 {
            v[4 * k..4 * k + 4].copy_from_slice(&x[from[4 * k + place] as usize + offset..][..4]);
        }
        Self(v)
    }

    #[inline(always)]
    fn store_quads(self, x: &mut [R], place: usize, stride: usize) {
        for k in 0..N / 4 {
            x[(4 * k + place) * stride..][..4].copy_from_slice(&self.0[4 * k..4 * k + 4]);
        }
    }

    #[inline(always)]
    fn store_ints(self, x: &mut [u32], from: usize) {
        for (x, v) in x[from..from + N].iter_mut().zip(&self.0) {
            *x = v.trunc_int() as u32;
        }
    }

    each!(add(b), l, a => a.0[l] + b.0[l]);
    each!(sub(b), l, a => a.0[l] - b.0[l]);
    each!(mul(b), l, a => a.0[l] * b.0[l]);
    each!(div(b), l, a => a.0[l] / b.0[l]);
    each!(sqrt(), l, a => a.0[l].sqrt());
    each!(madd(b, c), l, a => a.0[l].madd(b.0[l], c.0[l]));
    each!(positive(), l, a => a.0[l].positive());
    each!(min(b), l, a => if a.0[l] < b.0[l] { a.0[l] } else { b.0[l] });
    each!(trunc(), l, a => R::of_int(a.0[l].trunc_int()));
    each!(gate(v), l, a => if a.0[l] > R::ZERO { v.0[l] } else { R::ZERO });
    each!(low_pairs(b), l, a => if l % 4 < 2 { a.0[l] } else { b.0[l - 2] });

    #[inline(always)]
    fn less(self, b: Self) -> u32 {
        let mut bits = 0;
        for l in 0..N {
            bits |= u32::from(self.0[l] < b.0[l]) << l;
        }
        bits
    }

    #[inline(always)]
    fn high_pairs(self, b: Self) -> Self {
        let mut out = b;
        for l in 0..N {
            if l % 4 < 2 {
                out.0[l] = self.0[l + 2];
            }
        }
        out
    }

    #[inline(always)]
    fn splat_in_quads(self, place: usize) -> Self {
        let mut out = self;
        for l in 0..N {
            out.0[l] = self.0[l / 4 * 4 + place];
        }
        out
    }

    #[inline(always)]
    fn transpose_quads(rows: [Self; 4]) -> [Self; 4] {
        let mut out = rows;
        for l in 0..N {
            for r in 0..4 {
                out[r].0[l] = rows[l % 4].0[l / 4 * 4 + r];
            }
        }
        out
    }

    #[inline(always)]
    fn eight(self) -> Plain<R, 8> {
        let mut out = Plain([R::ZERO; 8]);
        for l in 0..N {
            out.0[l % 8] += self.0[l];
        }
        out
    }

    #[inline(always)]
    fn total(self) -> R {
        let x = self.eight().0;
        ((x[0] + x[4]) + (x[2] + x[6])) + ((x[1] + x[5]) + (x[3] + x[7]))
    }
}
