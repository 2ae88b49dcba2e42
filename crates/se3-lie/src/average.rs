//! Means of rotations and poses.

use crate::so3;
use nalgebra::{
    Isometry3, Matrix4, Quaternion, RealField, Translation3, UnitQuaternion, Vector3, Vector4, convert,
};

/// Steps after which the intrinsic mean is taken as it is; three or four are usual.
const MAX_STEPS: usize = 50;

/// Intrinsic (Karcher) mean of rotations: the one with the least weighted sum of squared geodesic distances.
///
/// Starts at the chordal mean of Markley et al. 2007 and repeats the tangent-space mean (Manton 2004).
/// `weights` (one a rotation, finite, not negative) default to 1. `None`: nothing to average, lengths that
/// differ, weights that sum to zero, or a value that is not finite.
pub fn rotation_mean<T: RealField + Copy>(
    rotations: &[UnitQuaternion<T>],
    weights: Option<&[T]>,
) -> Option<UnitQuaternion<T>> {
    intrinsic_mean(rotations.iter().copied(), rotations.len(), weights)
}

/// Mean of poses: intrinsic mean of the rotations, arithmetic mean of the translations.
///
/// SE(3) has no distance that is invariant on both sides; this is the mean of SO(3) × R³, which does not
/// depend on the choice of the world frame. Weights and `None` as in [`rotation_mean`].
pub fn pose_mean<T: RealField + Copy>(poses: &[Isometry3<T>], weights: Option<&[T]>) -> Option<Isometry3<T>> {
    let rotation = intrinsic_mean(poses.iter().map(|p| p.rotation), poses.len(), weights)?;
    let (mut sum, mut total) = (Vector3::zeros(), T::zero());
    for (i, pose) in poses.iter().enumerate() {
        let w = weight(weights, i);
        sum += pose.translation.vector * w;
        total += w;
    }
    let mean = sum / total;
    mean.iter().all(|c| c.is_finite()).then(|| Isometry3::from_parts(Translation3::from(mean), rotation))
}

fn weight<T: RealField + Copy>(weights: Option<&[T]>, i: usize) -> T {
    weights.and_then(|w| w.get(i).copied()).unwrap_or_else(T::one)
}

fn intrinsic_mean<T, I>(rotations: I, count: usize, weights: Option<&[T]>) -> Option<UnitQuaternion<T>>
where
    T: RealField + Copy,
    I: Iterator<Item = UnitQuaternion<T>> + Clone,
{
    if count == 0 || weights.is_some_and(|w| w.len() != count || w.iter().any(|x| *x < T::zero())) {
        return None;
    }
    let (mut outer, mut total) = (Matrix4::zeros(), T::zero());
    for (i, q) in rotations.clone().enumerate() {
        let v: Vector4<T> = q.coords;
        let w = weight(weights, i);
        outer += v * (v * w).transpose();
        total += w;
    }
    if total <= T::zero() || outer.iter().any(|x| !x.is_finite()) {
        return None;
    }
    let eigen = (outer / total).try_symmetric_eigen(T::default_epsilon(), 100)?;
    let start = eigen.eigenvectors.column(eigen.eigenvalues.imax()).into_owned();
    let mut mean = UnitQuaternion::from_quaternion(Quaternion::from(start));

    let tolerance = T::default_epsilon() * convert(8.0);
    for _ in 0..MAX_STEPS {
        let mut step = Vector3::zeros();
        for (i, q) in rotations.clone().enumerate() {
            step += so3::log(&(mean.inverse() * q)) * (weight(weights, i) / total);
        }
        mean = UnitQuaternion::from_quaternion((mean * so3::exp(&step)).into_inner());
        if step.norm() <= tolerance {
            break;
        }
    }
    mean.coords.iter().all(|c| c.is_finite()).then_some(mean)
}
