//! Nearest-neighbour search in a fixed point set.

use std::num::NonZeroUsize;
use std::sync::OnceLock;

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rstar::RTree;
use rstar::primitives::GeomWithData;

/// Coordinates beyond this (metres) are data errors, and the tree keeps the largest float for itself.
const LARGEST: f64 = 1e12;

pub(crate) fn is_valid(p: &[f64; 3]) -> bool {
    p.iter().all(|c| c.abs() <= LARGEST)
}

/// Exact search over points, metres.
///
/// A kd-tree rules out what lies behind its planes. From outside of the points, in more than one axis, no plane lies
/// between the query and most of them, and it visits them all; an R*-tree measures to the boxes around its points, and
/// rules out all but those that face the query. Near the points the kd-tree is several times as fast.
pub(crate) struct PointIndex {
    near: ImmutableKdTree<f64, 3>,
    /// Made when the first query from afar comes.
    far: OnceLock<RTree<GeomWithData<[f64; 3], usize>>>,
    points: Vec<[f64; 3]>,
    low: [f64; 3],
    high: [f64; 3],
    /// Queries farther outside of the box than this (metres, squared) are from afar.
    reach: f64,
}

impl PointIndex {
    /// `None` without points, or with one that is not finite.
    pub(crate) fn new(points: &[[f64; 3]]) -> Option<Self> {
        /// Of the box's diagonal.
        const REACH: f64 = 0.25;
        if points.is_empty() || !points.iter().all(is_valid) {
            return None;
        }
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for p in points {
            for k in 0..3 {
                low[k] = low[k].min(p[k]);
                high[k] = high[k].max(p[k]);
            }
        }
        let reach = (0..3).map(|k| (REACH * (high[k] - low[k])).powi(2)).sum();
        let near = ImmutableKdTree::new_from_slice(points).ok()?;
        Some(Self { near, far: OnceLock::new(), points: points.to_vec(), low, high, reach })
    }

    /// Index and distance (metres) of the nearest point; `None` when `p` is not finite.
    #[inline]
    pub(crate) fn nearest(&self, p: &[f64; 3]) -> Option<(usize, f64)> {
        if !is_valid(p) {
            return None;
        }
        if self.outside(p) > self.reach {
            return self.nearest_from_afar(p);
        }
        let hit = self.near.query(p).nearest_one::<SquaredEuclidean<f64>>().execute();
        Some((hit.item as usize, hit.distance.sqrt()))
    }

    /// Squared distance (metres) to the box around the points.
    fn outside(&self, p: &[f64; 3]) -> f64 {
        (0..3).map(|k| (self.low[k] - p[k]).max(p[k] - self.high[k]).max(0.0).powi(2)).sum()
    }

    fn nearest_from_afar(&self, p: &[f64; 3]) -> Option<(usize, f64)> {
        let far = self.far.get_or_init(|| {
            let numbered = self.points.iter().enumerate().map(|(i, p)| GeomWithData::new(*p, i));
            RTree::bulk_load(numbered.collect())
        });
        let hit = far.nearest_neighbor(*p)?;
        let squared: f64 = hit.geom().iter().zip(p).map(|(a, b)| (a - b).powi(2)).sum();
        Some((hit.data, squared.sqrt()))
    }

    /// The same, of the points not farther away than `radius` (metres).
    pub(crate) fn nearest_within(&self, p: &[f64; 3], radius: f64) -> Option<(usize, f64)> {
        let squared = radius * radius;
        if !is_valid(p) || self.outside(p) > squared {
            return None;
        }
        let hits = self
            .near
            .query(p)
            .nearest_n::<SquaredEuclidean<f64>>(NonZeroUsize::MIN)
            .within::<SquaredEuclidean<f64>>(squared)
            .execute();
        hits.first().map(|hit| (hit.item as usize, hit.distance.sqrt()))
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

#[cfg(test)]
mod tests {
    use super::*;

    /// An ellipsoid, 10 cm by 10 cm by 18 cm.
    fn shell(count: usize) -> Vec<[f64; 3]> {
        let point = |i: usize| {
            let z = 1.0 - 2.0 * (i as f64 + 0.5) / count as f64;
            let (r, angle) = ((1.0 - z * z).sqrt(), i as f64 * 2.4);
            [0.05 * r * angle.cos(), 0.05 * r * angle.sin(), 0.09 * z]
        };
        (0..count).map(point).collect()
    }

    fn by_definition(p: &[f64; 3], points: &[[f64; 3]]) -> f64 {
        let squared = |q: &[f64; 3]| (0..3).map(|k| (p[k] - q[k]).powi(2)).sum::<f64>();
        points.iter().map(squared).fold(f64::INFINITY, f64::min).sqrt()
    }

    #[test]
    fn the_nearest_point_is_found_from_any_distance() {
        let points = shell(3_000);
        let index = PointIndex::new(&points).unwrap();
        for shift in [0.0, 0.01, 0.03, 0.06, 0.2, 3.0, 7e3] {
            for p in points.iter().step_by(37).map(|p| [p[0] + shift, p[1] - 0.7 * shift, p[2] + 0.4 * shift])
            {
                let (i, distance) = index.nearest(&p).unwrap();
                let expected = by_definition(&p, &points);
                assert!((distance - expected).abs() <= 1e-14 + 1e-15 * expected, "{shift}");
                assert!((by_definition(&p, &points[i..=i]) - distance).abs() <= 1e-14 + 1e-15 * distance);
                let within = index.nearest_within(&p, 0.02).map(|n| n.1);
                assert_eq!(within, Some(distance).filter(|d| *d <= 0.02), "{shift}");
            }
        }
    }

    /// A track that was lost metres away costs ADD-S a search from there for each point of the model.
    #[test]
    fn queries_from_afar_go_by_boxes_and_others_by_planes() {
        let points = shell(3_000);
        let index = PointIndex::new(&points).unwrap();
        for p in points.iter().map(|p| p.map(|c| c + 0.02)) {
            index.nearest(&p).unwrap();
        }
        assert!(index.far.get().is_none());
        index.nearest(&[60.0, 40.0, -3.0]).unwrap();
        assert!(index.far.get().is_some());
    }
}
