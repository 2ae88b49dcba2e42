//! Feature term: distances of matched points (eq. `L_f`).

use nalgebra::{Isometry3, Translation3, Vector3};

use crate::graph::FeatureEdge;
use crate::jacobian::lift;
use crate::lanes::LANES;
use crate::moments::{self, Block};
use crate::normal::NormalEquations;
use crate::options::SolveOptions;
use crate::simd;
use crate::stats::{Extent, Residuals};
use crate::transform::{Rigid, is_finite, widen};

/// The usable matches of one feature edge.
#[derive(Debug)]
pub(crate) struct FeatureTerm {
    pub(crate) edge: usize,
    pub(crate) i: usize,
    pub(crate) j: usize,
    /// Matches, points relative to the centres.
    blocks: Vec<Block>,
    count: usize,
    centre_i: [f32; 3],
    centre_j: [f32; 3],
    /// Factor on every match: term weight, 1 / variance, count cap.
    scale: f64,
    delta: f64,
}

/// Where the points of an edge are: rotations and small offsets from a common centre in the object frame.
struct Placed {
    centre: Vector3<f64>,
    a: Rigid<f32>,
    b: Rigid<f32>,
}

impl FeatureTerm {
    pub(crate) fn new(index: usize, edge: &FeatureEdge, options: &SolveOptions) -> Self {
        let points = || {
            let pairs = edge.points_i.iter().zip(&edge.points_j).enumerate();
            pairs
                .map(|(k, (&p, &q))| (p, q, edge.weights.get(k).copied().unwrap_or(1.0)))
                .filter(|(p, q, w)| is_finite(p) && is_finite(q) && w.is_finite() && *w > 0.0)
        };
        let (mut count, mut total, mut sums) = (0, 0.0, [Vector3::zeros(); 2]);
        for (p, q, w) in points() {
            count += 1;
            total += f64::from(w);
            sums[0] += Vector3::from(widen(p));
            sums[1] += Vector3::from(widen(q));
        }
        let [centre_i, centre_j] = sums.map(|s| (s / f64::max(count as f64, 1.0)).map(|x| x as f32).into());
        let mut blocks = vec![Block::default(); usize::div_ceil(count, LANES)];
        for (k, (p, q, w)) in points().enumerate() {
            blocks[k / LANES].set_lane(k % LANES, (p, centre_i), (q, centre_j), w);
        }
        let scale = options.feature_weight / (options.feature_sigma * options.feature_sigma)
            * if total > options.feature_cap { options.feature_cap / total } else { 1.0 };
        let (i, j, delta) = (edge.i, edge.j, options.feature_huber);
        Self { edge: index, i, j, blocks, count, centre_i, centre_j, scale, delta }
    }

    fn place(&self, poses: &[Isometry3<f64>]) -> Placed {
        let centre = |node: usize, c: [f32; 3]| (poses[node] * nalgebra::Point3::from(widen(c))).coords;
        let (a, b) = (centre(self.i, self.centre_i), centre(self.j, self.centre_j));
        let relative = |node: usize, offset: Vector3<f64>| {
            Rigid::<f32>::new(&Isometry3::from_parts(Translation3::from(offset), poses[node].rotation))
        };
        Placed { centre: a, a: relative(self.i, Vector3::zeros()), b: relative(self.j, b - a) }
    }

    pub(crate) fn cost(&self, poses: &[Isometry3<f64>]) -> f64 {
        let placed = self.place(poses);
        self.scale * simd::feature_cost(&self.blocks, (&placed.a, &placed.b), self.delta as f32)
    }

    pub(crate) fn linearise(&self, poses: &[Isometry3<f64>], normal: &mut NormalEquations) -> f64 {
        let placed = self.place(poses);
        let (sums, cost) = simd::feature_sums(&self.blocks, (&placed.a, &placed.b), self.delta as f32);
        let blocks = sums.finish();
        // The sums are about the centre: lift them to the object's origin.
        let lift = lift(&Translation3::from(placed.centre).into());
        let at_origin = |h: &nalgebra::Matrix6<f64>| lift * (h * self.scale) * lift.transpose();
        let g = lift * (blocks.g * self.scale);
        normal.add(self.i, &at_origin(&blocks.ii), &g);
        normal.add(self.j, &at_origin(&blocks.jj), &-g);
        normal.add_cross(self.i, self.j, &at_origin(&blocks.ij));
        self.scale * cost
    }

    pub(crate) fn residuals(&self, poses: &[Isometry3<f64>], all: &mut Residuals) -> usize {
        let placed = self.place(poses);
        let mut inliers = 0;
        moments::for_each(&self.blocks, self.count, (&placed.a, &placed.b), |_, _, e, weight| {
            inliers += usize::from(all.add(e, self.delta, weight));
        });
        inliers
    }

    /// Adds the object-frame points of `node`.
    pub(crate) fn extent(&self, node: usize, poses: &[Isometry3<f64>], extent: &mut Extent) {
        if node != self.i && node != self.j {
            return;
        }
        let placed = self.place(poses);
        moments::for_each(&self.blocks, self.count, (&placed.a, &placed.b), |x, y, _, _| {
            let point = Vector3::from(if node == self.i { x } else { y }) + placed.centre;
            extent.add(point.into());
        });
    }
}
