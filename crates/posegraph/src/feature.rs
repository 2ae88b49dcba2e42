//! Feature term: distances of matched points (eq. `L_f`).

use crate::graph::FeatureEdge;
use crate::jacobian::{MatchSums, huber};
use crate::normal::NormalEquations;
use crate::options::SolveOptions;
use crate::stats::{Extent, Residuals};
use crate::transform::{Rigid, is_finite};

#[derive(Debug, Clone, Copy)]
struct Match {
    p: [f32; 3],
    q: [f32; 3],
    weight: f32,
}

/// The usable matches of one feature edge.
#[derive(Debug)]
pub(crate) struct FeatureTerm {
    pub(crate) edge: usize,
    pub(crate) i: usize,
    pub(crate) j: usize,
    matches: Vec<Match>,
    /// Factor on every match: term weight, 1 / variance, count cap.
    scale: f64,
    delta: f64,
}

impl FeatureTerm {
    pub(crate) fn new(index: usize, edge: &FeatureEdge, options: &SolveOptions) -> Self {
        let points = edge.points_i.iter().zip(&edge.points_j).enumerate();
        let matches: Vec<Match> = points
            .map(|(k, (&p, &q))| Match { p, q, weight: edge.weights.get(k).copied().unwrap_or(1.0) })
            .filter(|m| is_finite(&m.p) && is_finite(&m.q) && m.weight.is_finite() && m.weight > 0.0)
            .collect();
        let total: f64 = matches.iter().map(|m| f64::from(m.weight)).sum();
        let scale = options.feature_weight / (options.feature_sigma * options.feature_sigma)
            * if total > options.feature_cap { options.feature_cap / total } else { 1.0 };
        Self { edge: index, i: edge.i, j: edge.j, matches, scale, delta: options.feature_huber }
    }

    fn weighted(&self, a: &Rigid, b: &Rigid) -> impl Iterator<Item = ([f64; 3], [f64; 3], f64, f64)> {
        let (a, b) = (*a, *b);
        self.matches.iter().map(move |m| {
            let (x, y) = (a.point(m.p), b.point(m.q));
            let r = [x[0] - y[0], x[1] - y[1], x[2] - y[2]];
            (x, y, (r[0] * r[0] + r[1] * r[1] + r[2] * r[2]).sqrt(), f64::from(m.weight))
        })
    }

    pub(crate) fn cost(&self, poses: &[Rigid]) -> f64 {
        let sum: f64 = self
            .weighted(&poses[self.i], &poses[self.j])
            .map(|(_, _, e, weight)| weight * huber(e, self.delta).0)
            .sum();
        self.scale * sum
    }

    pub(crate) fn linearise(&self, poses: &[Rigid], normal: &mut NormalEquations) -> f64 {
        let mut sums = MatchSums::default();
        let mut cost = 0.0;
        for (x, y, e, weight) in self.weighted(&poses[self.i], &poses[self.j]) {
            let (rho, w) = huber(e, self.delta);
            cost += weight * rho;
            sums.add(x, y, self.scale * weight * w);
        }
        let blocks = sums.finish();
        normal.add(self.i, &blocks.ii, &blocks.g);
        normal.add(self.j, &blocks.jj, &-blocks.g);
        normal.add_cross(self.i, self.j, &blocks.ij);
        self.scale * cost
    }

    pub(crate) fn residuals(&self, poses: &[Rigid], all: &mut Residuals) -> usize {
        let mut inliers = 0;
        for (_, _, e, weight) in self.weighted(&poses[self.i], &poses[self.j]) {
            inliers += usize::from(all.add(e, self.delta, weight));
        }
        inliers
    }

    /// Adds the object-frame points of `node`.
    pub(crate) fn extent(&self, node: usize, poses: &[Rigid], extent: &mut Extent) {
        for (x, y, _, _) in self.weighted(&poses[self.i], &poses[self.j]) {
            if node == self.i {
                extent.add(x);
            } else if node == self.j {
                extent.add(y);
            }
        }
    }
}
