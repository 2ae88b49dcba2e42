//! Sums over the residuals of a dense edge in single precision, eight at a time.
//!
//! Points are stored relative to centres of their clouds, so that single precision resolves nanometres on an object of
//! decimetres; rows are short sums in single precision, and totals are double.

use crate::jacobian::RowSums;
use crate::transform::Rigid;

/// Residuals that are computed together.
pub(crate) const LANES: usize = 8;
/// Blocks that are summed in single precision.
const CHUNK: usize = 16;

/// One number of each of the residuals.
pub(crate) type Lane = [f32; LANES];

/// Eight matches: component by component. Unused lanes have weight zero.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Block {
    pub(crate) source: [Lane; 3],
    pub(crate) target: [Lane; 3],
    pub(crate) normal: [Lane; 3],
    /// 1 / variance of the two depths.
    pub(crate) weight: Lane,
}

/// One match of a block.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Match {
    pub(crate) source: [f32; 3],
    pub(crate) target: [f32; 3],
    pub(crate) normal: [f32; 3],
    pub(crate) weight: f32,
}

impl Block {
    pub(crate) fn lane(&self, l: usize) -> Match {
        let of = |lanes: &[Lane; 3]| [lanes[0][l], lanes[1][l], lanes[2][l]];
        let weight = self.weight[l];
        Match { source: of(&self.source), target: of(&self.target), normal: of(&self.normal), weight }
    }

    #[inline(always)]
    pub(crate) fn set_lane(&mut self, l: usize, m: &Match) {
        for k in 0..3 {
            self.source[k][l] = m.source[k];
            self.target[k][l] = m.target[k];
            self.normal[k][l] = m.normal[k];
        }
        self.weight[l] = m.weight;
    }

    /// Transformed source points, and the point-to-plane residuals `n . (q - p)`.
    #[inline(always)]
    fn residuals(&self, target_from_source: &Rigid<f32>) -> ([Lane; 3], Lane) {
        let (r, t) = (&target_from_source.r, &target_from_source.t);
        let [x, y, z] = &self.source;
        let mut p = [[0.0; LANES]; 3];
        let mut e = [0.0; LANES];
        for k in 0..3 {
            for l in 0..LANES {
                p[k][l] = r[3 * k] * x[l] + r[3 * k + 1] * y[l] + r[3 * k + 2] * z[l] + t[k];
                e[l] += self.normal[k][l] * (self.target[k][l] - p[k][l]);
            }
        }
        (p, e)
    }
}

/// Huber's loss times the weight, and the weight of the residual in the normal equations.
#[inline(always)]
pub(crate) fn huber(e: &Lane, weight: &Lane, delta: f32) -> (Lane, Lane) {
    let (mut rho, mut w) = ([0.0; LANES], [0.0; LANES]);
    for l in 0..LANES {
        let e = e[l].abs();
        // Without branches: both zones in one formula.
        let inner = if e < delta { e } else { delta };
        let outer = if e < delta { delta } else { e };
        rho[l] = weight[l] * inner * (e - 0.5 * inner);
        w[l] = weight[l] * (delta / outer);
    }
    (rho, w)
}

#[inline(always)]
pub(crate) fn total(lane: &Lane) -> f64 {
    let pairs: [f32; 4] = std::array::from_fn(|l| lane[l] + lane[l + 4]);
    f64::from((pairs[0] + pairs[2]) + (pairs[1] + pairs[3]))
}

/// Sum of the weighted losses.
#[inline(always)]
pub(crate) fn cost(blocks: &[Block], target_from_source: &Rigid<f32>, delta: f32) -> f64 {
    let mut cost = 0.0;
    for chunk in blocks.chunks(CHUNK) {
        let mut sum = [0.0; LANES];
        for block in chunk {
            let (_, e) = block.residuals(target_from_source);
            let (rho, _) = huber(&e, &block.weight, delta);
            (0..LANES).for_each(|l| sum[l] += rho[l]);
        }
        cost += total(&sum);
    }
    cost
}

/// Residuals and rows of a chunk.
struct Rows {
    j: [[Lane; CHUNK]; 6],
    w: [Lane; CHUNK],
    e: [Lane; CHUNK],
}

