//! Sums over matched points of a feature edge in single precision, eight at a time, about a centre near the points.

use crate::jacobian::MatchSums;
use crate::lanes::{LANES, Lane, huber, total};
use crate::transform::{Rigid, widen};

/// Blocks that are summed in single precision.
const CHUNK: usize = 8;

/// Eight matches: component by component, relative to the centres of both clouds. Unused lanes have weight zero.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Block {
    p: [Lane; 3],
    q: [Lane; 3],
    weight: Lane,
}

impl Block {
    /// Stores a match: each point with its centre.
    pub(crate) fn set_lane(
        &mut self,
        l: usize,
        p: ([f32; 3], [f32; 3]),
        q: ([f32; 3], [f32; 3]),
        weight: f32,
    ) {
        for k in 0..3 {
            self.p[k][l] = p.0[k] - p.1[k];
            self.q[k][l] = q.0[k] - q.1[k];
        }
        self.weight[l] = weight;
    }

    /// Transformed points of both sides and their distances.
    #[inline(always)]
    fn place(&self, (a, b): (&Rigid<f32>, &Rigid<f32>)) -> ([Lane; 3], [Lane; 3], Lane) {
        let (x, y) = (transform(a, &self.p), transform(b, &self.q));
        let mut e = [0.0; LANES];
        for k in 0..3 {
            for l in 0..LANES {
                let r = x[k][l] - y[k][l];
                e[l] += r * r;
            }
        }
        (x, y, e.map(f32::sqrt))
    }
}

#[inline(always)]
fn transform(t: &Rigid<f32>, [x, y, z]: &[Lane; 3]) -> [Lane; 3] {
    let r = &t.r;
    let mut out = [[0.0; LANES]; 3];
    for k in 0..3 {
        for l in 0..LANES {
            out[k][l] = r[3 * k] * x[l] + r[3 * k + 1] * y[l] + r[3 * k + 2] * z[l] + t.t[k];
        }
    }
    out
}

/// Sum of the weighted losses.
#[inline(always)]
pub(crate) fn cost(blocks: &[Block], poses: (&Rigid<f32>, &Rigid<f32>), delta: f32) -> f64 {
    let mut cost = 0.0;
    for chunk in blocks.chunks(CHUNK) {
        let mut sum = [0.0; LANES];
        for block in chunk {
            let (_, _, e) = block.place(poses);
            let (rho, _) = huber(&e, &block.weight, delta);
            (0..LANES).for_each(|l| sum[l] += rho[l]);
        }
        cost += total(&sum);
    }
    cost
}

/// Lanes of [`MatchSums`].
#[derive(Default)]
struct Sums {
    w: Lane,
    x: [Lane; 3],
    y: [Lane; 3],
    xx: [Lane; 6],
    yy: [Lane; 6],
    xy: [Lane; 9],
    r: [Lane; 3],
    x_cross_r: [Lane; 3],
}

impl Sums {
    #[inline(always)]
    fn add(&mut self, x: &[Lane; 3], y: &[Lane; 3], w: &Lane) {
        let (mut wx, mut wy, mut r) = ([[0.0; LANES]; 3], [[0.0; LANES]; 3], [[0.0; LANES]; 3]);
        for k in 0..3 {
            for l in 0..LANES {
                wx[k][l] = w[l] * x[k][l];
                wy[k][l] = w[l] * y[k][l];
                r[k][l] = w[l] * (x[k][l] - y[k][l]);
                self.x[k][l] += wx[k][l];
                self.y[k][l] += wy[k][l];
                self.r[k][l] += r[k][l];
            }
        }
        let mut triangle = 0;
        for a in 0..3 {
            for b in 0..3 {
                for l in 0..LANES {
                    self.xy[3 * a + b][l] += wx[a][l] * y[b][l];
                }
            }
            for b in 0..=a {
                for l in 0..LANES {
                    self.xx[triangle][l] += wx[a][l] * x[b][l];
                    self.yy[triangle][l] += wy[a][l] * y[b][l];
                }
                triangle += 1;
            }
            let (b, c) = ((a + 1) % 3, (a + 2) % 3);
            for l in 0..LANES {
                self.x_cross_r[a][l] += x[b][l] * r[c][l] - x[c][l] * r[b][l];
            }
        }
        (0..LANES).for_each(|l| self.w[l] += w[l]);
    }

