//! Feature term: distances of matched points (eq. `L_f`).

use nalgebra::{Isometry3, Translation3, Vector3};

use crate::graph::FeatureEdge;
use crate::jacobian::lift;
use crate::lanes::LANES;
use crate::moments::Block;
use crate::normal::PairBlocks;
use crate::options::SolveOptions;
use crate::simd;
use crate::stats::Tally;
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
        let pairs = edge.points_i.iter().zip(&edge.points_j).enumerate();
        let usable = pairs.filter_map(|(k, (&p, &q))| {
            let w = edge.weights.get(k).copied().unwrap_or(1.0);
            (is_finite(&p) && is_finite(&q) && w.is_finite() && w > 0.0).then_some((p, q, w))
        });
        let mut blocks = Vec::with_capacity(edge.points_i.len().div_ceil(LANES));
        let (mut count, mut total) = (0, 0.0);
        // Any of the points is as near to the others as single precision needs.
        let (mut centre_i, mut centre_j) = ([0.0; 3], [0.0; 3]);
        for (p, q, w) in usable {
            if count == 0 {
                (centre_i, centre_j) = (p, q);
            }
            if count % LANES == 0 {
                blocks.push(Block::default());
            }
            blocks[count / LANES].set_lane(count % LANES, (p, centre_i), (q, centre_j), w);
            total += f64::from(w);
            count += 1;
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

    pub(crate) fn linearise(&self, poses: &[Isometry3<f64>]) -> PairBlocks {
        let placed = self.place(poses);
        let (sums, cost) = simd::feature_sums(&self.blocks, (&placed.a, &placed.b), self.delta as f32);
        let (h, g) = sums.finish();
        // The sums are about the centre: lift them to the object's origin.
        let lift = lift(&Translation3::from(placed.centre).into());
        let h = lift * (h * self.scale) * lift.transpose();
        let (nodes, g, cost) = ((self.i, self.j), lift * (g * self.scale), self.scale * cost);
        PairBlocks { nodes, h, g, cost, noise: 0.0 }
    }

    pub(crate) fn tally(&self, poses: &[Isometry3<f64>]) -> Tally {
        let placed = self.place(poses);
        simd::feature_tally(&self.blocks, (&placed.a, &placed.b), self.delta as f32)
    }

    /// The points of `node` in its camera's frame; none if it takes no part.
    pub(crate) fn points(&self, node: usize) -> impl Iterator<Item = [f32; 3]> {
        let centre = if node == self.i { self.centre_i } else { self.centre_j };
        let count = if node == self.i || node == self.j { self.count } else { 0 };
        let point = move |k: usize| self.blocks[k / LANES].point(k % LANES, node == self.i, centre);
        (0..count).map(point)
    }
}
