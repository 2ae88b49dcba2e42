//! The rigid motion of three points.

use nalgebra::{Matrix3, Point3, Vector3};

/// A rigid motion as a matrix, `p -> rotation * p + translation`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Motion {
    pub(crate) rotation: Matrix3<f64>,
    pub(crate) translation: Vector3<f64>,
}

/// Whether two triangles can be images of each other: every edge agrees to `tolerance`, and no altitude of either is
/// below `min_altitude`. Metres.
pub(super) fn are_alike(
    a: &[Point3<f64>; 3],
    b: &[Point3<f64>; 3],
    tolerance: f64,
    min_altitude: f64,
) -> bool {
    let mut longest = [0.0_f64; 2];
    for (i, j) in [(0, 1), (1, 2), (2, 0)] {
        let (la, lb) = ((a[j] - a[i]).norm(), (b[j] - b[i]).norm());
        let difference = (la - lb).abs();
        if difference.is_nan() || difference > tolerance {
            return false;
        }
        longest = [longest[0].max(la), longest[1].max(lb)];
    }
    [a, b].into_iter().zip(longest).all(|(t, edge)| {
        let twice_area = (t[1] - t[0]).cross(&(t[2] - t[0])).norm();
        twice_area > 0.0 && twice_area >= min_altitude * edge
    })
}

/// The least-squares motion of triangle `a` to triangle `b`, exactly Kabsch's and without an SVD.
///
/// The covariance of two centred triangles is of rank two, with a positive determinant between their oriented planes
/// (Cauchy-Binet: the product of the areas). The best rotation therefore takes plane to plane, and what is left is a
/// rotation in the plane, which has a closed form.
pub(super) fn motion_of(a: &[Point3<f64>; 3], b: &[Point3<f64>; 3]) -> Option<Motion> {
    let centre = |t: &[Point3<f64>; 3]| (t[0].coords + t[1].coords + t[2].coords) / 3.0;
    let (ca, cb) = (centre(a), centre(b));
    let (fa, fb) = (frame(a)?, frame(b)?);
    let (mut cos, mut sin) = (0.0, 0.0);
    for (p, q) in a.iter().zip(b) {
        let p = fa.tr_mul(&(p.coords - ca));
        let q = fb.tr_mul(&(q.coords - cb));
        cos += p.x * q.x + p.y * q.y;
        sin += p.x * q.y - p.y * q.x;
    }
    let norm = cos.hypot(sin);
    if !(norm > 0.0 && norm.is_finite()) {
        return None;
    }
    let (cos, sin) = (cos / norm, sin / norm);
    let in_plane = Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0);
    let rotation = fb * in_plane * fa.transpose();
    Some(Motion { rotation, translation: cb - rotation * ca })
}

/// Orthonormal axes of a triangle: along its first edge, in its plane, along its normal.
fn frame(t: &[Point3<f64>; 3]) -> Option<Matrix3<f64>> {
    let first = (t[1] - t[0]).try_normalize(0.0)?;
    let normal = first.cross(&(t[2] - t[0])).try_normalize(0.0)?;
    Some(Matrix3::from_columns(&[first, normal.cross(&first), normal]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn triangle() -> impl Strategy<Value = [Point3<f64>; 3]> {
        prop::array::uniform9(-1.0_f64..1.0).prop_map(|v| {
            [Point3::new(v[0], v[1], v[2]), Point3::new(v[3], v[4], v[5]), Point3::new(v[6], v[7], v[8])]
        })
    }

    proptest! {
        #[test]
        fn the_closed_form_is_the_least_squares_alignment(a in triangle(), b in triangle()) {
            let area = |t: &[Point3<f64>; 3]| (t[1] - t[0]).cross(&(t[2] - t[0])).norm();
            prop_assume!(area(&a) > 0.05 && area(&b) > 0.05);
            let motion = motion_of(&a, &b).unwrap();
            prop_assert!((motion.rotation.determinant() - 1.0).abs() < 1e-9);
            let cost = |r: &dyn Fn(&Point3<f64>) -> Point3<f64>| {
                a.iter().zip(&b).map(|(p, q)| (r(p) - q).norm_squared()).sum::<f64>()
            };
            let own = cost(&|p| Point3::from(motion.rotation * p.coords + motion.translation));
            let best = se3_lie::align::rigid_alignment(&a, &b, None).unwrap();
            let reference = cost(&|p| best * p);
            prop_assert!((own - reference).abs() < 1e-8, "{own} {reference}");
        }
    }

    #[test]
    fn degenerate_triangles_are_refused() {
        let point = |x: f64| Point3::new(x, 2.0 * x, -x);
        let line = [point(0.0), point(1.0), point(2.0)];
        let fair = [Point3::origin(), Point3::new(1.0, 0.0, 0.0), Point3::new(0.0, 1.0, 0.0)];
        assert!(!are_alike(&line, &line, 0.1, 1e-6));
        assert!(!are_alike(&[Point3::origin(); 3], &[Point3::origin(); 3], 0.1, 0.0));
        assert!(are_alike(&fair, &fair, 0.1, 0.5));
        assert!(!are_alike(&fair, &fair, 0.1, 0.8));
        let longer = fair.map(|p| p * 1.2);
        assert!(!are_alike(&fair, &longer, 0.1, 0.1) && are_alike(&fair, &longer, 0.5, 0.1));
        assert!(!are_alike(&fair, &fair.map(|p| p * f64::NAN), 0.1, 0.1));
        assert!(motion_of(&[Point3::origin(); 3], &fair).is_none());
    }
}
