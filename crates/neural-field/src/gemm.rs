//! Small matrix products on row-major slices: the one inner loop behind every layer, forward and backward.
//!
//! Sums stay in registers, a block of rows and columns at a time. What they start from and where they go is a
//! [`Target`]: bias, ReLU and mask cost no pass of their own over memory.

mod simd;

use crate::lanes::Lanes;
use crate::real::{Isa, Kernel, Real};
use crate::tile::VECTOR;
use simd::Steps;

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
        for (column, row) in Steps::new(k, (a, i, stride, M), (b, j, ldb, N * V::N)) {
            let row: [V; N] = load_row(row, 0);
            for r in 0..M {
                add_product(V::splat(column[r]), &row, &mut sums[r]);
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
        let reach = (M - 1) * stride + 1;
        for (column, row) in Steps::new(k, (a, i * stride, 1, reach), (b, j, ldb, N * V::N)) {
            let row: [V; N] = load_row(row, 0);
            for r in 0..M {
                add_product(V::splat(column[r * stride]), &row, &mut sums[r]);
            }
        }
    }
}

/// A matrix that is in memory row by row, `row * STRIDE + column`, two columns at a time against the right factor's rows of
/// pairs (see [`to_pairs`]): narrow right factors fill a vector that way. Every sum comes in two parts.
#[derive(Clone, Copy)]
pub(crate) struct Pairs<'a, R, const STRIDE: usize>(pub(crate) &'a [R]);

impl<R: Real, const STRIDE: usize> Left<R> for Pairs<'_, R, STRIDE> {
    #[inline(always)]
    fn accumulate<V: Lanes<R>, const M: usize, const N: usize>(
        self,
        (i, j): (usize, usize),
        k: usize,
        (b, ldb): (&[R], usize),
        sums: &mut [[V; N]; M],
    ) {
        let reach = (M - 1) * STRIDE + 2;
        for (columns, row) in Steps::new(k, (self.0, i * STRIDE, 2, reach), (b, j, ldb, N * V::N)) {
            let row: [V; N] = load_row(row, 0);
            for r in 0..M {
                let pair = [columns[r * STRIDE], columns[r * STRIDE + 1]];
                add_product(V::splat_pair(&pair), &row, &mut sums[r]);
            }
        }
    }
}

/// `sums += a * row`.
#[inline(always)]
fn add_product<R: Real, V: Lanes<R>, const N: usize>(a: V, row: &[V; N], sums: &mut [V; N]) {
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
        // The usual widths of the geometry features and of a hidden layer.
        16 => product::<R, I>(shape, Rows::<R, 16>(a), b, target),
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
        type Eight<R, I> = <<R as Real>::V<I> as Lanes<R>>::Eight;
        let Self { shape: (m, n, k), a, b, target } = self;
        let width = <R::V<I>>::N;
        let mut j = 0;
        while j < n {
            let (at, vectors) = ((m, j, k), (n - j) / width);
            j += if I::BLOCK.1 >= 4 && vectors >= 4 {
                columns::<R, I, R::V<I>, 4>(at, a, b, target)
            } else if I::BLOCK.1 >= 2 && vectors >= 2 {
                columns::<R, I, R::V<I>, 2>(at, a, b, target)
            } else if width == 8 || vectors >= 1 {
                columns::<R, I, R::V<I>, 1>(at, a, b, target)
            } else {
                columns::<R, I, Eight<R, I>, 1>(at, a, b, target)
            };
        }
    }
}

/// `N` vectors of columns of the product, from column `j`; returns their number.
#[inline(always)]
fn columns<R: Real, I: Isa, V: Lanes<R>, const N: usize>(
    (m, j, k): (usize, usize, usize),
    a: impl Left<R>,
    b: (&[R], usize),
    target: &mut impl Target<R>,
) -> usize {
    let rows = I::BLOCK.0 / N;
    let mut i = 0;
    while i < m {
        let at = (i, j);
        // A block of few rows waits for its sums: rather two of 8 than 12 and 4, two of 4 than 6 and 2.
        i += match m - i {
            rest if rows >= 16 && rest >= 16 => block::<R, V, 16, N>(at, k, a, b, target),
            rest if (12..16).contains(&rows) && rest >= 12 && rest != 16 => {
                block::<R, V, 12, N>(at, k, a, b, target)
            }
            rest if rows >= 8 && rest >= 8 => block::<R, V, 8, N>(at, k, a, b, target),
            rest if (6..8).contains(&rows) && rest >= 6 && rest != 8 => {
                block::<R, V, 6, N>(at, k, a, b, target)
            }
            rest if rest >= 4 => block::<R, V, 4, N>(at, k, a, b, target),
            rest if rest >= 2 => block::<R, V, 2, N>(at, k, a, b, target),
            _ => block::<R, V, 1, N>(at, k, a, b, target),
        };
    }
    N * V::N
}

