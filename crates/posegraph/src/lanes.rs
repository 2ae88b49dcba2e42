//! Sums over the residuals of a dense edge in single precision, eight at a time.
//!
//! Points are stored relative to centres of their clouds, so that single precision resolves nanometres on an object of
//! decimetres; rows are short sums in single precision, and totals are double.

use crate::jacobian::RowSums;
use crate::simd::Vector;
use crate::stats::Tally;
use crate::transform::Rigid;

/// Residuals that are computed together.
pub(crate) const LANES: usize = 8;
/// Blocks that are summed in single precision.
const CHUNK: usize = 16;

/// One number of each of the residuals.
pub(crate) type Lane = [f32; LANES];

/// Eight matches: component by component. Unused lanes are zero.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Block {
    pub(crate) source: [Lane; 3],
    pub(crate) target: [Lane; 3],
    pub(crate) normal: [Lane; 3],
    /// 1 / variance of the two depths.
    pub(crate) weight: Lane,
}

/// A rigid motion of eight points at a time.
pub(crate) struct Placement<V> {
    r: [V; 9],
    t: [V; 3],
}

impl<V: Vector> Placement<V> {
    #[inline(always)]
    pub(crate) fn new(motion: &Rigid<f32>) -> Self {
        let mut placement = Self { r: [V::splat(0.0); 9], t: [V::splat(0.0); 3] };
        // Not `map`: what isn't inlined knows nothing of the processor that this is compiled for.
        (0..9).for_each(|k| placement.r[k] = V::splat(motion.r[k]));
        (0..3).for_each(|k| placement.t[k] = V::splat(motion.t[k]));
        placement
    }

    #[inline(always)]
    pub(crate) fn point(&self, p: [V; 3]) -> [V; 3] {
        let d = self.direction(p);
        [d[0] + self.t[0], d[1] + self.t[1], d[2] + self.t[2]]
    }

    #[inline(always)]
    pub(crate) fn direction(&self, [x, y, z]: [V; 3]) -> [V; 3] {
        let r = &self.r;
        [r[0] * x + r[1] * y + r[2] * z, r[3] * x + r[4] * y + r[5] * z, r[6] * x + r[7] * y + r[8] * z]
    }
}

