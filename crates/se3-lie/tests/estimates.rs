//! Alignment and averaging against known motions, and their degenerate inputs.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use proptest::prelude::*;
use se3_lie::align::rigid_alignment;
use se3_lie::average::{pose_mean, rotation_mean};
use se3_lie::nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3, Vector6};
use se3_lie::{distance, se3, so3};

fn motion() -> impl Strategy<Value = Isometry3<f64>> {
    proptest::array::uniform6(-3.0..3.0_f64).prop_map(|x| se3::exp(&Vector6::from(x)))
}

fn points(n: std::ops::Range<usize>) -> impl Strategy<Value = Vec<Point3<f64>>> {
    proptest::collection::vec(proptest::array::uniform3(-0.2..0.2_f64).prop_map(Point3::from), n)
}

/// Twice the area of the largest triangle: how far the points are from a line.
fn largest_triangle(p: &[Point3<f64>]) -> f64 {
    let mut best = 0.0_f64;
    for i in 0..p.len() {
        for j in 0..i {
            best = best.max((p[i] - p[0]).cross(&(p[j] - p[0])).norm());
        }
    }
    best
}

fn cost(t: &Isometry3<f64>, src: &[Point3<f64>], dst: &[Point3<f64>], w: &[f64]) -> f64 {
    src.iter().zip(dst).zip(w).map(|((s, d), w)| w * (d - t * s).norm_squared()).sum()
}

proptest! {
    #[test]
    fn recovers_the_motion(truth in motion(), src in points(3..12)) {
        prop_assume!(largest_triangle(&src) > 1e-3);
        let dst: Vec<_> = src.iter().map(|p| truth * p).collect();
        let found = rigid_alignment(&src, &dst, None).unwrap();
        prop_assert!(distance::rotation_angle(&found.rotation, &truth.rotation) < 1e-10);
        prop_assert!(src.iter().zip(&dst).all(|(s, d)| (found * s - d).norm() < 1e-11));
    }

    #[test]
    fn recovers_the_motion_f32(truth in motion(), src in points(3..12)) {
        prop_assume!(largest_triangle(&src) > 2e-2);
        let src: Vec<Point3<f32>> = src.iter().map(|p| p.cast()).collect();
        let truth = truth.cast::<f32>();
        let dst: Vec<_> = src.iter().map(|p| truth * p).collect();
        let found = rigid_alignment(&src, &dst, None).unwrap();
        prop_assert!(src.iter().zip(&dst).all(|(s, d)| (found * s - d).norm() < 2e-5));
    }

    /// Least squares: no small change of the answer has a lower cost.
    #[test]
    fn is_the_minimum(src in points(6..7), dst in points(6..7), w in proptest::array::uniform6(0.1..1.0_f64)) {
        let Some(found) = rigid_alignment(&src, &dst, Some(&w)) else { return Ok(()) };
        prop_assert!((found.rotation.to_rotation_matrix().matrix().determinant() - 1.0).abs() < 1e-12);
        let best = cost(&found, &src, &dst, &w);
        for k in 0..6 {
            for h in [1e-3, -1e-3, 0.5, -0.5] {
                let mut d = Vector6::zeros();
                d[k] = h;
                prop_assert!(cost(&(se3::exp(&d) * found), &src, &dst, &w) > best - 1e-12);
            }
        }
    }

    /// Points with weight zero do not count.
    #[test]
    fn weights_select(truth in motion(), src in points(4..8), outlier in motion()) {
        prop_assume!(largest_triangle(&src) > 1e-3);
        let mut dst: Vec<_> = src.iter().map(|p| truth * p).collect();
        let mut weights = vec![0.7; src.len()];
        let mut src = src;
        src.push(Point3::new(1.0, 2.0, 3.0));
        dst.push(outlier * Point3::new(-4.0, 0.0, 1.0));
        weights.push(0.0);
        let found = rigid_alignment(&src, &dst, Some(&weights)).unwrap();
        prop_assert!(distance::rotation_angle(&found.rotation, &truth.rotation) < 1e-9);
    }

    #[test]
    fn mean_of_symmetric_perturbations_is_the_centre(centre in motion(), d in proptest::array::uniform6(-0.8..0.8_f64)) {
        let d = Vector6::from(d);
        let (rho, phi) = (Vector3::new(d[0], d[1], d[2]), Vector3::new(d[3], d[4], d[5]));
        let shifted = |s: f64| Isometry3::from_parts(
            (centre.translation.vector + rho * s).into(),
            centre.rotation * so3::exp(&(phi * s)),
        );
        // The double cover must not matter.
        let mut second = shifted(-1.0);
        second.rotation = UnitQuaternion::new_unchecked(-second.rotation.into_inner());
        let mean = pose_mean(&[shifted(1.0), second, centre], None).unwrap();
        prop_assert!(distance::rotation_angle(&mean.rotation, &centre.rotation) < 1e-12);
        prop_assert!((mean.translation.vector - centre.translation.vector).norm() < 1e-12);
        // A weight of 3 to 1 lies a quarter of the way.
        let weighted = pose_mean(&[centre, shifted(1.0)], Some(&[3.0, 1.0])).unwrap();
        let expected = shifted(0.25);
        prop_assert!(distance::rotation_angle(&weighted.rotation, &expected.rotation) < 1e-12);
        prop_assert!((weighted.translation.vector - expected.translation.vector).norm() < 1e-12);
    }

    /// The mean is where the weighted logarithms cancel, wherever the rotations lie within a half-radius.
    #[test]
    fn mean_is_stationary(base in motion(), ds in proptest::collection::vec(proptest::array::uniform3(-0.7..0.7_f64), 2..8)) {
        let rotations: Vec<_> = ds.iter().map(|d| base.rotation * so3::exp(&Vector3::from(*d))).collect();
        let mean = rotation_mean(&rotations, None).unwrap();
        let sum: Vector3<f64> = rotations.iter().map(|q| so3::log(&(mean.inverse() * q))).sum();
        prop_assert!(sum.norm() < 1e-12 * rotations.len() as f64);
    }
}

