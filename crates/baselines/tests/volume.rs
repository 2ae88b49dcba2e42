//! The volume against analytic spheres.
#![allow(clippy::unwrap_used)]

use baselines::tsdf::{DepthView, TsdfOptions, TsdfVolume};
use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use proptest::prelude::*;
use rgbd_io::{Image, Intrinsics};
use std::f64::consts::FRAC_PI_6;

const K: Intrinsics = Intrinsics { fx: 250.0, fy: 260.0, cx: 63.2, cy: 60.8 };
const SIDE: usize = 128;
const RADIUS: f64 = 0.06;

/// z-depth of a sphere around the object's origin, seen from half a metre at this turn.
fn sphere(cam_from_obj: &Isometry3<f64>, radius: f64) -> Image<f32> {
    let middle = cam_from_obj.translation.vector;
    Image::from_fn(SIDE, SIDE, |x, y| {
        let ray = Vector3::from(K.unproject(x as f64, y as f64, 1.0));
        let (a, b, c) = (ray.dot(&ray), middle.dot(&ray), middle.dot(&middle) - radius * radius);
        let root = b * b - a * c;
        if root > 0.0 { ((b - root.sqrt()) / a) as f32 } else { 0.0 }
    })
}

fn pose(turn: f64) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(0.3, 1.0, 0.2).normalize() * turn);
    Isometry3::from_parts(nalgebra::Translation3::new(0.01, -0.005, 0.5), rotation)
}

fn fuse(volume: &mut TsdfVolume, cam_from_obj: &Isometry3<f64>, radius: f64, rgb: [u8; 3]) {
    let depth = sphere(cam_from_obj, radius);
    // Confidence: the cosine between ray and normal, as the trackers have it.
    let obj_middle = cam_from_obj.translation.vector;
    let weights = Image::from_fn(SIDE, SIDE, |x, y| {
        let p = Vector3::from(K.unproject(x as f64, y as f64, depth[(x, y)].into()));
        if depth[(x, y)] > 0.0 { (-p.normalize().dot(&((p - obj_middle) / radius))) as f32 } else { 0.0 }
    });
    let color = Image::filled(SIDE, SIDE, rgb);
    let view = DepthView { depth: &depth, weights: &weights, color: &color, intrinsics: K };
    volume.integrate(&view, cam_from_obj);
}

fn all_around() -> TsdfVolume {
    let mut volume = TsdfVolume::new(TsdfOptions::default());
    (0..12).for_each(|i| fuse(&mut volume, &pose(f64::from(i) * FRAC_PI_6), RADIUS, [200, 100, 50]));
    volume
}

#[test]
fn a_sphere_is_reconstructed() {
    let volume = all_around();
    for spacing in [0.001, 0.0017, 0.005] {
        let mesh = volume.mesh(spacing);
        let mut errors: Vec<f32> = mesh
            .vertices
            .iter()
            .map(|v| (v.iter().map(|c| c * c).sum::<f32>().sqrt() - 0.06).abs())
            .collect();
        errors.sort_by(f32::total_cmp);
        assert!(errors.len() > 500);
        let (median, high) = (errors[errors.len() / 2], errors[errors.len() * 95 / 100]);
        assert!(median < 0.001 && high < 0.003, "median {median}, 95 % {high} at spacing {spacing}");
        // All around but for the poles of the turn's axis, which were seen at grazing angles only.
        let area = mesh.area() / (4.0 * std::f64::consts::PI * RADIUS * RADIUS);
        assert!((0.85..1.05).contains(&area), "{area}");
        assert!(
            mesh.signed_volume() > 0.0
                && mesh.colors.iter().all(|c| c.iter().zip([200, 100, 50]).all(|(a, b)| a.abs_diff(b) <= 1))
        );
    }
}

#[test]
fn the_raycast_is_the_depth_that_was_fused() {
    let volume = all_around();
    let cam_from_obj = pose(0.2);
    let truth = sphere(&cam_from_obj, RADIUS);
    let seen = volume.raycast(&cam_from_obj, &K, SIDE, SIDE);
    let mut errors = Vec::new();
    let mut missing = 0;
    for (i, (&z, p)) in truth.pixels().iter().zip(&seen.points).enumerate() {
        if z > 0.0 && p[0].is_nan() {
            missing += 1;
        }
        if z > 0.0 && !p[0].is_nan() {
            let q = cam_from_obj * nalgebra::Point3::from(p.map(f64::from));
            errors.push((q.z - f64::from(z)).abs());
            let n = seen.normals[i];
            if !n[0].is_nan() {
                let cos = p.iter().zip(n).map(|(a, b)| a * b).sum::<f32>() / 0.06;
                assert!(cos > 0.9, "normal {n:?} at {p:?}");
            }
        }
    }
    errors.sort_by(f64::total_cmp);
    assert!(errors[errors.len() / 2] < 5e-4, "{}", errors[errors.len() / 2]);
    assert!(missing * 20 < errors.len(), "{missing} of {}", errors.len());
    // Nothing is seen from the other direction.
    let away = Isometry3::translation(0.0, 0.0, -0.5);
    assert_eq!(volume.raycast(&away, &K, SIDE, SIDE).count(), 0);
}