#[inline(always)]
pub(crate) fn difference<V: Vector>(a: [V; 3], b: [V; 3]) -> [V; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
pub(crate) fn dot<V: Vector>(a: [V; 3], b: [V; 3]) -> V {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
pub(crate) fn cross<V: Vector>(a: [V; 3], b: [V; 3]) -> [V; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

impl Block {
    /// Transformed source points, normals, and the point-to-plane residuals `n . (q - p)`.
    #[inline(always)]
    fn residuals<V: Vector>(&self, target_from_source: &Placement<V>) -> ([V; 3], [V; 3], V) {
        let p = target_from_source.point(V::load3(&self.source));
        let n = V::load3(&self.normal);
        let e = dot(n, difference(V::load3(&self.target), p));
        (p, n, e)
    }
}

/// Huber's loss times the weight, and the weight of the residual in the normal equations; `e >= 0`.
#[inline(always)]
pub(crate) fn huber<V: Vector>(e: V, weight: V, delta: V) -> (V, V) {
    // Without branches: both zones in one formula.
    let inner = e.min(delta);
    let rho = weight * inner * (e - V::splat(0.5) * inner);
    (rho, weight * (delta / e.max(delta)))
}

/// Sum of the weighted losses.
#[inline(always)]
pub(crate) fn cost<V: Vector>(blocks: &[Block], target_from_source: &Rigid<f32>, delta: f32) -> f64 {
    let (placement, delta) = (Placement::<V>::new(target_from_source), V::splat(delta));
    let mut cost = 0.0;
    for chunk in blocks.chunks(CHUNK) {
        let mut sum = V::splat(0.0);
        for block in chunk {
            let (_, _, e) = block.residuals(&placement);
            sum = sum + huber(e.abs(), V::load(&block.weight), delta).0;
        }
        cost += sum.total();
    }
    cost
}

/// Columns of the rows of a chunk: `n`, the residual, `p x n`, the weight.
type Row<V> = [V; 8];
const N: usize = 0;
const E: usize = 3;
const TURN: usize = 4;
const W: usize = 7;

/// `J^T W J`, `J^T W r` with the rows of the target node `[n; p x n]`, and the sum of the weighted losses.
#[inline(always)]
pub(crate) fn linearise<V: Vector>(
    blocks: &[Block],
    target_from_source: &Rigid<f32>,
    delta: f32,
) -> (RowSums, f64) {
    let (placement, delta) = (Placement::<V>::new(target_from_source), V::splat(delta));
    let mut sums = RowSums::default();
    let mut cost = 0.0;
    let mut rows: [Row<V>; CHUNK] = [[V::splat(0.0); 8]; CHUNK];
    for chunk in blocks.chunks(CHUNK) {
        let mut sum = V::splat(0.0);
        for (row, block) in rows.iter_mut().zip(chunk) {
            let (p, n, e) = block.residuals(&placement);
            let (rho, w) = huber(e.abs(), V::load(&block.weight), delta);
            sum = sum + rho;
            let turn = cross(p, n);
            *row = [n[0], n[1], n[2], e, turn[0], turn[1], turn[2], w];
        }
        cost += sum.total();
        accumulate(&rows[..chunk.len().min(CHUNK)], &mut sums);
    }
    (sums, cost)
}

/// Adds the outer products of these rows, a tile at a time so that its sums stay in registers.
#[inline(always)]
fn accumulate<V: Vector>(rows: &[Row<V>], sums: &mut RowSums) {
    // The residual is a neighbour of both kinds of columns.
    for (a, row) in products::<V, 3, 4>(rows, N, N).iter().enumerate() {
        (0..=a).for_each(|b| sums.h[triangle(a, b)] += row[b]);
        sums.g[a] += row[E];
    }
    for (a, row) in products::<V, 3, 4>(rows, TURN, N).iter().enumerate() {
        (0..3).for_each(|b| sums.h[triangle(a + 3, b)] += row[b]);
        sums.g[a + 3] += row[E];
    }
    for (a, row) in products::<V, 3, 3>(rows, TURN, TURN).iter().enumerate() {
        (0..=a).for_each(|b| sums.h[triangle(a + 3, b + 3)] += row[b]);
    }
}

/// Index of entry `(a, b)`, `b <= a`, in a lower triangle stored row by row.
const fn triangle(a: usize, b: usize) -> usize {
    a * (a + 1) / 2 + b
}

/// Weighted products of `A` columns from `a` on with `B` columns from `b` on.
#[inline(always)]
fn products<V: Vector, const A: usize, const B: usize>(rows: &[Row<V>], a: usize, b: usize) -> [[f64; B]; A] {
    let mut sums = [[V::splat(0.0); B]; A];
    for row in rows {
        for (i, sums) in sums.iter_mut().enumerate() {
            let weighted = row[W] * row[a + i];
            for (j, sum) in sums.iter_mut().enumerate() {
                *sum = *sum + weighted * row[b + j];
            }
        }
    }
    let mut totals = [[0.0; B]; A];
    for (totals, sums) in totals.iter_mut().zip(&sums) {
        for (total, sum) in totals.iter_mut().zip(sums) {
            *total = sum.total();
        }
    }
    totals
}

/// How well the matches agree.
#[inline(always)]
pub(crate) fn tally<V: Vector>(blocks: &[Block], target_from_source: &Rigid<f32>, delta: f32) -> Tally {
    let (placement, delta) = (Placement::<V>::new(target_from_source), V::splat(delta));
    let mut tally = Tally::default();
    for chunk in blocks.chunks(CHUNK) {
        let mut sums = crate::stats::Sums::<V>::default();
        for block in chunk {
            let (_, _, e) = block.residuals(&placement);
            sums.add(e.abs(), V::load(&block.weight), delta);
        }
        sums.add_to(&mut tally);
    }
    tally
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Vector3};
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::jacobian::plane_residual;
    use crate::simd::{self, Portable};
    use crate::stats::Residuals;
    use crate::transform::widen;

    #[test]
    fn lanes_equal_double_precision_row_by_row() {
        let mut rng = Pcg64Mcg::seed_from_u64(8);
        let pose = Isometry3::new(Vector3::new(0.001, 0.0, -0.002), Vector3::new(0.1, 0.4, -0.2));
        let (single, double) = (Rigid::<f32>::new(&pose), Rigid::<f64>::new(&pose));
        let delta = 0.005;
        for count in [0, 1, 7, 8, 9, 128, 129, 793] {
            let mut blocks = vec![Block::default(); usize::div_ceil(count, LANES)];
            let mut sums = RowSums::default();
            let (mut expected, mut inliers) = (0.0, 0.0);
            let mut all = Residuals::default();
            for k in 0..count {
                let mut vector = || [0; 3].map(|_| rng.random_range(-0.1f32..0.1));
                let (s, n): (_, [f32; 3]) = (vector(), Vector3::from(vector()).normalize().into());
                let p = double.point(s);
                let q: [f32; 3] = std::array::from_fn(|c| p[c] as f32 + rng.random_range(-0.01f32..0.01));
                let weight = rng.random_range(0.1f32..2.0);
                let (block, l) = (&mut blocks[k / LANES], k % LANES);
                for c in 0..3 {
                    (block.source[c][l], block.target[c][l], block.normal[c][l]) = (s[c], q[c], n[c]);
                }
                block.weight[l] = weight;
                let (r, row) = plane_residual(widen(n), widen(q), p);
                let (rho, w) = crate::jacobian::huber(r.abs(), delta);
                expected += f64::from(weight) * rho;
                sums.add(&row, f64::from(weight) * w, r);
                inliers += f64::from(u8::from(all.add(r, delta, f64::from(weight))));
            }
            let (got, total) = linearise::<Portable>(&blocks, &single, delta as f32);
            let (h, g) = got.finish();
            let (expected_h, expected_g) = sums.finish();
            let (wide, wide_total) = simd::dense_sums(&blocks, &single, delta as f32);
            assert_eq!(
                (wide.h, wide.g, wide_total),
                (got.h, got.g, total),
                "every instruction set: the same bits"
            );
            assert!((h - expected_h).amax() <= 2e-6 * expected_h.amax(), "{count}: {h}{expected_h}");
            assert!((g - expected_g).amax() <= 1e-5 * (1e-2 + expected_g.amax()), "{count}: {g}{expected_g}");
            assert!((total - expected).abs() <= 1e-5 * expected);
            let costs = [cost::<Portable>, simd::dense_cost].map(|cost| cost(&blocks, &single, delta as f32));
            assert_eq!(costs, [total; 2], "the same sums, bit for bit");
            let tallies = [tally::<Portable>, simd::dense_tally].map(|t| t(&blocks, &single, delta as f32));
            assert_eq!(tallies[0], tallies[1]);
            let mut counted = Residuals::default();
            assert_eq!(counted.add_edge(&tallies[0]) as f64, inliers);
            assert!((counted.rms() - all.rms()).abs() <= 1e-5 * all.rms());
        }
    }
}
