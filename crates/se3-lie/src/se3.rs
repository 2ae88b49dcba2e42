//! Rigid motions: SE(3) and its tangent space of twists `xi = [rho; phi]`, translation first.

use crate::{series, so3};
use nalgebra::{Isometry3, Matrix3, Matrix6, RealField, Translation3, Vector3, Vector6, convert};

/// Splits a twist into its translational part `rho` and its rotational part `phi`.
fn split<T: RealField + Copy>(xi: &Vector6<T>) -> (Vector3<T>, Vector3<T>) {
    (Vector3::new(xi[0], xi[1], xi[2]), Vector3::new(xi[3], xi[4], xi[5]))
}

/// `[[diagonal, upper], [0, diagonal]]`: the shape of every 6×6 matrix here.
fn block_triangular<T: RealField + Copy>(diagonal: &Matrix3<T>, upper: &Matrix3<T>) -> Matrix6<T> {
    let mut m = Matrix6::zeros();
    m.fixed_view_mut::<3, 3>(0, 0).copy_from(diagonal);
    m.fixed_view_mut::<3, 3>(3, 3).copy_from(diagonal);
    m.fixed_view_mut::<3, 3>(0, 3).copy_from(upper);
    m
}

/// Motion reached after unit time along the constant twist `xi` (Barfoot eq. 8.33).
pub fn exp<T: RealField + Copy>(xi: &Vector6<T>) -> Isometry3<T> {
    let (rho, phi) = split(xi);
    Isometry3::from_parts(Translation3::from(so3::left_jacobian(&phi) * rho), so3::exp(&phi))
}

/// Twist of a motion, with rotation angle in `[0, π]`: the inverse of [`exp`].
pub fn log<T: RealField + Copy>(motion: &Isometry3<T>) -> Vector6<T> {
    let phi = so3::log(&motion.rotation);
    let rho = so3::left_jacobian_inverse(&phi) * motion.translation.vector;
    Vector6::new(rho.x, rho.y, rho.z, phi.x, phi.y, phi.z)
}

/// Adjoint: `motion * exp(xi) == exp(adjoint(motion) * xi) * motion` (Barfoot eq. 8.48).
pub fn adjoint<T: RealField + Copy>(motion: &Isometry3<T>) -> Matrix6<T> {
    let r = motion.rotation.to_rotation_matrix().into_inner();
    block_triangular(&r, &(so3::hat(&motion.translation.vector) * r))
}

/// Barfoot's `Q_l(xi)` (eq. 8.91), the coupling of rotation into translation in the left Jacobian.
fn left_q<T: RealField + Copy>(rho: &Vector3<T>, phi: &Vector3<T>) -> Matrix3<T> {
    let theta2 = phi.norm_squared();
    let (p, f) = (so3::hat(rho), so3::hat(phi));
    let (fp, pf) = (f * p, p * f);
    let fpf = fp * f;
    p * convert::<f64, T>(0.5)
        + (fp + pf + fpf) * series::theta_minus_sin(theta2)
        + (f * fp + pf * f - fpf * convert::<f64, T>(3.0)) * series::barfoot_third(theta2)
        + (fpf * f + f * fpf) * series::barfoot_fourth(theta2)
}

/// Left Jacobian `J_l(xi)`: `exp(xi + d) ≈ exp(J_l d) exp(xi)` (Barfoot eq. 8.90).
pub fn left_jacobian<T: RealField + Copy>(xi: &Vector6<T>) -> Matrix6<T> {
    let (rho, phi) = split(xi);
    block_triangular(&so3::left_jacobian(&phi), &left_q(&rho, &phi))
}

/// Inverse of [`left_jacobian`] (Barfoot eq. 8.95): `log(exp(d) exp(xi)) ≈ xi + J_l⁻¹ d`.
/// Singular at `|phi| = 2π`.
pub fn left_jacobian_inverse<T: RealField + Copy>(xi: &Vector6<T>) -> Matrix6<T> {
    let (rho, phi) = split(xi);
    let j = so3::left_jacobian_inverse(&phi);
    block_triangular(&j, &(-(j * left_q(&rho, &phi) * j)))
}

/// Right Jacobian `J_r(xi) = J_l(-xi)`: `exp(xi + d) ≈ exp(xi) exp(J_r d)`.
pub fn right_jacobian<T: RealField + Copy>(xi: &Vector6<T>) -> Matrix6<T> {
    left_jacobian(&-xi)
}

/// Inverse of [`right_jacobian`]: `log(exp(xi) exp(d)) ≈ xi + J_r⁻¹ d`.
pub fn right_jacobian_inverse<T: RealField + Copy>(xi: &Vector6<T>) -> Matrix6<T> {
    left_jacobian_inverse(&-xi)
}
