//! Group laws and Jacobians, for random motions including tiny and half-turn rotations.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use proptest::prelude::*;
use se3_lie::nalgebra::{Isometry3, Matrix3, Matrix6, Point3, UnitQuaternion, Vector3, Vector6};
use se3_lie::{distance, se3, so3};
use std::f64::consts::PI;

fn unit_vector() -> impl Strategy<Value = Vector3<f64>> {
    (-1.0..1.0_f64, 0.0..2.0 * PI).prop_map(|(z, a)| {
        let r = (1.0 - z * z).sqrt();
        Vector3::new(r * a.cos(), r * a.sin(), z)
    })
}

/// Angles of every size: from 1e-12 up to just below π, with the ends well covered.
fn angle() -> impl Strategy<Value = f64> {
    prop_oneof![
        3 => 0.0..PI - 1e-6,
        2 => (-12.0..0.0_f64).prop_map(|e| 10f64.powf(e)),
        1 => (-12.0..0.0_f64).prop_map(|e| PI - 10f64.powf(e)),
        1 => Just(0.0),
    ]
}

fn rotation_vector() -> impl Strategy<Value = Vector3<f64>> {
    (unit_vector(), angle()).prop_map(|(axis, theta)| axis * theta)
}

fn twist() -> impl Strategy<Value = Vector6<f64>> {
    (unit_vector(), 0.0..3.0_f64, rotation_vector()).prop_map(|(t, length, phi)| {
        Vector6::new(t.x * length, t.y * length, t.z * length, phi.x, phi.y, phi.z)
    })
}

fn motion_distance(a: &Isometry3<f64>, b: &Isometry3<f64>) -> f64 {
    (a.to_homogeneous() - b.to_homogeneous()).norm()
}

/// Central differences of `f` at zero, one column per tangent direction.
fn differentiate(f: impl Fn(&Vector6<f64>) -> Vector6<f64>) -> Matrix6<f64> {
    const H: f64 = 1e-4;
    let mut m = Matrix6::zeros();
    for k in 0..6 {
        let mut d = Vector6::zeros();
        d[k] = H;
        // Richardson: removes the H² error, leaves about 1e-12.
        let coarse = (f(&d) - f(&-d)) / (2.0 * H);
        let fine = (f(&(d * 0.5)) - f(&(-d * 0.5))) / H;
        m.set_column(k, &((fine * 4.0 - coarse) / 3.0));
    }
    m
}

