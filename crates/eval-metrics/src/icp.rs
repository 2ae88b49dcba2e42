//! Point-to-point registration.

use crate::nearest::PointIndex;
use nalgebra::{Isometry3, Point3};

/// When to pair points, and when to stop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct IcpOptions {
    /// Points farther apart than this (metres) are not paired.
    pub max_distance: f64,
    /// Iterations at most.
    pub max_iterations: usize,
    /// Stops when neither the paired fraction nor the root mean square distance (relative) changes by more.
    pub tolerance: f64,
}

impl Default for IcpOptions {
    /// 2 cm, 30 iterations, 1e-6: the settings of the published evaluation.
    fn default() -> Self {
        Self { max_distance: 0.02, max_iterations: 30, tolerance: 1e-6 }
    }
}

/// `target_from_source` by point-to-point ICP (Besl and McKay 1992) from the identity.
///
/// `source`, `target`: metres. Where nothing can be paired, the motion found so far is returned, at worst the
/// identity.
pub fn icp(source: &[[f64; 3]], target: &[[f64; 3]], options: &IcpOptions) -> Isometry3<f64> {
    let mut target_from_source = Isometry3::identity();
    let Some(index) = PointIndex::new(target) else { return target_from_source };
    let (mut from, mut to) = (Vec::with_capacity(source.len()), Vec::with_capacity(source.len()));
    let mut previous = (f64::INFINITY, f64::INFINITY);
    for _ in 0..options.max_iterations {
        from.clear();
        to.clear();
        let mut sum = 0.0;
        for p in source {
            let moved = target_from_source * Point3::from(*p);
            let near = index.nearest_within(&moved.into(), options.max_distance);
            let Some((i, distance)) = near else { continue };
            from.push(moved);
            to.push(Point3::from(target[i]));
            sum += distance * distance;
        }
        let Some(step) = se3_lie::align::rigid_alignment(&from, &to, None) else { break };
        target_from_source = step * target_from_source;

        let fitness = from.len() as f64 / source.len() as f64;
        let rms = (sum / from.len() as f64).sqrt();
        let settled = (fitness - previous.0).abs() <= options.tolerance
            && (rms - previous.1).abs() <= options.tolerance * rms.max(options.tolerance);
        if settled {
            break;
        }
        previous = (fitness, rms);
    }
    target_from_source
}
