//! Small matrix products on row-major slices: the one inner loop behind every layer, forward and backward.
//!
//! Activations are feature-major (`[feature][lane]`), so a layer is `W * X`, its input gradient `W^T * dY` and its
//! weight gradient `dY * X^T`, all three the same register-blocked kernel: 4 rows of accumulators by 16 columns.

use crate::real::Real;

/// Columns per register block; column counts are multiples of half of it.
const NB: usize = 16;
const NB_HALF: usize = 8;
const MB: usize = 4;

/// `C += A * B` for `C` of `m` x `n`, inner length `k`, with row strides `lda`, `ldb`, `ldc`.
///
/// `T`: `a` holds the transpose of A, `A(i, k) = a[k * lda + i]`. `n` is a multiple of 8.
#[inline(always)]
pub(crate) fn gemm_add<R: Real, const FMA: bool, const T: bool>(
    (m, n, k): (usize, usize, usize),
    (a, lda): (&[R], usize),
    (b, ldb): (&[R], usize),
    (c, ldc): (&mut [R], usize),
) {
    debug_assert!(n.is_multiple_of(NB_HALF));
    if k == 0 {
        return;
    }
    let mut j = 0;
    while j < n {
        let wide = j + NB <= n;
        let mut i = 0;
        while i < m {
            let a = if T { &a[i..] } else { &a[i * lda..] };
            let c = &mut c[i * ldc + j..];
            let tall = i + MB <= m;
            match (tall, wide) {
                (true, true) => block::<R, FMA, T, MB, NB>(k, a, lda, &b[j..], ldb, c, ldc),
                (true, false) => block::<R, FMA, T, MB, NB_HALF>(k, a, lda, &b[j..], ldb, c, ldc),
                (false, true) => block::<R, FMA, T, 1, NB>(k, a, lda, &b[j..], ldb, c, ldc),
                (false, false) => block::<R, FMA, T, 1, NB_HALF>(k, a, lda, &b[j..], ldb, c, ldc),
            }
            i += if tall { MB } else { 1 };
        }
        j += if wide { NB } else { NB_HALF };
    }
}

#[inline(always)]
fn block<R: Real, const FMA: bool, const T: bool, const M: usize, const N: usize>(
    k: usize,
    a: &[R],
    lda: usize,
    b: &[R],
    ldb: usize,
    c: &mut [R],
    ldc: usize,
) {
    let mut acc = [[R::ZERO; N]; M];
    if T {
        for l in 0..k {
            let (Some(col), Some(row)) = (a[l * lda..].first_chunk::<M>(), b[l * ldb..].first_chunk::<N>())
            else {
                return;
            };
            for i in 0..M {
                for j in 0..N {
                    acc[i][j] = col[i].madd::<FMA>(row[j], acc[i][j]);
                }
            }
        }
    } else {
        let rows: [&[R]; M] = std::array::from_fn(|i| &a[i * lda..i * lda + k]);
        for l in 0..k {
            let Some(row) = b[l * ldb..].first_chunk::<N>() else { return };
            for i in 0..M {
                let w = rows[i][l];
                for j in 0..N {
                    acc[i][j] = w.madd::<FMA>(row[j], acc[i][j]);
                }
            }
        }
    }
    for i in 0..M {
        let Some(row) = c[i * ldc..].first_chunk_mut::<N>() else { return };
        for j in 0..N {
            row[j] += acc[i][j];
        }
    }
}

/// Sum over a row of the products of two equally long slices, in eight interleaved partial sums.
#[inline(always)]
pub(crate) fn dot<R: Real, const FMA: bool>(x: &[R], y: &[R]) -> R {
    let mut acc = [R::ZERO; 8];
    let (xs, ys) = (x.chunks_exact(8), y.chunks_exact(8));
    let (xr, yr) = (xs.remainder(), ys.remainder());
    for (a, b) in xs.zip(ys) {
        for l in 0..8 {
            acc[l] = a[l].madd::<FMA>(b[l], acc[l]);
        }
    }
    let mut sum = ((acc[0] + acc[4]) + (acc[1] + acc[5])) + ((acc[2] + acc[6]) + (acc[3] + acc[7]));
    for (a, b) in xr.iter().zip(yr) {
        sum = a.madd::<FMA>(*b, sum);
    }
    sum
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
    let mut sum = ((acc[0] + acc[4]) + (acc[1] + acc[5])) + ((acc[2] + acc[6]) + (acc[3] + acc[7]));
    for a in rest {
        sum += *a;
    }
    sum
}

/// `out[lane][row] = x[row][lane]` for `rows` x `lanes` with row stride `ldx`; `out` has row stride `rows`.
#[inline(always)]
pub(crate) fn transpose<R: Real>(x: &[R], ldx: usize, rows: usize, lanes: usize, out: &mut [R]) {
    for l0 in (0..lanes).step_by(8) {
        for r in 0..rows {
            let Some(src) = x[r * ldx + l0..].first_chunk::<8>() else { return };
            for l in 0..8 {
                out[(l0 + l) * rows + r] = src[l];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_equal_the_triple_loop() {
        for (m, n, k) in [(1, 8, 3), (4, 16, 5), (7, 24, 9), (15, 32, 64), (64, 8, 128), (3, 40, 1)] {
            let a: Vec<f64> = (0..m * k).map(|i| ((i * 7 + 3) % 11) as f64 - 5.0).collect();
            let b: Vec<f64> = (0..k * n).map(|i| ((i * 5 + 1) % 13) as f64 - 6.0).collect();
            let at: Vec<f64> = (0..k * m).map(|i| a[(i % m) * k + i / m]).collect();
            let mut expect = vec![1.0; m * n];
            for i in 0..m {
                for j in 0..n {
                    expect[i * n + j] += (0..k).map(|l| a[i * k + l] * b[l * n + j]).sum::<f64>();
                }
            }
            let (mut c, mut ct) = (vec![1.0; m * n], vec![1.0; m * n]);
            gemm_add::<f64, false, false>((m, n, k), (&a, k), (&b, n), (&mut c, n));
            gemm_add::<f64, false, true>((m, n, k), (&at, m), (&b, n), (&mut ct, n));
            assert_eq!(c, expect);
            assert_eq!(ct, expect);
        }
    }

    #[test]
    fn reductions_and_transpose() {
        let x: Vec<f64> = (0..19).map(f64::from).collect();
        assert_eq!(sum(&x), 171.0);
        assert_eq!(dot::<f64, false>(&x, &x), 2109.0);
        let m: Vec<f64> = (0..3 * 16).map(f64::from).collect();
        let mut t = vec![0.0; 48];
        transpose(&m, 16, 3, 16, &mut t);
        assert_eq!(t[5 * 3 + 2], m[2 * 16 + 5]);
    }
}
