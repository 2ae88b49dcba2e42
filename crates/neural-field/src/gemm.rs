//! Small matrix products on row-major slices: the one inner loop behind every layer, forward and backward.
//!
//! Sums stay in registers, a block of rows and columns at a time. What they start from and where they go is a
//! [`Target`]: bias, ReLU and mask cost no pass of their own over memory.

use crate::lanes::Lanes;
use crate::real::{Isa, Kernel, Real};
use crate::tile::VECTOR;

/// What a product's sums start from, and what becomes of them. `at` is the row and column of the first number.
pub(crate) trait Target<R> {
    /// What `N` vectors of sums in a row start from.
    fn start<V: Lanes<R>, const N: usize>(&self, at: (usize, usize)) -> [V; N];
    /// Takes the sums of rows below each other.
    fn finish<V: Lanes<R>, const N: usize>(&mut self, at: (usize, usize), sums: &[[V; N]]);
}

/// The left factor of a product: numbers from memory, each of them spread over a vector.
pub(crate) trait Left<R: Real>: Copy {
    /// Adds the product of rows from `i` and columns from `j` of the right factor, of inner length `k`.
    fn accumulate<V: Lanes<R>, const M: usize, const N: usize>(
        self,
        at: (usize, usize),
        k: usize,
        b: (&[R], usize),
        sums: &mut [[V; N]; M],
    );
}

/// A matrix that is in memory column by column, `column * stride + row`.
#[derive(Clone, Copy)]
pub(crate) struct Columns<'a, R>(pub(crate) &'a [R], pub(crate) usize);

impl<R: Real> Left<R> for Columns<'_, R> {
    #[inline(always)]
    fn accumulate<V: Lanes<R>, const M: usize, const N: usize>(
        self,
        (i, j): (usize, usize),
        k: usize,
        (b, ldb): (&[R], usize),
        sums: &mut [[V; N]; M],
    ) {
        let Self(a, stride) = self;
        // Known before the loop, so that it needs no checks.
        assert!(i + M <= stride && j + N * V::N <= ldb);
        for (column, row) in a.chunks_exact(stride).zip(b.chunks_exact(ldb)).take(k) {
            let column = &column[i..i + M];
            let row: [V; N] = load_row(row, j);
            for r in 0..M {
                add_product(column[r], &row, &mut sums[r]);
            }
        }
    }
}

/// A matrix that is in memory row by row, `row * STRIDE + column`: a stride that is known here keeps the addresses of all
/// rows of a block in one register.
#[derive(Clone, Copy)]
pub(crate) struct Rows<'a, R, const STRIDE: usize>(pub(crate) &'a [R]);

impl<R: Real, const STRIDE: usize> Left<R> for Rows<'_, R, STRIDE> {
    #[inline(always)]
    fn accumulate<V: Lanes<R>, const M: usize, const N: usize>(
        self,
        at: (usize, usize),
        k: usize,
        b: (&[R], usize),
        sums: &mut [[V; N]; M],
    ) {
        AnyRows(self.0, STRIDE).accumulate(at, k, b, sums);
    }
}

/// The same with a stride that is not known here.
#[derive(Clone, Copy)]
struct AnyRows<'a, R>(&'a [R], usize);

impl<R: Real> Left<R> for AnyRows<'_, R> {
    #[inline(always)]
    fn accumulate<V: Lanes<R>, const M: usize, const N: usize>(
        self,
        (i, j): (usize, usize),
        k: usize,
        (b, ldb): (&[R], usize),
        sums: &mut [[V; N]; M],
    ) {
        let Self(a, stride) = self;
        let mut rows = [a; M];
        for (r, row) in rows.iter_mut().enumerate() {
            *row = &a[(i + r) * stride..][..k];
        }
        assert!(j + N * V::N <= ldb);
        for (l, row) in b.chunks_exact(ldb).take(k).enumerate() {
            let row: [V; N] = load_row(row, j);
            for r in 0..M {
                add_product(rows[r][l], &row, &mut sums[r]);
            }
        }
    }
}

/// `sums += a * row`.
#[inline(always)]
fn add_product<R: Real, V: Lanes<R>, const N: usize>(a: R, row: &[V; N], sums: &mut [V; N]) {
    let a = V::splat(a);
    for v in 0..N {
        sums[v] = a.madd(row[v], sums[v]);
    }
}

