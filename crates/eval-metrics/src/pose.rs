//! Errors of single poses, and the alignment of two object frames.

use crate::MeshRef;
use crate::nearest::PointIndex;
use crate::sampling::{sample_surface, thin};
use nalgebra::{Isometry3, Point3};

/// Points of the object's true model in the object frame (metres), with a kd-tree over them.
pub struct ModelPoints {
    points: Vec<[f64; 3]>,
    index: PointIndex,
}

impl std::fmt::Debug for ModelPoints {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ModelPoints").field("points", &self.points.len()).finish_non_exhaustive()
    }
}

impl ModelPoints {
    /// Fewer vertices than this do not stand for a surface; [`Self::from_mesh`] samples it instead.
    const ENOUGH: usize = 500;

    /// `None` without points, or with one that is not finite.
    pub fn new(points: Vec<[f64; 3]>) -> Option<Self> {
        let index = PointIndex::new(&points)?;
        Some(Self { points, index })
    }

    /// The vertices of a mesh, as the published evaluations use them. A mesh of few large triangles (a box)
    /// is sampled at 5 mm instead: with eight corners ADD-S would measure nothing.
    pub fn from_mesh(mesh: MeshRef<'_>) -> Option<Self> {
        if mesh.vertices.len() >= Self::ENOUGH {
            return Self::new(mesh.vertices.to_vec());
        }
        Self::new(thin(&sample_surface(mesh, 50_000, 0), 0.005))
    }

    /// The points, metres, in the object frame.
    pub fn points(&self) -> &[[f64; 3]] {
        &self.points
    }
}

/// ADD: mean distance (metres) between the model's points under the two poses (paper supplement).
/// Infinite when a pose is not finite.
pub fn add(pred: &Isometry3<f64>, gt: &Isometry3<f64>, model: &ModelPoints) -> f64 {
    let sum: f64 =
        model.points.iter().map(|p| (pred * Point3::from(*p) - gt * Point3::from(*p)).norm()).sum();
    finite_or_infinite(sum / model.points.len() as f64)
}

/// ADD-S: mean over the model's points under the true pose of the distance (metres) to the nearest point of
/// the model under the predicted pose (paper supplement). Infinite when a pose is not finite.
pub fn add_s(pred: &Isometry3<f64>, gt: &Isometry3<f64>, model: &ModelPoints) -> f64 {
    // Distances are the same in the predicted object frame, where the model does not move.
    let pred_from_gt = pred.inverse() * gt;
    let sum: f64 = model
        .points
        .iter()
        .map(|p| {
            model.index.nearest(&(pred_from_gt * Point3::from(*p)).into()).map_or(f64::INFINITY, |n| n.1)
        })
        .sum();
    sum / model.points.len() as f64
}

fn finite_or_infinite(error: f64) -> f64 {
    if error.is_finite() { error } else { f64::INFINITY }
}

/// Geodesic angle (radians) between the rotations of two poses.
pub fn rotation_error(pred: &Isometry3<f64>, gt: &Isometry3<f64>) -> f64 {
    se3_lie::distance::rotation_angle(&pred.rotation, &gt.rotation)
}

/// Distance (metres) between the object origins of two `cam_from_obj` poses.
pub fn translation_error(pred: &Isometry3<f64>, gt: &Isometry3<f64>) -> f64 {
    (pred.translation.vector - gt.translation.vector).norm()
}

pub(crate) fn is_finite(pose: &Isometry3<f64>) -> bool {
    pose.translation.vector.iter().chain(pose.rotation.coords.iter()).all(|c| c.is_finite())
}

/// `pred_obj_from_gt_obj`: what the tracker's object frame is to the true one, taken at the first frame with a
/// true pose, `P_f⁻¹ G_f`. Later frames stand in only while the prediction of that frame is missing.
///
/// `pred`, `gt`: `cam_from_obj` per frame. `None` when no frame has both.
pub fn alignment(pred: &[Option<Isometry3<f64>>], gt: &[Option<Isometry3<f64>>]) -> Option<Isometry3<f64>> {
    pred.iter().zip(gt).find_map(|(p, g)| match (p, g) {
        (Some(p), Some(g)) if is_finite(p) && is_finite(g) => Some(p.inverse() * g),
        _ => None,
    })
}

/// The predicted poses with the true object frame, `P_i P_f⁻¹ G_f` (see [`alignment`]).
///
/// As long as `pred`; `None` where `pred` is, and everywhere when no frame has both poses.
pub fn rebase(pred: &[Option<Isometry3<f64>>], gt: &[Option<Isometry3<f64>>]) -> Vec<Option<Isometry3<f64>>> {
    let pred_obj_from_gt_obj = alignment(pred, gt);
    pred.iter().map(|p| Some((*p)? * pred_obj_from_gt_obj?)).collect()
}
