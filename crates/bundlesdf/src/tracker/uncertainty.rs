//! What the measurements of a frame tell of its pose.

use nalgebra::{Matrix6, Vector3};
use posegraph::{Direction, Observability};
use serde::{Deserialize, Serialize};

/// How well a frame's pose is known.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Uncertainty {
    /// Covariance of the pose, 6 x 6: of `[rho; phi]` (metres, radians; axes of the object frame) in
    /// `obj_from_cam = exp([rho; phi]) true_obj_from_cam`, given the keyframes' poses as the pose graph had them. A
    /// motion that is not observed has the spread of the whole object.
    pub covariance: [[f64; 6]; 6],
    /// Motions of the object that neither its shape nor its texture shows well from here. Along these the pose is held
    /// where the matches alone put it or, without enough of them, where the last frame had it.
    pub held: Vec<HeldMotion>,
}

/// A motion of the object that can't be seen.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct HeldMotion {
    /// Turn or slide.
    pub kind: MotionKind,
    /// Unit vector of the axis or of the slide, object frame.
    pub direction: [f64; 3],
    /// The axis' point nearest to the origin of the object frame (metres); the origin for a slide.
    pub through: [f64; 3],
}

/// What kind of motion it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MotionKind {
    /// About an axis, as a can.
    Turn,
    /// Along a direction, as a sheet.
    Slide,
}

impl Uncertainty {
    pub(super) fn of(observability: &Observability) -> Self {
        let covariance: Matrix6<f64> = observability.covariance();
        let covariance = std::array::from_fn(|r| std::array::from_fn(|c| covariance[(r, c)]));
        Self { covariance, held: observability.held().map(|d| HeldMotion::of(d, observability)).collect() }
    }
}

impl HeldMotion {
    /// For reports: three decimals.
    pub(crate) fn rounded(&self) -> Self {
        let round = |v: [f64; 3]| v.map(|x| (x * 1e3).round() / 1e3);
        Self { direction: round(self.direction), through: round(self.through), ..*self }
    }

    fn of(direction: &Direction, observability: &Observability) -> Self {
        let rho: Vector3<f64> = direction.twist.fixed_rows::<3>(0).into();
        let phi: Vector3<f64> = direction.twist.fixed_rows::<3>(3).into();
        let of_centre = rho + phi.cross(&observability.centre);
        if phi.norm() * observability.radius >= of_centre.norm() {
            let through = phi.cross(&rho) / phi.norm_squared();
            Self { kind: MotionKind::Turn, direction: phi.normalize().into(), through: through.into() }
        } else {
            Self { kind: MotionKind::Slide, direction: of_centre.normalize().into(), through: [0.0; 3] }
        }
    }
}