/// `A * B` with `m` rows, `n` columns (a multiple of 8) and inner length `k`, into `target`; B row by row with a stride.
#[inline(always)]
pub(crate) fn product<R: Real, I: Isa>(
    shape: (usize, usize, usize),
    a: impl Left<R>,
    b: (&[R], usize),
    target: &mut impl Target<R>,
) {
    debug_assert!(shape.1.is_multiple_of(8));
    I::call(Product { shape, a, b, target });
}

/// [`product`] with A row by row.
#[inline(always)]
pub(crate) fn product_of_rows<R: Real, I: Isa>(
    shape: (usize, usize, usize),
    (a, stride): (&[R], usize),
    b: (&[R], usize),
    target: &mut impl Target<R>,
) {
    match stride {
        // The usual width of a hidden layer.
        64 => product::<R, I>(shape, Rows::<R, 64>(a), b, target),
        _ => product::<R, I>(shape, AnyRows(a, stride), b, target),
    }
}

struct Product<'a, R, A, D> {
    shape: (usize, usize, usize),
    a: A,
    b: (&'a [R], usize),
    target: &'a mut D,
}

impl<R: Real, A: Left<R>, D: Target<R>> Kernel for Product<'_, R, A, D> {
    #[inline(always)]
    fn run<I: Isa>(self) {
        let Self { shape: (m, n, k), a, b, target } = self;
        let mut i = 0;
        while i < m {
            let at = (i, n, k);
            i += match m - i {
                rest if I::BLOCK.0 == 8 && rest >= 8 => strip::<R, I, 8>(at, a, b, target),
                rest if I::BLOCK.0 == 6 && rest >= 6 => strip::<R, I, 6>(at, a, b, target),
                rest if I::BLOCK.0 != 8 && rest >= 4 => strip::<R, I, 4>(at, a, b, target),
                rest if rest >= 2 => strip::<R, I, 2>(at, a, b, target),
                _ => strip::<R, I, 1>(at, a, b, target),
            };
        }
    }
}

/// `M` rows of the product, from row `i`; returns their number.
#[inline(always)]
fn strip<R: Real, I: Isa, const M: usize>(
    (i, n, k): (usize, usize, usize),
    a: impl Left<R>,
    b: (&[R], usize),
    target: &mut impl Target<R>,
) -> usize {
    type Eight<R, I> = <<R as Real>::V<I> as Lanes<R>>::Eight;
    let width = <R::V<I>>::N;
    let mut j = 0;
    while j < n {
        let rest = n - j;
        j += if I::BLOCK.1 == 2 && rest >= 2 * width {
            block::<R, R::V<I>, M, 2>((i, j), k, a, b, target)
        } else if width == 8 || rest >= width {
            block::<R, R::V<I>, M, 1>((i, j), k, a, b, target)
        } else {
            block::<R, Eight<R, I>, M, 1>((i, j), k, a, b, target)
        };
    }
    M
}

/// One block of sums, `M` rows of `N` vectors; returns the number of its columns.
#[inline(always)]
fn block<R: Real, V: Lanes<R>, const M: usize, const N: usize>(
    (i, j): (usize, usize),
    k: usize,
    a: impl Left<R>,
    b: (&[R], usize),
    target: &mut impl Target<R>,
) -> usize {
    let mut sums = [[V::splat(R::ZERO); N]; M];
    for (r, sums) in sums.iter_mut().enumerate() {
        *sums = target.start((i + r, j));
    }
    a.accumulate((i, j), k, b, &mut sums);
    target.finish((i, j), &sums);
    N * V::N
}

/// `N` vectors from `from`.
#[inline(always)]
pub(crate) fn load_row<R: Real, V: Lanes<R>, const N: usize>(x: &[R], from: usize) -> [V; N] {
    let x = &x[from..][..N * V::N];
    let mut row = [V::splat(R::ZERO); N];
    for (v, to) in row.iter_mut().enumerate() {
        *to = V::load(x, v * V::N);
    }
    row
}

