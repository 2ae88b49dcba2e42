//! Prior term: a Gaussian on one pose.

use nalgebra::{Isometry3, Vector6};
use se3_lie::se3;

use crate::graph::PosePrior;
use crate::normal::NormalEquations;

/// `log(T * prior^-1)`.
pub(crate) fn residual(prior: &PosePrior, poses: &[Isometry3<f64>]) -> Vector6<f64> {
    se3::log(&(poses[prior.node] * prior.obj_from_cam.inverse()))
}

pub(crate) fn cost(prior: &PosePrior, poses: &[Isometry3<f64>]) -> f64 {
    let r = residual(prior, poses);
    0.5 * r.dot(&(prior.information * r))
}

pub(crate) fn linearise(prior: &PosePrior, poses: &[Isometry3<f64>], normal: &mut NormalEquations) -> f64 {
    let r = residual(prior, poses);
    // log(exp(delta) exp(r)) = r + J_l^-1(r) delta to first order.
    let jacobian = se3::left_jacobian_inverse(&r);
    let weighted = jacobian.transpose() * prior.information;
    normal.add(prior.node, &(weighted * jacobian), &(weighted * r));
    0.5 * r.dot(&(prior.information * r))
}
