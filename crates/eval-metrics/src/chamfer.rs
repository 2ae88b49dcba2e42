//! Distance between two point sets.

use crate::nearest::PointIndex;

/// Both directions of the chamfer distance, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Chamfer {
    /// Mean distance from the first set to the second: how accurate the first is, if the second is the truth.
    pub forward: f64,
    /// Mean distance from the second set to the first: how complete the first is.
    pub backward: f64,
}

impl Chamfer {
    /// Between point sets in metres; `None` when one is empty or has a point that is not finite.
    pub fn between(a: &[[f64; 3]], b: &[[f64; 3]]) -> Option<Self> {
        let (index_a, index_b) = (PointIndex::new(a)?, PointIndex::new(b)?);
        Some(Self { forward: index_b.mean_distance(a)?, backward: index_a.mean_distance(b)? })
    }

    /// The mean of both directions (paper supplement, `d_CD`).
    pub fn distance(&self) -> f64 {
        0.5 * (self.forward + self.backward)
    }
}

/// Symmetric chamfer distance (metres): half the mean nearest-neighbour distance from `a` to `b` plus half of
/// that from `b` to `a` (paper supplement). `None` when one is empty or has a point that is not finite.
pub fn chamfer_distance(a: &[[f64; 3]], b: &[[f64; 3]]) -> Option<f64> {
    Chamfer::between(a, b).map(|c| c.distance())
}
