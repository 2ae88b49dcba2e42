//! Can all six motions of the object be seen?
//!
//! Depth alone leaves motions open that map the surface onto itself: the slippable motions of Gelfand and Guibas
//! (*Shape segmentation using local slippage analysis*, SGP 2004), the small eigenvalues of the point-to-plane
//! Hessian. Texture closes them; with neither, the pose along such a motion is a guess.

use nalgebra::{Matrix6, Vector3, Vector6};
use serde::{Deserialize, Serialize};

use super::{Notice, WarningKind};
use crate::{
    observation::Observation,
    tracker::{FrameResult, Tracker},
};

/// Keyframes that are looked at.
const LOOKED_AT: usize = 5;
/// Corners below which texture holds nothing.
const CORNERS: usize = 50;
/// Root of the smallest over the largest eigenvalue below which the surface slides along itself.
const SLIPPERY: f64 = 0.125;

/// How many keyframes were looked at.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct Observability {
    looked: usize,
}

impl Observability {
    pub(super) fn check(&mut self, result: &FrameResult, tracker: &Tracker) -> Option<Notice> {
        if !result.keyframe || self.looked >= LOOKED_AT {
            return None;
        }
        self.looked += 1;
        let observation = &tracker.pool().get(result.index)?.observation;
        let corners = observation.corners(tracker.settings().0.coarse.max_corners).len();
        let held = stiffness(observation)?;
        tracing::debug!(corners, held, "observability");
        (corners < CORNERS && held < SLIPPERY).then(|| Notice {
            kind: WarningKind::UnobservableMotion,
            patience: 2,
            message: format!(
                "the object has hardly any texture ({corners} corners) and a shape that looks the same when moved"
            ),
            remedy: "its pose along that motion is a guess: stick a few printed labels on the object, or hold it so \
                     that a handle or a corner stays in view",
        })
    }
}

/// Root of the smallest over the largest eigenvalue of the point-to-plane Hessian of the seen surface, in units of
/// its size: 0 = some motion can't be seen at all. `None` without surface.
fn stiffness(observation: &Observation) -> Option<f64> {
    let samples = &observation.samples;
    let count = samples.len() as f64;
    if samples.len() < 50 {
        return None;
    }
    let points: Vec<Vector3<f64>> = samples.iter().map(|(p, _)| Vector3::from(*p).cast()).collect();
    let middle = points.iter().sum::<Vector3<f64>>() / count;
    let size = (points.iter().map(|p| (p - middle).norm_squared()).sum::<f64>() / count).sqrt();
    let mut hessian = Matrix6::zeros();
    for (point, (_, normal)) in points.iter().zip(samples) {
        let normal: Vector3<f64> = Vector3::from(*normal).cast();
        let turn = ((point - middle) / size).cross(&normal);
        let row = Vector6::new(normal.x, normal.y, normal.z, turn.x, turn.y, turn.z);
        hessian += row * row.transpose();
    }
    let eigenvalues = hessian.symmetric_eigenvalues();
    let (low, high) = (eigenvalues.min(), eigenvalues.max());
    (high > 0.0 && low.is_finite()).then(|| (low.max(0.0) / high).sqrt())
}
