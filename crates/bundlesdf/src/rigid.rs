//! Single-precision points and directions under double-precision poses.

use nalgebra::{Isometry3, Point3, Vector3};

/// A point (metres) in the frame that `pose` maps to.
pub(crate) fn moved_point(pose: &Isometry3<f64>, p: [f32; 3]) -> [f32; 3] {
    (pose * Point3::from(p).cast::<f64>()).coords.cast::<f32>().into()
}

/// A direction in the frame that `pose` maps to.
pub(crate) fn moved_vector(pose: &Isometry3<f64>, v: [f32; 3]) -> [f32; 3] {
    (pose * Vector3::from(v).cast::<f64>()).cast::<f32>().into()
}
