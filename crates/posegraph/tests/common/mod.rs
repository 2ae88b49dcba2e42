//! Poses, errors and synthetic views with known ground truth.
#![allow(dead_code, clippy::unwrap_used, clippy::expect_used, unreachable_pub)]

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3, Vector6};
use posegraph::{DenseView, FeatureEdge, Node, Pinhole};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use se3_lie::se3;

pub fn rng(seed: u64) -> Pcg64Mcg {
    Pcg64Mcg::seed_from_u64(seed)
}

pub fn vector(rng: &mut Pcg64Mcg, scale: f64) -> Vector3<f64> {
    Vector3::from_fn(|_, _| rng.random_range(-scale..scale))
}

pub fn unit(rng: &mut Pcg64Mcg) -> Vector3<f64> {
    loop {
        let v = vector(rng, 1.0);
        if v.norm() > 0.1 && v.norm() < 1.0 {
            return v.normalize();
        }
    }
}

/// `exp` of a twist with the given lengths in random directions.
pub fn motion(rng: &mut Pcg64Mcg, translation: f64, rotation: f64) -> Isometry3<f64> {
    let (t, r) = (unit(rng) * translation, unit(rng) * rotation);
    se3::exp(&Vector6::new(t.x, t.y, t.z, r.x, r.y, r.z))
}

/// Moves a camera as if the object moved by a rotation about its own origin and a translation.
pub fn disturb(rng: &mut Pcg64Mcg, pose: &Isometry3<f64>, translation: f64, degrees: f64) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_scaled_axis(unit(rng) * degrees.to_radians());
    Isometry3::from_parts(Translation3::from(unit(rng) * translation), rotation) * pose
}

pub fn node(obj_from_cam: Isometry3<f64>, fixed: bool) -> Node {
    Node { obj_from_cam, fixed }
}

/// Error of an estimate as (motion of the object's centre in metres, rotation in degrees).
pub fn error(estimate: &Isometry3<f64>, truth: &Isometry3<f64>) -> (f64, f64) {
    let delta = estimate * truth.inverse();
    (delta.translation.vector.norm(), delta.rotation.angle().to_degrees())
}

/// Camera on a sphere around the object, looking at its centre; `yaw`, `pitch` in radians.
pub fn orbit(distance: f64, yaw: f64, pitch: f64) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), yaw)
        * UnitQuaternion::from_axis_angle(&Vector3::x_axis(), pitch);
    Isometry3::from_parts(Translation3::from(rotation * Vector3::new(0.0, 0.0, -distance)), rotation)
}

pub fn in_camera(obj_from_cam: &Isometry3<f64>, x: &Vector3<f64>) -> [f32; 3] {
    let p = obj_from_cam.inverse_transform_point(&Point3::from(*x));
    [p.x as f32, p.y as f32, p.z as f32]
}

/// Matches of common object points with Gaussian-like noise and a share of outliers.
pub fn matches(
    rng: &mut Pcg64Mcg,
    (i, ti): (usize, &Isometry3<f64>),
    (j, tj): (usize, &Isometry3<f64>),
    count: usize,
    noise: f64,
    outliers: f64,
) -> FeatureEdge {
    let mut edge =
        FeatureEdge { i, j, points_i: Vec::new(), points_j: Vec::new(), weights: vec![1.0; count] };
    for _ in 0..count {
        let x = vector(rng, 0.1);
        let wrong = rng.random_bool(outliers);
        let y = if wrong { vector(rng, 0.1) } else { x + vector(rng, noise.max(1e-12)) };
        edge.points_i.push(in_camera(ti, &x));
        edge.points_j.push(in_camera(tj, &y));
    }
    edge
}

/// A sphere of 8 cm with bumps: distance bound and gradient.
pub fn bumpy(x: &Vector3<f64>) -> f64 {
    x.norm()
        - 0.08
        - 0.006 * (45.0 * x.x).sin() * (45.0 * x.y + 1.0).sin() * (45.0 * x.z + 0.5).sin()
        - 0.01 * (25.0 * x.x + 0.3).sin() * (20.0 * x.y).cos()
}

pub fn gradient(f: impl Fn(&Vector3<f64>) -> f64, x: &Vector3<f64>) -> Vector3<f64> {
    let h = 1e-6;
    Vector3::from_fn(|k, _| {
        let mut step = Vector3::zeros();
        step[k] = h;
        (f(&(x + step)) - f(&(x - step))) / (2.0 * h)
    })
}

/// Renders the zero level of `f` by sphere tracing.
pub fn render(
    f: impl Fn(&Vector3<f64>) -> f64 + Copy,
    obj_from_cam: &Isometry3<f64>,
    size: usize,
    noise: f64,
    rng: &mut Pcg64Mcg,
) -> DenseView {
    let (points, normals) = images(f, obj_from_cam, size, noise, rng);
    view(size, &points, &normals)
}

/// A view of these square images.
pub fn view(size: usize, points: &[[f32; 3]], normals: &[[f32; 3]]) -> DenseView {
    let (focal, centre) = (2.0 * size as f64, (size as f64 - 1.0) / 2.0);
    let camera = Pinhole { fx: focal, fy: focal, cx: centre, cy: centre };
    DenseView::new((size, size), camera, points, normals).unwrap()
}

/// Points and normals, camera frame, of the zero level of `f`.
pub fn images(
    f: impl Fn(&Vector3<f64>) -> f64 + Copy,
    obj_from_cam: &Isometry3<f64>,
    size: usize,
    noise: f64,
    rng: &mut Pcg64Mcg,
) -> (Vec<[f32; 3]>, Vec<[f32; 3]>) {
    let (focal, centre) = (2.0 * size as f64, (size as f64 - 1.0) / 2.0);
    let (mut points, mut normals) = (Vec::new(), Vec::new());
    for v in 0..size {
        for u in 0..size {
            let ray = Vector3::new((u as f64 - centre) / focal, (v as f64 - centre) / focal, 1.0);
            let at = |z: f64| obj_from_cam.transform_point(&Point3::from(ray * z)).coords;
            let mut z = 0.3;
            for _ in 0..80 {
                z += 0.6 * f(&at(z));
            }
            let hit = f(&at(z)).abs() < 1e-5 && z < 0.8;
            let normal = obj_from_cam.rotation.inverse() * gradient(f, &at(z)).normalize();
            let z = z + if noise > 0.0 { rng.random_range(-noise..noise) } else { 0.0 };
            let p = ray * z;
            points.push(if hit { [p.x as f32, p.y as f32, p.z as f32] } else { [0.0; 3] });
            normals.push(if hit { [normal.x as f32, normal.y as f32, normal.z as f32] } else { [0.0; 3] });
        }
    }
    (points, normals)
}
