//! Nearest-neighbour search in a fixed point set.

use kiddo::{ImmutableKdTree, SquaredEuclidean};

/// Coordinates beyond this (metres) are data errors, and the tree keeps the largest float for itself.
const LARGEST: f64 = 1e12;

pub(crate) fn is_valid(p: &[f64; 3]) -> bool {
    p.iter().all(|c| c.abs() <= LARGEST)
}

/// A kd-tree over points, metres.
pub(crate) struct PointIndex {
    tree: ImmutableKdTree<f64, 3>,
}

impl PointIndex {
    /// `None` without points, or with one that is not finite.
    pub(crate) fn new(points: &[[f64; 3]]) -> Option<Self> {
        if points.is_empty() || !points.iter().all(is_valid) {
            return None;
        }
        ImmutableKdTree::new_from_slice(points).ok().map(|tree| Self { tree })
    }

    /// Index and distance (metres) of the nearest point; `None` when `p` is not finite.
    #[inline]
    pub(crate) fn nearest(&self, p: &[f64; 3]) -> Option<(usize, f64)> {
        if !is_valid(p) {
            return None;
        }
        let hit = self.tree.query(p).nearest_one::<SquaredEuclidean<f64>>().execute();
        Some((hit.item as usize, hit.distance.sqrt()))
    }

    /// Mean distance (metres) from `points` to their nearest neighbours. Infinite when a point is not finite,
    /// `None` without points.
    pub(crate) fn mean_distance(&self, points: &[[f64; 3]]) -> Option<f64> {
        if points.is_empty() {
            return None;
        }
        let sum: f64 = points.iter().map(|p| self.nearest(p).map_or(f64::INFINITY, |(_, d)| d)).sum();
        Some(sum / points.len() as f64)
    }
}