/// Writes `N` vectors from `from`.
#[inline(always)]
pub(crate) fn store_row<R: Real, V: Lanes<R>, const N: usize>(row: &[V; N], x: &mut [R], from: usize) {
    let x = &mut x[from..][..N * V::N];
    for (v, row) in row.iter().enumerate() {
        row.store(x, v * V::N);
    }
}

/// `C = A * B` with row stride `ld`.
pub(crate) struct Store<'a, R> {
    pub(crate) c: &'a mut [R],
    pub(crate) ld: usize,
}

impl<R: Real> Target<R> for Store<'_, R> {
    #[inline(always)]
    fn start<V: Lanes<R>, const N: usize>(&self, _: (usize, usize)) -> [V; N] {
        [V::splat(R::ZERO); N]
    }

    #[inline(always)]
    fn finish<V: Lanes<R>, const N: usize>(&mut self, (i, j): (usize, usize), sums: &[[V; N]]) {
        for (r, sums) in sums.iter().enumerate() {
            store_row(sums, self.c, (i + r) * self.ld + j);
        }
    }
}

/// `C += A * B` with row stride `ld`.
pub(crate) struct Add<'a, R> {
    pub(crate) c: &'a mut [R],
    pub(crate) ld: usize,
}

impl<R: Real> Target<R> for Add<'_, R> {
    #[inline(always)]
    fn start<V: Lanes<R>, const N: usize>(&self, (i, j): (usize, usize)) -> [V; N] {
        load_row(self.c, i * self.ld + j)
    }

    #[inline(always)]
    fn finish<V: Lanes<R>, const N: usize>(&mut self, (i, j): (usize, usize), sums: &[[V; N]]) {
        for (r, sums) in sums.iter().enumerate() {
            store_row(sums, self.c, (i + r) * self.ld + j);
        }
    }
}

/// Sum of the products of two equally long slices.
#[inline(always)]
pub(crate) fn dot<R: Real, I: Isa>(x: &[R], y: &[R]) -> R {
    let mut sums = <R::V<I>>::splat(R::ZERO);
    let whole = x.len() / <R::V<I>>::N * <R::V<I>>::N;
    for l in (0..whole).step_by(<R::V<I>>::N) {
        sums = <R::V<I>>::load(x, l).madd(<R::V<I>>::load(y, l), sums);
    }
    x[whole..].iter().zip(&y[whole..]).fold(sums.total(), |sum, (x, y)| sum + *x * *y)
}

/// `N` numbers of a slice from `from`.
#[inline(always)]
pub(crate) fn load<R: Real, const N: usize>(x: &[R], from: usize) -> [R; N] {
    let mut v = [R::ZERO; N];
    v.copy_from_slice(&x[from..from + N]);
    v
}

/// Sum of a slice in eight interleaved partial sums.
#[inline(always)]
pub(crate) fn sum<R: Real>(x: &[R]) -> R {
    let mut acc = [R::ZERO; 8];
    let chunks = x.chunks_exact(8);
    let rest = chunks.remainder();
    for a in chunks {
        for l in 0..8 {
            acc[l] += a[l];
        }
    }
    let total = ((acc[0] + acc[4]) + (acc[2] + acc[6])) + ((acc[1] + acc[5]) + (acc[3] + acc[7]));
    rest.iter().fold(total, |sum, a| sum + *a)
}

/// `out[j][i] = x[i][j]` for `rows` x `columns` with row strides `ldx` and `ldo`.
pub(crate) fn transpose<R: Real>(
    (x, ldx): (&[R], usize),
    (rows, columns): (usize, usize),
    (out, ldo): (&mut [R], usize),
) {
    for (i, row) in x.chunks(ldx).take(rows).enumerate() {
        for (v, out) in row[..columns].iter().zip(out[i..].chunks_mut(ldo)) {
            out[0] = *v;
        }
    }
}

/// From feature-major to lane-major, for whole vectors of lanes and quads of features, with row strides.
#[inline(always)]
pub(crate) fn to_rows<R: Real, I: Isa>(
    (x, ldx): (&[R], usize),
    (features, lanes): (usize, usize),
    (out, ldo): (&mut [R], usize),
) {
    for lane in (0..lanes).step_by(<R::V<I>>::N) {
        for f in (0..features).step_by(4) {
            let mut quads = [<R::V<I>>::splat(R::ZERO); 4];
            for (r, quad) in quads.iter_mut().enumerate() {
                *quad = <R::V<I>>::load(x, (f + r) * ldx + lane);
            }
            for (place, quad) in Lanes::transpose_quads(quads).into_iter().enumerate() {
                quad.store_quads(&mut out[lane * ldo + f..], place, ldo);
            }
        }
    }
}

