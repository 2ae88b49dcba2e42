//! Angles between rotations.

use nalgebra::{RealField, UnitQuaternion, Vector3, convert};

/// Geodesic distance of two rotations: the angle, in `[0, π]` radians, of the rotation between them.
pub fn rotation_angle<T: RealField + Copy>(a: &UnitQuaternion<T>, b: &UnitQuaternion<T>) -> T {
    let between = a.inverse() * b;
    between.vector().norm().atan2(between.scalar().abs()) * convert(2.0)
}

/// Angle, in `[0, π]` radians, between the optical axes (z) of two cameras, seen from the object.
///
/// This is how far the *view of the object* has changed: rolling the camera about its axis shows the same
/// surface and gives 0, tilting it by an angle gives that angle. It is the distance of two views for choosing
/// keyframes (the paper's "geodesic distance ignoring in-plane rotation").
pub fn swing_angle<T: RealField + Copy>(obj_from_a: &UnitQuaternion<T>, obj_from_b: &UnitQuaternion<T>) -> T {
    let (a, b) = (obj_from_a * Vector3::z(), obj_from_b * Vector3::z());
    // acos of the dot product would lose half of the digits of a small angle.
    a.cross(&b).norm().atan2(a.dot(&b))
}
