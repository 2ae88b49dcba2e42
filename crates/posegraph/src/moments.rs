//! Sums over matched points of a feature edge in single precision, eight at a time, about a centre near the points.

use crate::jacobian::PairSums;
use crate::lanes::{Lane, Placement, cross, difference, dot, huber};
use crate::simd::Vector;
use crate::stats::{self, Tally};
use crate::transform::Rigid;

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

    /// One side's point of a match, with its centre.
    pub(crate) fn point(&self, l: usize, first: bool, centre: [f32; 3]) -> [f32; 3] {
        let lanes = if first { &self.p } else { &self.q };
        std::array::from_fn(|k| lanes[k][l] + centre[k])
    }

    /// Transformed points of both sides, their differences and distances.
    #[inline(always)]
    fn place<V: Vector>(&self, (a, b): &(Placement<V>, Placement<V>)) -> Placed<V> {
        let (x, y) = (a.point(V::load3(&self.p)), b.point(V::load3(&self.q)));
        let r = difference(x, y);
        Placed { x, y, r, e: dot(r, r).sqrt() }
    }
}

struct Placed<V> {
    x: [V; 3],
    y: [V; 3],
    r: [V; 3],
    e: V,
}

#[inline(always)]
fn placements<V: Vector>((a, b): (&Rigid<f32>, &Rigid<f32>)) -> (Placement<V>, Placement<V>) {
    (Placement::new(a), Placement::new(b))
}

/// Sum of the weighted losses.
#[inline(always)]
pub(crate) fn cost<V: Vector>(blocks: &[Block], poses: (&Rigid<f32>, &Rigid<f32>), delta: f32) -> f64 {
    let (placements, delta) = (placements::<V>(poses), V::splat(delta));
    let mut cost = 0.0;
    for chunk in blocks.chunks(CHUNK) {
        let mut sum = V::splat(0.0);
        for block in chunk {
            let e = block.place(&placements).e;
            sum = sum + huber(e, V::load(&block.weight), delta).0;
        }
        cost += sum.total();
    }
    cost
}

/// Lanes of [`PairSums`].
struct Sums<V> {
    w: V,
    m: [V; 3],
    mm: [V; 6],
    r: [V; 3],
    m_cross_r: [V; 3],
}

impl<V: Vector> Sums<V> {
    #[inline(always)]
    fn zero() -> Self {
        let zero = V::splat(0.0);
        Self { w: zero, m: [zero; 3], mm: [zero; 6], r: [zero; 3], m_cross_r: [zero; 3] }
    }

    #[inline(always)]
    fn add(&mut self, placed: &Placed<V>, w: V) {
        let half = V::splat(0.5);
        let turn = cross(placed.x, placed.r);
        self.w = self.w + w;
        let mut m = [w; 3];
        for k in 0..3 {
            m[k] = half * (placed.x[k] + placed.y[k]);
            self.r[k] = self.r[k] + w * placed.r[k];
            self.m_cross_r[k] = self.m_cross_r[k] + w * turn[k];
        }
        let mut triangle = 0;
        for a in 0..3 {
            let wm = w * m[a];
            self.m[a] = self.m[a] + wm;
            for b in 0..=a {
                self.mm[triangle] = self.mm[triangle] + wm * m[b];
                triangle += 1;
            }
        }
    }

    #[inline(always)]
    fn add_to(&self, sums: &mut PairSums) {
        sums.w += self.w.total();
        for k in 0..3 {
            sums.m[k] += self.m[k].total();
            sums.r[k] += self.r[k].total();
            sums.m_cross_r[k] += self.m_cross_r[k].total();
        }
        for k in 0..6 {
            sums.mm[k] += self.mm[k].total();
        }
    }
}

/// Weighted moments of the transformed points, and the sum of the weighted losses.
#[inline(always)]
pub(crate) fn sums<V: Vector>(
    blocks: &[Block],
    poses: (&Rigid<f32>, &Rigid<f32>),
    delta: f32,
) -> (PairSums, f64) {
    let (placements, delta) = (placements::<V>(poses), V::splat(delta));
    let mut all = PairSums::default();
    let mut cost = 0.0;
    for chunk in blocks.chunks(CHUNK) {
        let mut sums = Sums::<V>::zero();
        let mut sum = V::splat(0.0);
        for block in chunk {
            let placed = block.place(&placements);
            let (rho, w) = huber(placed.e, V::load(&block.weight), delta);
            sum = sum + rho;
            sums.add(&placed, w);
        }
        cost += sum.total();
        sums.add_to(&mut all);
    }
    (all, cost)
}

