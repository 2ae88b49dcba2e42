//! Rigid alignment of corresponding points.

use nalgebra::{
    Isometry3, Matrix3, Matrix4, Point3, Quaternion, RealField, Translation3, UnitQuaternion, Vector3,
    convert,
};

/// The rigid motion `dst_from_src` with the least weighted sum of squares `Σ wᵢ |dstᵢ - dst_from_src srcᵢ|²`.
///
/// The problem of Arun et al. 1987 and Umeyama 1991 (without scale), solved with the unit quaternion of Horn
/// 1987, which can never be a reflection. Nothing is allocated, so it suits the 3-point samples of RANSAC.
///
/// `weights` (one a point, finite, not negative) default to 1. `None` is returned when the motion is not
/// determined: fewer than three points, all on a line or in one place, lengths that differ, or a value that is
/// not finite.
pub fn rigid_alignment<T: RealField + Copy>(
    src: &[Point3<T>],
    dst: &[Point3<T>],
    weights: Option<&[T]>,
) -> Option<Isometry3<T>> {
    let n = src.len();
    if n < 3 || dst.len() != n || weights.is_some_and(|w| w.len() != n) {
        return None;
    }
    let weight = |i: usize| weights.and_then(|w| w.get(i).copied()).unwrap_or_else(T::one);

    let (mut total, mut src_sum, mut dst_sum) = (T::zero(), Vector3::zeros(), Vector3::zeros());
    for (i, (s, d)) in src.iter().zip(dst).enumerate() {
        let w = weight(i);
        if w < T::zero() {
            return None;
        }
        total += w;
        src_sum += s.coords * w;
        dst_sum += d.coords * w;
    }
    // NaN weights fail this comparison as well.
    if total.partial_cmp(&T::zero()) != Some(std::cmp::Ordering::Greater) || !total.is_finite() {
        return None;
    }
    let (src_mean, dst_mean) = (src_sum / total, dst_sum / total);

    let (mut cov, mut src_var, mut dst_var) = (Matrix3::zeros(), T::zero(), T::zero());
    for (i, (s, d)) in src.iter().zip(dst).enumerate() {
        let (s, d) = (s.coords - src_mean, d.coords - dst_mean);
        let w = weight(i) / total;
        cov += s * (d * w).transpose();
        src_var += w * s.norm_squared();
        dst_var += w * d.norm_squared();
    }
    if !is_spread(src_var, &src_mean) || !is_spread(dst_var, &dst_mean) {
        return None;
    }
    let rotation = best_rotation(&(cov / (src_var.sqrt() * dst_var.sqrt())))?;
    let translation = dst_mean - rotation * src_mean;
    Some(Isometry3::from_parts(Translation3::from(translation), rotation))
}

/// Whether points of this variance are more than the rounding of their mean apart.
fn is_spread<T: RealField + Copy>(variance: T, mean: &Vector3<T>) -> bool {
    let rounding = T::default_epsilon() * convert(16.0) * mean.norm();
    variance.is_finite() && variance > rounding * rounding
}

/// Rotation that maximises `trace(R cov)`, by the dominant eigenvector of Horn's matrix. `cov` is
/// dimensionless, about 1.
fn best_rotation<T: RealField + Copy>(cov: &Matrix3<T>) -> Option<UnitQuaternion<T>> {
    // A non-finite matrix would never converge.
    if cov.iter().any(|c| !c.is_finite()) {
        return None;
    }
    let (sxx, sxy, sxz) = (cov.m11, cov.m12, cov.m13);
    let (syx, syy, syz) = (cov.m21, cov.m22, cov.m23);
    let (szx, szy, szz) = (cov.m31, cov.m32, cov.m33);
    let (x, y, z) = (syz - szy, szx - sxz, sxy - syx);
    #[rustfmt::skip]
    let horn = Matrix4::new(
        sxx + syy + szz, x,               y,                z,
        x,               sxx - syy - szz, sxy + syx,        szx + sxz,
        y,               sxy + syx,       -sxx + syy - szz, syz + szy,
        z,               szx + sxz,       syz + szy,        -sxx - syy + szz,
    );
    let eigen = horn.try_symmetric_eigen(T::default_epsilon(), 100)?;
    let values = &eigen.eigenvalues;
    let best = values.imax();
    let second = (0..4).filter(|&i| i != best).map(|i| values[i]).fold(values[values.imin()], T::max);
    // The gap is 2 (s2 ± s3) of the covariance's singular values: zero when the points lie on a line, or when
    // they are a mirror image with two equal extents, and then a whole circle of rotations fits equally well.
    let gap = values[best] - second;
    if gap <= T::default_epsilon() * convert(256.0) {
        return None;
    }
    let q = eigen.eigenvectors.column(best);
    Some(UnitQuaternion::from_quaternion(Quaternion::new(q[0], q[1], q[2], q[3])))
}