proptest! {
    #[test]
    fn hat_is_the_cross_product(v in unit_vector(), w in unit_vector()) {
        prop_assert!((so3::hat(&v) * w - v.cross(&w)).norm() < 1e-15);
        prop_assert!((so3::vee(&so3::hat(&v)) - v).norm() < 1e-15);
    }

    #[test]
    fn so3_exp_is_rodrigues(phi in rotation_vector()) {
        let expected = UnitQuaternion::from_scaled_axis(phi);
        prop_assert!((so3::exp(&phi).coords - expected.coords).norm() < 1e-14);
        prop_assert!((so3::exp(&phi).norm() - 1.0).abs() < 1e-14);
    }

    #[test]
    fn so3_round_trip(phi in rotation_vector()) {
        let back = so3::log(&so3::exp(&phi));
        prop_assert!((back - phi).norm() < 1e-14 + 1e-13 * phi.norm(), "{phi} {back}");
        // The double cover does not show.
        let minus = UnitQuaternion::new_unchecked(-so3::exp(&phi).into_inner());
        prop_assert_eq!(so3::log(&minus), back);
    }

    #[test]
    fn so3_round_trip_f32(phi in rotation_vector()) {
        prop_assume!(phi.norm() < PI - 1e-3);
        let phi = phi.cast::<f32>();
        let back = so3::log(&so3::exp(&phi));
        prop_assert!((back - phi).norm() < 2e-6 * phi.norm().max(1e-6), "{phi} {back}");
    }

    #[test]
    fn so3_jacobian_inverses(phi in rotation_vector()) {
        let left = so3::left_jacobian(&phi) * so3::left_jacobian_inverse(&phi);
        let right = so3::right_jacobian(&phi) * so3::right_jacobian_inverse(&phi);
        prop_assert!((left - Matrix3::identity()).norm() < 1e-12);
        prop_assert!((right - Matrix3::identity()).norm() < 1e-12);
        // R = J_l J_r⁻¹ (Barfoot eq. 8.86).
        let r = so3::left_jacobian(&phi) * so3::right_jacobian_inverse(&phi);
        prop_assert!((r - so3::exp(&phi).to_rotation_matrix().into_inner()).norm() < 1e-12);
    }

    #[test]
    fn se3_exp_is_the_matrix_exponential(xi in twist()) {
        let mut generator = se3_lie::nalgebra::Matrix4::zeros();
        let phi = Vector3::new(xi[3], xi[4], xi[5]);
        generator.fixed_view_mut::<3, 3>(0, 0).copy_from(&so3::hat(&phi));
        generator.fixed_view_mut::<3, 1>(0, 3).copy_from(&Vector3::new(xi[0], xi[1], xi[2]));
        // Taylor series with scaling and squaring.
        let a = generator / 64.0;
        let (mut term, mut sum) = (se3_lie::nalgebra::Matrix4::identity(), se3_lie::nalgebra::Matrix4::identity());
        for k in 1..12 {
            term = term * a / f64::from(k);
            sum += term;
        }
        for _ in 0..6 {
            sum = sum * sum;
        }
        prop_assert!((se3::exp(&xi).to_homogeneous() - sum).norm() < 1e-12);
    }

    #[test]
    fn se3_round_trip(xi in twist()) {
        let back = se3::log(&se3::exp(&xi));
        prop_assert!((back - xi).norm() < 1e-12, "{xi} {back}");
    }

    #[test]
    fn se3_inverse_is_the_negative_twist(xi in twist()) {
        prop_assert!(motion_distance(&se3::exp(&-xi), &se3::exp(&xi).inverse()) < 1e-13);
    }

    #[test]
    fn adjoint_moves_a_twist_across(a in twist(), b in twist()) {
        let motion = se3::exp(&a);
        let moved = se3::exp(&(se3::adjoint(&motion) * b)) * motion;
        prop_assert!(motion_distance(&(motion * se3::exp(&b)), &moved) < 1e-12);
        // Homomorphism.
        let product = se3::adjoint(&(motion * se3::exp(&b)));
        prop_assert!((product - se3::adjoint(&motion) * se3::adjoint(&se3::exp(&b))).norm() < 1e-12);
    }

    #[test]
    fn se3_jacobians_match_differences(xi in twist()) {
        let pose = se3::exp(&xi);
        let left = differentiate(|d| se3::log(&(se3::exp(&(xi + d)) * pose.inverse())));
        let right = differentiate(|d| se3::log(&(pose.inverse() * se3::exp(&(xi + d)))));
        prop_assert!((left - se3::left_jacobian(&xi)).norm() < 1e-8, "{}", left - se3::left_jacobian(&xi));
        prop_assert!((right - se3::right_jacobian(&xi)).norm() < 1e-8);
    }

    #[test]
    fn se3_inverse_jacobians_match_differences(xi in twist()) {
        // The logarithm jumps at a half turn: stay where the differences do not reach over.
        prop_assume!(xi.fixed_rows::<3>(3).norm() < PI - 1e-2);
        let pose = se3::exp(&xi);
        let left = differentiate(|d| se3::log(&(se3::exp(d) * pose)) - xi);
        let right = differentiate(|d| se3::log(&(pose * se3::exp(d))) - xi);
        prop_assert!((left - se3::left_jacobian_inverse(&xi)).norm() < 1e-7);
        prop_assert!((right - se3::right_jacobian_inverse(&xi)).norm() < 1e-7);
    }

    #[test]
    fn left_is_adjoint_times_right(xi in twist()) {
        let expected = se3::adjoint(&se3::exp(&xi)) * se3::right_jacobian(&xi);
        prop_assert!((se3::left_jacobian(&xi) - expected).norm() < 1e-11);
        let one = se3::left_jacobian(&xi) * se3::left_jacobian_inverse(&xi);
        prop_assert!((one - Matrix6::identity()).norm() < 1e-11);
        let one = se3::right_jacobian(&xi) * se3::right_jacobian_inverse(&xi);
        prop_assert!((one - Matrix6::identity()).norm() < 1e-11);
    }

    #[test]
    fn rotation_angle_is_the_norm_of_the_log(base in rotation_vector(), phi in rotation_vector()) {
        let (a, b) = (so3::exp(&base), so3::exp(&base) * so3::exp(&phi));
        prop_assert!((distance::rotation_angle(&a, &b) - phi.norm()).abs() < 1e-13);
        prop_assert!((distance::rotation_angle(&b, &a) - phi.norm()).abs() < 1e-13);
    }

    #[test]
    fn swing_ignores_roll_and_measures_tilt(
        base in rotation_vector(),
        direction in 0.0..2.0 * PI,
        tilt in angle(),
        roll_before in -PI..PI,
        roll_after in -PI..PI,
    ) {
        let roll = |r: f64| so3::exp(&Vector3::new(0.0, 0.0, r));
        let obj_from_a = so3::exp(&base);
        let pure_roll = distance::swing_angle(&obj_from_a, &(obj_from_a * roll(roll_before)));
        prop_assert!(pure_roll < 1e-14, "{pure_roll}");
        let tilted = so3::exp(&(Vector3::new(direction.cos(), direction.sin(), 0.0) * tilt));
        let obj_from_b = obj_from_a * roll(roll_before) * tilted * roll(roll_after);
        let swing = distance::swing_angle(&obj_from_a, &obj_from_b);
        prop_assert!((swing - tilt).abs() < 1e-14, "{swing} {tilt}");
    }
}

#[test]
fn half_turns_have_one_sign() {
    for axis in [Vector3::x(), Vector3::y(), Vector3::z(), Vector3::<f64>::new(0.0, -0.6, 0.8)] {
        for sign in [1.0, -1.0] {
            let v = axis * sign;
            let q = UnitQuaternion::new_unchecked(se3_lie::nalgebra::Quaternion::new(0.0, v.x, v.y, v.z));
            let phi = so3::log(&q);
            assert!((phi.norm() - PI).abs() < 1e-15);
            assert!(phi.iter().find(|c| **c != 0.0).unwrap() > &0.0, "{phi}");
        }
    }
}

#[test]
fn tiny_rotations_keep_their_digits() {
    for theta in [1e-300_f64, 1e-170, 1e-20, 1e-9] {
        let phi = Vector3::new(0.6, -0.8, 0.0) * theta;
        let back = so3::log(&so3::exp(&phi));
        assert!((back - phi).amax() <= 1e-15 * theta, "{theta}: {back}");
    }
}

#[test]
fn nan_stays_nan() {
    let xi = Vector6::from_element(f64::NAN);
    assert!(se3::exp(&xi).translation.vector.iter().all(|c| c.is_nan()));
    assert!(se3::log(&se3::exp(&xi)).iter().all(|c| c.is_nan()));
    assert!((se3::exp(&xi) * Point3::origin()).x.is_nan());
}
