//! Does a pose explain the depth? Compares two observations under their poses.

use nalgebra::{Isometry3, Point3, Vector3};

use crate::observation::Observation;

/// How well the surface of one observation agrees with another's depth.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Agreement {
    /// Points that face the other camera and fall on its object with depth.
    pub(crate) overlap: usize,
    /// Share of those whose depth agrees.
    pub(crate) inlier_share: f64,
}

impl Agreement {
    /// With less common surface than this (sample points) the depth says nothing for or against.
    const MIN_OVERLAP: usize = 20;

    /// The share of agreement, where enough could be compared to say so.
    pub(crate) fn known_share(&self) -> Option<f64> {
        (self.overlap >= Self::MIN_OVERLAP).then_some(self.inlier_share)
    }
}

/// Projects `from`'s sample points into `to` (`to_from` maps camera to camera) and compares depth: within `tolerance`
/// metres counts as agreement.
pub(crate) fn depth_agreement(
    from: &Observation,
    to: &Observation,
    to_from: &Isometry3<f64>,
    tolerance: f64,
) -> Agreement {
    const FACING: f64 = 0.35;
    let (mut overlap, mut inliers) = (0, 0);
    for (p, n) in &from.samples {
        let q = (to_from * Point3::from(*p).cast::<f64>()).coords;
        let n = to_from.rotation * Vector3::from(*n).cast::<f64>();
        if -n.dot(&q) < FACING * q.norm() {
            continue;
        }
        let Some([u, v]) = to.intrinsics.project(q.into()) else { continue };
        if u < 0.0 || v < 0.0 {
            continue;
        }
        let Some(seen) = to.points.get((u + 0.5) as usize, (v + 0.5) as usize).filter(|s| s[2] > 0.0) else {
            continue;
        };
        overlap += 1;
        inliers += usize::from((f64::from(seen[2]) - q.z).abs() < tolerance);
    }
    Agreement { overlap, inlier_share: if overlap == 0 { 0.0 } else { inliers as f64 / overlap as f64 } }
}