#[test]
fn mirrored_points_still_give_a_rotation() {
    let src =
        [[0.1, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.3], [0.05, 0.06, 0.01]].map(Point3::<f64>::from);
    let dst = src.map(|p| Point3::new(-p.x, p.y, p.z));
    let found = rigid_alignment(&src, &dst, None).unwrap();
    assert!((found.rotation.to_rotation_matrix().matrix().determinant() - 1.0).abs() < 1e-12);
}

#[test]
fn undetermined_alignments_are_none() {
    let p = |x: f64, y: f64, z: f64| Point3::new(x, y, z);
    let triangle = [p(0.0, 0.0, 1.0), p(0.1, 0.0, 1.0), p(0.0, 0.1, 1.0)];
    let line = [p(0.1, 0.2, 0.3), p(0.2, 0.4, 0.6), p(0.3, 0.6, 0.9)];
    let spot = [p(0.1, 0.2, 0.7); 3];
    let nan = [p(0.0, 0.0, 1.0), p(f64::NAN, 0.0, 1.0), p(0.0, 0.1, 1.0)];
    let infinite = [p(0.0, 0.0, 1.0), p(f64::INFINITY, 0.0, 1.0), p(0.0, 0.1, 1.0)];
    assert!(rigid_alignment(&triangle, &triangle, None).is_some());
    assert!(rigid_alignment::<f64>(&[], &[], None).is_none());
    assert!(rigid_alignment(&triangle[..2], &triangle[..2], None).is_none());
    assert!(rigid_alignment(&triangle, &triangle[..2], None).is_none());
    for bad in [&line, &spot, &nan, &infinite] {
        assert!(rigid_alignment(bad, &triangle, None).is_none(), "{bad:?}");
        assert!(rigid_alignment(&triangle, bad, None).is_none(), "{bad:?}");
        assert!(rigid_alignment(bad, bad, None).is_none(), "{bad:?}");
    }
    for weights in [[0.0, 0.0, 0.0], [1.0, -1.0, 1.0], [f64::NAN, 1.0, 1.0], [1.0, 1.0, 0.0]] {
        assert!(rigid_alignment(&triangle, &triangle, Some(&weights)).is_none(), "{weights:?}");
    }
    assert!(rigid_alignment(&triangle, &triangle, Some(&[1.0])).is_none());
    // In single precision, where a line through rounded points is only nearly straight.
    let line = line.map(|p| p.cast::<f32>());
    assert!(rigid_alignment(&line, &line, None).is_none());
}

#[test]
fn empty_and_invalid_means_are_none() {
    let pose = Isometry3::<f64>::identity();
    assert!(pose_mean::<f64>(&[], None).is_none());
    assert!(rotation_mean::<f64>(&[], None).is_none());
    assert!(pose_mean(&[pose], Some(&[0.0])).is_none());
    assert!(pose_mean(&[pose], Some(&[1.0, 2.0])).is_none());
    assert!(pose_mean(&[pose], Some(&[f64::NAN])).is_none());
    assert!(pose_mean(&[pose, pose], Some(&[2.0, -1.0])).is_none());
    let nan = Isometry3::translation(f64::NAN, 0.0, 0.0);
    assert!(pose_mean(&[pose, nan], None).is_none());
    assert_eq!(pose_mean(&[pose], None).unwrap(), pose);
}