    #[inline(always)]
    fn add_to(&self, sums: &mut MatchSums) {
        fn each<const N: usize>(lanes: &[Lane; N], sums: &mut [f64; N]) {
            lanes.iter().zip(sums).for_each(|(lane, sum)| *sum += total(lane));
        }
        sums.w += total(&self.w);
        each(&self.x, &mut sums.x);
        each(&self.y, &mut sums.y);
        each(&self.xx, &mut sums.xx);
        each(&self.yy, &mut sums.yy);
        each(&self.xy, &mut sums.xy);
        each(&self.r, &mut sums.r);
        each(&self.x_cross_r, &mut sums.x_cross_r);
    }
}

/// Weighted moments of the transformed points, and the sum of the weighted losses.
#[inline(always)]
pub(crate) fn sums(blocks: &[Block], poses: (&Rigid<f32>, &Rigid<f32>), delta: f32) -> (MatchSums, f64) {
    let mut all = MatchSums::default();
    let mut cost = 0.0;
    for chunk in blocks.chunks(CHUNK) {
        let mut sums = Sums::default();
        let mut sum = [0.0; LANES];
        for block in chunk {
            let (x, y, e) = block.place(poses);
            let (rho, w) = huber(&e, &block.weight, delta);
            (0..LANES).for_each(|l| sum[l] += rho[l]);
            sums.add(&x, &y, &w);
        }
        cost += total(&sum);
        sums.add_to(&mut all);
    }
    (all, cost)
}

/// Calls `f(x, y, distance, weight)` for the first `count` matches.
pub(crate) fn for_each(
    blocks: &[Block],
    count: usize,
    poses: (&Rigid<f32>, &Rigid<f32>),
    mut f: impl FnMut([f64; 3], [f64; 3], f64, f64),
) {
    for (b, block) in blocks.iter().enumerate() {
        let (x, y, e) = block.place(poses);
        for l in 0..LANES.min(count.saturating_sub(b * LANES)) {
            let of = |lanes: &[Lane; 3]| widen([lanes[0][l], lanes[1][l], lanes[2][l]]);
            f(of(&x), of(&y), f64::from(e[l]), f64::from(block.weight[l]));
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Vector3};
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;

    #[test]
    fn lanes_equal_double_precision_match_by_match() {
        let mut rng = Pcg64Mcg::seed_from_u64(9);
        let pose_a = Isometry3::new(Vector3::zeros(), Vector3::new(0.1, 0.4, -0.2));
        let pose_b = Isometry3::new(Vector3::new(0.002, 0.001, 0.0), Vector3::new(0.1, 0.41, -0.2));
        let (a, b) = (Rigid::<f32>::new(&pose_a), Rigid::<f32>::new(&pose_b));
        let (exact_a, exact_b) = (Rigid::<f64>::new(&pose_a), Rigid::<f64>::new(&pose_b));
        let delta = 0.005;
        for count in [0, 1, 8, 9, 64, 65, 203] {
            let mut blocks = vec![Block::default(); usize::div_ceil(count, LANES)];
            let (mut expected, mut expected_cost) = (MatchSums::default(), 0.0);
            for k in 0..count {
                let p = [0; 3].map(|_| rng.random_range(-0.1f32..0.1));
                let q = p.map(|x| x + rng.random_range(-0.006f32..0.006));
                let weight = rng.random_range(0.1f32..2.0);
                blocks[k / LANES].set_lane(k % LANES, (p, [0.0; 3]), (q, [0.0; 3]), weight);
                let (x, y) = (exact_a.point(p), exact_b.point(q));
                let (rho, w) = crate::jacobian::huber((Vector3::from(x) - Vector3::from(y)).norm(), delta);
                expected_cost += f64::from(weight) * rho;
                expected.add(x, y, f64::from(weight) * w);
            }
            let (got, got_cost) = sums(&blocks, (&a, &b), delta as f32);
            let (got, expected) = (got.finish(), expected.finish());
            for (got, expected) in [(got.ii, expected.ii), (got.jj, expected.jj), (got.ij, expected.ij)] {
                assert!((got - expected).amax() <= 2e-6 * expected.amax(), "{count}: {got}{expected}");
            }
            assert!((got.g - expected.g).amax() <= 1e-5 * (1e-3 + expected.g.amax()));
            assert!((got_cost - expected_cost).abs() <= 1e-5 * expected_cost);
            assert_eq!(got_cost, cost(&blocks, (&a, &b), delta as f32), "the same sums, bit for bit");
        }
    }
}
