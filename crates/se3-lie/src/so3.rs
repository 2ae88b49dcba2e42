//! Rotations: SO(3) and its tangent space of rotation vectors `phi` (axis times angle, radians).

use crate::series;
use nalgebra::{Matrix3, Quaternion, RealField, UnitQuaternion, Vector3, convert};

/// Cross-product matrix: `hat(v) * w == v.cross(&w)` (Barfoot's `v^`).
pub fn hat<T: RealField + Copy>(v: &Vector3<T>) -> Matrix3<T> {
    let o = T::zero();
    Matrix3::new(o, -v.z, v.y, v.z, o, -v.x, -v.y, v.x, o)
}

/// Inverse of [`hat`]; of a matrix that is not antisymmetric it takes the antisymmetric part.
pub fn vee<T: RealField + Copy>(m: &Matrix3<T>) -> Vector3<T> {
    Vector3::new(m.m32 - m.m23, m.m13 - m.m31, m.m21 - m.m12) * convert::<f64, T>(0.5)
}

/// Rotation by `|phi|` radians about `phi`.
pub fn exp<T: RealField + Copy>(phi: &Vector3<T>) -> UnitQuaternion<T> {
    let theta2 = phi.norm_squared();
    let v = phi * series::half_sinc(theta2);
    let w = (theta2.sqrt() * convert(0.5)).cos();
    UnitQuaternion::new_unchecked(Quaternion::from_parts(w, v))
}

/// Rotation vector of `q`, with angle in `[0, π]`.
///
/// `q` and `-q` give the same vector. A half turn has two; the one whose first non-zero component is positive
/// is returned.
pub fn log<T: RealField + Copy>(q: &UnitQuaternion<T>) -> Vector3<T> {
    let (mut w, mut v) = (q.scalar(), q.vector().into_owned());
    let flip = if w == T::zero() {
        v.iter().copied().find(|c| *c != T::zero()).is_some_and(|c| c < T::zero())
    } else {
        w < T::zero()
    };
    if flip {
        w = -w;
        v = -v;
    }
    let s2 = v.norm_squared();
    // Below this sine, 2 atan(s/w)/s is 2/w (1 - (s/w)²/3) to rounding, and s2 may have underflowed.
    let factor = if s2 < convert(1e-8) {
        convert::<f64, T>(2.0) / w * (T::one() - s2 / (w * w * convert(3.0)))
    } else {
        let s = s2.sqrt();
        s.atan2(w) * convert(2.0) / s
    };
    v * factor
}

/// Left Jacobian `J_l(phi)`: `exp(phi + d) ≈ exp(J_l d) exp(phi)` (Barfoot eq. 8.81).
pub fn left_jacobian<T: RealField + Copy>(phi: &Vector3<T>) -> Matrix3<T> {
    let (x, theta2) = (hat(phi), phi.norm_squared());
    Matrix3::identity() + x * series::one_minus_cos(theta2) + x * x * series::theta_minus_sin(theta2)
}

/// Inverse of [`left_jacobian`] (Barfoot eq. 8.82); singular at `|phi| = 2π`.
pub fn left_jacobian_inverse<T: RealField + Copy>(phi: &Vector3<T>) -> Matrix3<T> {
    let x = hat(phi);
    Matrix3::identity() - x * convert::<f64, T>(0.5) + x * x * series::inverse_jacobian(phi.norm_squared())
}

/// Right Jacobian `J_r(phi) = J_l(-phi)`: `exp(phi + d) ≈ exp(phi) exp(J_r d)`.
pub fn right_jacobian<T: RealField + Copy>(phi: &Vector3<T>) -> Matrix3<T> {
    left_jacobian(&-phi)
}

/// Inverse of [`right_jacobian`]; singular at `|phi| = 2π`.
pub fn right_jacobian_inverse<T: RealField + Copy>(phi: &Vector3<T>) -> Matrix3<T> {
    left_jacobian_inverse(&-phi)
}
