//! A pose as the very numbers it is made of: a text or a matrix would round it.

use nalgebra::{Isometry3, Quaternion, Translation3, Unit};

/// Translation, then the quaternion's i, j, k, w.
pub(crate) type PoseBits = [f64; 7];

pub(crate) fn bits(pose: &Isometry3<f64>) -> PoseBits {
    let (t, q) = (pose.translation.vector, pose.rotation.coords);
    [t.x, t.y, t.z, q.x, q.y, q.z, q.w]
}

pub(crate) fn pose([x, y, z, i, j, k, w]: PoseBits) -> Isometry3<f64> {
    Isometry3::from_parts(Translation3::new(x, y, z), Unit::new_unchecked(Quaternion::new(w, i, j, k)))
}