/// `J^T W J`, `J^T W r` with the rows of the target node `[n; p x n]`, and the sum of the weighted losses.
#[inline(always)]
pub(crate) fn linearise(blocks: &[Block], target_from_source: &Rigid<f32>, delta: f32) -> (RowSums, f64) {
    let mut sums = RowSums::default();
    let mut cost = 0.0;
    let empty = [[0.0; LANES]; CHUNK];
    let mut rows = Rows { j: [empty; 6], w: empty, e: empty };
    for chunk in blocks.chunks(CHUNK) {
        let mut sum = [0.0; LANES];
        for (b, block) in chunk.iter().enumerate() {
            let (p, e) = block.residuals(target_from_source);
            let (rho, w) = huber(&e, &block.weight, delta);
            let n = &block.normal;
            for l in 0..LANES {
                sum[l] += rho[l];
                rows.j[3][b][l] = p[1][l] * n[2][l] - p[2][l] * n[1][l];
                rows.j[4][b][l] = p[2][l] * n[0][l] - p[0][l] * n[2][l];
                rows.j[5][b][l] = p[0][l] * n[1][l] - p[1][l] * n[0][l];
            }
            for k in 0..3 {
                rows.j[k][b] = n[k];
            }
            rows.w[b] = w;
            rows.e[b] = e;
        }
        cost += total(&sum);
        accumulate(&rows, chunk.len(), &mut sums);
    }
    (sums, cost)
}

/// Adds the outer products of the first `len` blocks of rows.
#[inline(always)]
fn accumulate(rows: &Rows, len: usize, sums: &mut RowSums) {
    let mut k = 0;
    let mut weighted = [[0.0; LANES]; CHUNK];
    let len = len.min(CHUNK);
    for a in 0..6 {
        for (out, (w, j)) in weighted.iter_mut().zip(rows.w.iter().zip(&rows.j[a])) {
            (0..LANES).for_each(|l| out[l] = w[l] * j[l]);
        }
        for b in 0..=a {
            sums.h[k] += dot(&weighted[..len], &rows.j[b][..len]);
            k += 1;
        }
        sums.g[a] += dot(&weighted[..len], &rows.e[..len]);
    }
}

#[inline(always)]
fn dot(a: &[Lane], b: &[Lane]) -> f64 {
    let mut sum = [0.0; LANES];
    for (a, b) in a.iter().zip(b) {
        for l in 0..LANES {
            sum[l] += a[l] * b[l];
        }
    }
    total(&sum)
}

/// Calls `f(residual, weight)` for the first `count` matches.
pub(crate) fn for_each(
    blocks: &[Block],
    count: usize,
    target_from_source: &Rigid<f32>,
    mut f: impl FnMut(f64, f64),
) {
    for (b, block) in blocks.iter().enumerate() {
        let (_, e) = block.residuals(target_from_source);
        for l in 0..LANES.min(count.saturating_sub(b * LANES)) {
            f(f64::from(e[l]), f64::from(block.weight[l]));
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Vector3};
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::jacobian::plane_residual;
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
            let (mut expected, mut residuals) = (0.0, Vec::new());
            for k in 0..count {
                let mut vector = || [0; 3].map(|_| rng.random_range(-0.1f32..0.1));
                let (s, n) = (vector(), Vector3::from(vector()).normalize().into());
                let p = double.point(s);
                let q: [f32; 3] = std::array::from_fn(|c| p[c] as f32 + rng.random_range(-0.01f32..0.01));
                let weight = rng.random_range(0.1f32..2.0);
                let m = Match { source: s, target: q, normal: n, weight };
                blocks[k / LANES].set_lane(k % LANES, &m);
                let (r, row) = plane_residual(widen(n), widen(q), p);
                let (rho, w) = crate::jacobian::huber(r.abs(), delta);
                expected += f64::from(weight) * rho;
                sums.add(&row, f64::from(weight) * w, r);
                residuals.push(r);
            }
            let (got, total) = linearise(&blocks, &single, delta as f32);
            let (h, g) = got.finish();
            let (expected_h, expected_g) = sums.finish();
            let (wide, _) = crate::simd::dense_sums(&blocks, &single, delta as f32);
            assert_eq!(wide.h, got.h, "every instruction set gives the same bits");
            assert!((h - expected_h).amax() <= 2e-6 * expected_h.amax(), "{count}: {h}{expected_h}");
            assert!((g - expected_g).amax() <= 1e-5 * (1e-2 + expected_g.amax()), "{count}: {g}{expected_g}");
            assert!((total - expected).abs() <= 1e-5 * expected);
            assert_eq!(total, cost(&blocks, &single, delta as f32), "the same sums, bit for bit");
            let mut seen = 0;
            for_each(&blocks, count, &single, |r, _| {
                assert!((r - residuals[seen]).abs() < 1e-7);
                seen += 1;
            });
            assert_eq!(seen, count);
        }
    }
}