/// How well the matches agree.
#[inline(always)]
pub(crate) fn tally<V: Vector>(blocks: &[Block], poses: (&Rigid<f32>, &Rigid<f32>), delta: f32) -> Tally {
    let (placements, delta) = (placements::<V>(poses), V::splat(delta));
    let mut tally = Tally::default();
    for chunk in blocks.chunks(CHUNK) {
        let mut sums = stats::Sums::<V>::default();
        for block in chunk {
            sums.add(block.place(&placements).e, V::load(&block.weight), delta);
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
    use crate::lanes::LANES;
    use crate::simd::{self, Portable};
    use crate::stats::Residuals;

    #[test]
    fn lanes_equal_double_precision_match_by_match() {
        let mut rng = Pcg64Mcg::seed_from_u64(9);
        let pose_a = Isometry3::new(Vector3::zeros(), Vector3::new(0.1, 0.4, -0.2));
        let pose_b = Isometry3::new(Vector3::new(0.002, 0.001, 0.0), Vector3::new(0.1, 0.41, -0.2));
        let (a, b) = (Rigid::<f32>::new(&pose_a), Rigid::<f32>::new(&pose_b));
        let (exact_a, exact_b) = (Rigid::<f64>::new(&pose_a), Rigid::<f64>::new(&pose_b));
        let delta = 0.005;
        for count in [0, 1, 8, 9, 64, 65, 203] {
            let (mut all, mut inliers) = (Residuals::default(), 0.0);
            let mut blocks = vec![Block::default(); usize::div_ceil(count, LANES)];
            let (mut expected, mut expected_cost) = (PairSums::default(), 0.0);
            for k in 0..count {
                let p = [0; 3].map(|_| rng.random_range(-0.1f32..0.1));
                let q = p.map(|x| x + rng.random_range(-0.006f32..0.006));
                let weight = rng.random_range(0.1f32..2.0);
                blocks[k / LANES].set_lane(k % LANES, (p, [0.0; 3]), (q, [0.0; 3]), weight);
                let (x, y) = (exact_a.point(p), exact_b.point(q));
                let (rho, w) = crate::jacobian::huber((Vector3::from(x) - Vector3::from(y)).norm(), delta);
                expected_cost += f64::from(weight) * rho;
                expected.add(x, y, f64::from(weight) * w);
                let distance = (Vector3::from(x) - Vector3::from(y)).norm();
                inliers += f64::from(u8::from(all.add(distance, delta, f64::from(weight))));
            }
            let (got, got_cost) = sums::<Portable>(&blocks, (&a, &b), delta as f32);
            let ((h, g), (expected_h, expected_g)) = (got.finish(), expected.finish());
            assert!((h - expected_h).amax() <= 2e-6 * expected_h.amax(), "{count}: {h}{expected_h}");
            assert!((g - expected_g).amax() <= 1e-5 * (1e-3 + expected_g.amax()));
            let (wide, wide_cost) = simd::feature_sums(&blocks, (&a, &b), delta as f32);
            assert_eq!(
                (wide.finish(), wide_cost),
                ((h, g), got_cost),
                "every instruction set: the same bits"
            );
            assert!((got_cost - expected_cost).abs() <= 1e-5 * expected_cost);
            let costs = [cost::<Portable>, simd::feature_cost].map(|c| c(&blocks, (&a, &b), delta as f32));
            assert_eq!(costs, [got_cost; 2], "the same sums, bit for bit");
            let tallies =
                [tally::<Portable>, simd::feature_tally].map(|t| t(&blocks, (&a, &b), delta as f32));
            assert_eq!(tallies[0], tallies[1]);
            let mut counted = Residuals::default();
            assert_eq!(counted.add_edge(&tallies[0]) as f64, inliers);
            assert!((counted.rms() - all.rms()).abs() <= 1e-5 * all.rms());
        }
    }
}