#[test]
fn distances_are_signed_and_their_gradient_points_outwards() {
    let volume = all_around();
    for direction in [Vector3::x(), -Vector3::x(), Vector3::z(), Vector3::new(1.0, 0.0, -1.0).normalize()] {
        let at = |r: f64| (direction * r).map(|v| v as f32).into();
        let value = |r| volume.sample(at(r)).unwrap();
        assert!(value(RADIUS).abs() < 1e-3 && value(0.064) > 0.0025 && value(0.056) < -0.0025);
        let gradient = Vector3::from(volume.gradient(at(RADIUS)).unwrap()).cast::<f64>();
        assert!(gradient.normalize().dot(&direction) > 0.98, "{gradient}");
    }
    assert_eq!(volume.sample([0.0; 3]), None);
    assert_eq!(volume.sample([f32::NAN; 3]), None);
    assert_eq!(volume.sample([1e30; 3]), None);
}

#[test]
fn bounds_hold_and_unusable_options_stay_empty() {
    let mut few = TsdfVolume::new(TsdfOptions { max_blocks: 10, ..TsdfOptions::default() });
    fuse(&mut few, &pose(0.0), RADIUS, [1; 3]);
    assert_eq!(few.blocks(), 10);
    let mut narrow = TsdfVolume::new(TsdfOptions { radius_m: 0.01, ..TsdfOptions::default() });
    fuse(&mut narrow, &pose(0.0), RADIUS, [1; 3]);
    assert_eq!(narrow.blocks(), 0);
    for bad in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        let options = TsdfOptions::default();
        for options in [
            TsdfOptions { voxel_m: bad, ..options },
            TsdfOptions { truncation_m: bad, ..options },
            TsdfOptions { max_weight: bad, ..options },
            TsdfOptions { radius_m: bad, ..options },
        ] {
            let mut volume = TsdfVolume::new(options);
            fuse(&mut volume, &pose(0.0), RADIUS, [1; 3]);
            assert_eq!(volume.blocks(), 0, "{options:?}");
            assert!(volume.mesh(0.002).vertices.is_empty() && volume.sample([0.0; 3]).is_none());
            assert_eq!(volume.raycast(&pose(0.0), &K, 4, 4).count(), 0);
        }
    }
}

#[test]
fn bad_views_change_nothing() {
    let mut volume = TsdfVolume::new(TsdfOptions::default());
    let (depth, weights) = (sphere(&pose(0.0), RADIUS), Image::filled(SIDE, SIDE, 1.0));
    let color = Image::filled(SIDE, SIDE, [0; 3]);
    let view = DepthView { depth: &depth, weights: &weights, color: &color, intrinsics: K };
    volume.integrate(&view, &Isometry3::translation(f64::NAN, 0.0, 0.0));
    volume.integrate(&DepthView { intrinsics: Intrinsics { fx: 0.0, ..K }, ..view }, &pose(0.0));
    let (short, nan, zero) = (Image::filled(4, 4, 1.0), depth.map(|_| f32::NAN), depth.map(|_| 0.0));
    volume.integrate(&DepthView { weights: &short, ..view }, &pose(0.0));
    volume.integrate(&DepthView { depth: &nan, ..view }, &pose(0.0));
    volume.integrate(&DepthView { weights: &nan, ..view }, &pose(0.0));
    volume.integrate(&DepthView { weights: &zero, ..view }, &pose(0.0));
    assert_eq!(volume.blocks(), 0);

    // Single bad pixels among good ones do no harm.
    let mut speckled = depth.clone();
    for (i, z) in speckled.pixels_mut().iter_mut().enumerate().filter(|(i, _)| i % 7 == 0) {
        *z = [f32::NAN, f32::INFINITY, -1.0, 0.0][i / 7 % 4];
    }
    volume.integrate(&DepthView { depth: &speckled, ..view }, &pose(0.0));
    let mesh = volume.mesh(0.002);
    assert!(mesh.vertices.len() > 500 && mesh.vertices.as_flattened().iter().all(|v| v.is_finite()));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]

    /// Fusing the same view again changes nothing, and a sphere of any size is where it is.
    #[test]
    fn fusion_is_a_mean(radius in 0.03..0.09, turn in -3.0..3.0) {
        let cam_from_obj = pose(turn);
        let mut once = TsdfVolume::new(TsdfOptions { voxel_m: 0.004, truncation_m: 0.016, ..TsdfOptions::default() });
        fuse(&mut once, &cam_from_obj, radius, [10, 20, 30]);
        let mut thrice = once.clone();
        fuse(&mut thrice, &cam_from_obj, radius, [10, 20, 30]);
        fuse(&mut thrice, &cam_from_obj, radius, [10, 20, 30]);
        let eye = cam_from_obj.inverse().translation.vector.normalize();
        for r in [radius - 0.006, radius, radius + 0.006] {
            let p = (eye * r).map(|v| v as f32).into();
            let (a, b) = (once.sample(p).unwrap(), thrice.sample(p).unwrap());
            prop_assert!((a - b).abs() < 1e-5);
            prop_assert!((a - (r - radius) as f32).abs() < 8e-4, "{} at {}", a, r - radius);
        }
    }
}