/// From lane-major to feature-major, as [`to_rows`].
#[inline(always)]
pub(crate) fn to_columns<R: Real, I: Isa>(
    (x, ldx): (&[R], usize),
    (features, lanes): (usize, usize),
    (out, ldo): (&mut [R], usize),
) {
    let mut from = [0; VECTOR];
    for (l, from) in from.iter_mut().enumerate() {
        *from = (l * ldx) as u32;
    }
    for lane in (0..lanes).step_by(<R::V<I>>::N) {
        for f in (0..features).step_by(4) {
            let mut quads = [<R::V<I>>::splat(R::ZERO); 4];
            for (place, quad) in quads.iter_mut().enumerate() {
                *quad = <R::V<I>>::load_quads(x, &from, place, lane * ldx + f);
            }
            for (r, quad) in Lanes::transpose_quads(quads).into_iter().enumerate() {
                quad.store(out, (f + r) * ldo + lane);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lanes::Plain;
    use crate::real::Baseline;

    /// Shapes of the wider sets on plain vectors.
    struct Tall;

    impl Isa for Tall {
        type F32 = Plain<f32, 8>;
        const BLOCK: (usize, usize) = (6, 2);

        fn call<K: Kernel>(kernel: K) {
            kernel.run::<Self>();
        }
    }

    struct Wide;

    impl Isa for Wide {
        type F32 = Plain<f32, 8>;
        const BLOCK: (usize, usize) = (8, 2);

        fn call<K: Kernel>(kernel: K) {
            kernel.run::<Self>();
        }
    }

    #[test]
    fn products_equal_the_triple_loop() {
        check::<Baseline>();
        check::<Tall>();
        check::<Wide>();
    }

    fn check<I: Isa>() {
        for (m, n, k) in
            [(1, 8, 3), (4, 16, 5), (7, 24, 9), (15, 32, 64), (64, 8, 128), (3, 56, 1), (5, 64, 0)]
        {
            let a: Vec<f64> = (0..m * k).map(|i| ((i * 7 + 3) % 11) as f64 - 5.0).collect();
            let b: Vec<f64> = (0..k * n).map(|i| ((i * 5 + 1) % 13) as f64 - 6.0).collect();
            let mut at = vec![0.0; m * k];
            transpose((&a, k.max(1)), (m, k), (&mut at, m));
            let mut expect = vec![0.0; m * n];
            for i in 0..m {
                for j in 0..n {
                    expect[i * n + j] = (0..k).map(|l| a[i * k + l] * b[l * n + j]).sum::<f64>();
                }
            }
            let mut c = vec![7.0; m * n];
            product_of_rows::<f64, I>((m, n, k), (&a, k), (&b, n), &mut Store { c: &mut c, ld: n });
            assert_eq!(c, expect);
            product::<f64, I>((m, n, k), Columns(&at, m), (&b, n), &mut Add { c: &mut c, ld: n });
            assert!(c.iter().zip(&expect).all(|(c, e)| *c == 2.0 * e));
        }
    }

    #[test]
    fn lanes_and_features_change_places() {
        let x: Vec<f64> = (0..8 * 32).map(f64::from).collect();
        let (mut rows, mut back) = (vec![0.0; 32 * 9], vec![0.0; 8 * 32]);
        to_rows::<f64, Baseline>((&x, 32), (8, 32), (&mut rows, 9));
        assert_eq!(rows[9 * 21 + 5], x[5 * 32 + 21]);
        to_columns::<f64, Baseline>((&rows, 9), (8, 32), (&mut back, 32));
        assert_eq!(back, x);
    }

    #[test]
    fn reductions() {
        let x: Vec<f64> = (0..19).map(f64::from).collect();
        assert_eq!(sum(&x), 171.0);
        assert_eq!(dot::<f64, Baseline>(&x, &x), 2109.0);
    }
}