/// One block of sums, `M` rows of `N` vectors; returns `M`.
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
    M
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

/// From feature-major to rows of two lanes' features, `(lane / 2) * 2 * features + 2 * feature + lane % 2`, for whole vectors
/// of lanes and pairs of features.
#[inline(always)]
pub(crate) fn to_pairs<R: Real, I: Isa>(
    (x, ldx): (&[R], usize),
    (features, lanes): (usize, usize),
    out: &mut [R],
) {
    for lane in (0..lanes).step_by(<R::V<I>>::N) {
        for f in (0..features).step_by(2) {
            let a = <R::V<I>>::load(x, f * ldx + lane);
            let b = <R::V<I>>::load(x, (f + 1) * ldx + lane);
            let out = &mut out[lane * features + 2 * f..];
            a.low_pairs(b).store_quads(out, 0, features);
            a.high_pairs(b).store_quads(out, 2, features);
        }
    }
}

/// From lane-major to feature-major, for whole vectors of lanes and quads of features, with row strides.
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
        const BLOCK: (usize, usize) = (12, 2);

        fn call<K: Kernel>(kernel: K) {
            kernel.run::<Self>();
        }
    }

    struct Wide;

    impl Isa for Wide {
        type F32 = Plain<f32, 8>;
        const BLOCK: (usize, usize) = (24, 4);

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
        let x: Vec<f64> = (0..32 * 9).map(f64::from).collect();
        let mut columns = vec![0.0; 8 * 40];
        to_columns::<f64, Baseline>((&x, 9), (8, 32), (&mut columns, 40));
        assert!((0..8).all(|f| (0..32).all(|l| columns[f * 40 + l] == x[l * 9 + f])));
        let mut pairs = vec![0.0; 8 * 32];
        to_pairs::<f64, Baseline>((&columns, 40), (8, 32), &mut pairs);
        assert!((0..8).all(|f| (0..32).all(|l| pairs[l / 2 * 16 + 2 * f + l % 2] == x[l * 9 + f])));
    }

    #[test]
    fn products_of_pairs_sum_up_to_the_product() {
        check_pairs::<Baseline>();
        check_pairs::<Wide>();
    }

    /// `A[13][32] * B[32][8]`, A with rows of 40.
    fn check_pairs<I: Isa>() {
        let a: Vec<f64> = (0..13 * 40).map(|i| f64::from((i * 7 + 3) % 11)).collect();
        let b: Vec<f64> = (0..8 * 32).map(|i| f64::from((i * 5 + 1) % 13)).collect();
        let (mut pairs, mut c) = (vec![0.0; 8 * 32], vec![1.0; 13 * 16]);
        to_pairs::<f64, I>((&b, 32), (8, 32), &mut pairs);
        product::<f64, I>((13, 16, 16), Pairs::<f64, 40>(&a), (&pairs, 16), &mut Add { c: &mut c, ld: 16 });
        for (i, row) in c.chunks_exact(16).enumerate() {
            for (j, sums) in row.chunks_exact(2).enumerate() {
                let expect: f64 = (0..32).map(|l| a[i * 40 + l] * b[j * 32 + l]).sum();
                assert_eq!(sums[0] + sums[1], 2.0 + expect);
            }
        }
    }

    #[test]
    fn reductions() {
        let x: Vec<f64> = (0..19).map(f64::from).collect();
        assert_eq!(sum(&x), 171.0);
        assert_eq!(dot::<f64, Baseline>(&x, &x), 2109.0);
    }
}
