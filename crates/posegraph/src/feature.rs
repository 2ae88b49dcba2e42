//! Feature term: differences of matched points (eq. `L_f`), each by how well the cameras know it.

use nalgebra::{Isometry3, Translation3, Vector3};

use crate::graph::FeatureEdge;
use crate::jacobian::lift;
use crate::lanes::LANES;
use crate::normal::PairBlocks;
use crate::observability::match_doubt;
use crate::options::SolveOptions;
use crate::rays::{Block, Pair, RayNoise};
use crate::simd;
use crate::stats::Tally;
use crate::transform::{Rigid, is_finite, narrow, widen};

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
    /// Factor on every match: term weight, count cap.
    scale: f64,
    noise: RayNoise,
    /// Huber threshold and saturation, standard deviations.
    pub(crate) robust: [f32; 2],
    /// Share of the information that doesn't tell whether a motion is seen at all.
    doubt: f64,
}

impl FeatureTerm {
    pub(crate) fn new(index: usize, edge: &FeatureEdge, options: &SolveOptions) -> Self {
        let pairs = edge.points_i.iter().zip(&edge.points_j).enumerate();
        let usable = pairs.filter_map(|(k, (&p, &q))| {
            let w = edge.weights.get(k).copied().unwrap_or(1.0);
            (is_finite(&p) && is_finite(&q) && w.is_finite() && w > 0.0).then_some((p, q, w))
        });
        let mut blocks = Vec::with_capacity(edge.points_i.len().div_ceil(LANES));
        let (mut count, mut total, mut squares) = (0, 0.0, 0.0);
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
            squares += Vector3::from(widen(p)).norm_squared();
            count += 1;
        }
        let share = if total > options.feature_cap { options.feature_cap / total } else { 1.0 };
        let (i, j, scale) = (edge.i, edge.j, options.feature_weight * share);
        let (noise, robust) = (RayNoise::new(options), options.gates(usize::MAX).feature);
        let distance_squared = squares / f64::max(count as f64, 1.0);
        let doubt = match_doubt(2.0 * options.feature_angle.powi(2) * distance_squared);
        Self { edge: index, i, j, blocks, count, centre_i, centre_j, scale, noise, robust, doubt }
    }

    /// The sides of the edge about a point near the matches, and where that is.
    fn place(&self, poses: &[Isometry3<f64>]) -> (Pair, Vector3<f64>) {
        let centre = |node: usize, c: [f32; 3]| (poses[node] * nalgebra::Point3::from(widen(c))).coords;
        let (a, b) = (centre(self.i, self.centre_i), centre(self.j, self.centre_j));
        let motion = |node: usize, offset: Vector3<f64>| {
            Rigid::<f32>::new(&Isometry3::from_parts(Translation3::from(offset), poses[node].rotation))
        };
        let camera = |node: usize| narrow((poses[node].translation.vector - a).into());
        let pair = Pair {
            motions: [motion(self.i, Vector3::zeros()), motion(self.j, b - a)],
            cameras: [camera(self.i), camera(self.j)],
            noise: self.noise,
            robust: self.robust,
        };
        (pair, a)
    }

    pub(crate) fn cost(&self, poses: &[Isometry3<f64>]) -> f64 {
        self.scale * simd::feature_cost(&self.blocks, &self.place(poses).0)
    }

    pub(crate) fn linearise(&self, poses: &[Isometry3<f64>]) -> PairBlocks {
        let (pair, centre) = self.place(poses);
        let (sums, cost) = simd::feature_sums(&self.blocks, &pair);
        let (h, g) = sums.finish();
        // The sums are about the centre: lift them to the object's origin.
        let lift = lift(&Translation3::from(centre).into());
        let h = lift * (h * self.scale) * lift.transpose();
        let (nodes, g, cost) = ((self.i, self.j), lift * (g * self.scale), self.scale * cost);
        PairBlocks { nodes, h, g, cost, noise: 0.0, doubt: self.doubt }
    }

    pub(crate) fn tally(&self, poses: &[Isometry3<f64>]) -> Tally {
        simd::feature_tally(&self.blocks, &self.place(poses).0)
    }

    /// The points of `node` in its camera's frame; none if it takes no part.
    pub(crate) fn points(&self, node: usize) -> impl Iterator<Item = [f32; 3]> {
        let centre = if node == self.i { self.centre_i } else { self.centre_j };
        let count = if node == self.i || node == self.j { self.count } else { 0 };
        let point = move |k: usize| self.blocks[k / LANES].point(k % LANES, node == self.i, centre);
        (0..count).map(point)
    }
}
