//! Last corrections of the views' poses: surface points get one colour in all views.
//!
//! A tracked pose is good to a millimetre or two, which is a pixel or two of texture. As in Zhou and Koltun, "Color Map
//! Optimization for 3D Reconstruction with Consumer Depth Cameras" (SIGGRAPH 2014), with rigid motions alone, two steps
//! alternate: the mean brightness of every surface point over the views, and for each view the motion that brings its
//! image closest to these means. Brightness is logarithmic and without the light that the views have in common; what is
//! left of it in one view, a smooth function of the normal again, is fitted with the view's exposure. Without that, light
//! that passes over an object looks like motion.

use nalgebra::{Isometry3, Matrix4, Matrix6, Point3, Translation3, Vector3, Vector4, Vector6};
use rayon::prelude::*;
use rgbd_io::Image;

use super::{
    light::Light,
    sample::SurfacePoint,
    view::{Prepared, log_brightness},
};

/// Blur radius (pixels) and rounds of each stage.
const STAGES: [(usize, usize); 2] = [(2, 12), (1, 10)];
/// Points nearer to the border of the usable area (pixels) are left out: their gradient isn't the surface's.
const INSET: f32 = 4.0;
/// Least cosine at which a point takes part.
const GRAZING: f32 = 0.3;
/// Standard deviation of a point's log brightness, and the Huber limit in these units.
const NOISE: f64 = 0.06;
const HUBER: f64 = 1.5;
/// Neighbouring points see the same pixels: so many of them count as one.
const CORRELATED: f64 = 40.0;
/// Expected size of the terms of the light that is left in a view, and of its log exposure.
const LEFT: [f64; 4] = [0.1, 0.1, 0.1, 0.3];
/// How far the given poses may be off: metres and radians.
const PRIOR: [f64; 2] = [0.002, 0.01];
/// Corrections beyond this are mistakes: metres and radians.
const LARGEST: [f64; 2] = [0.006, 0.03];

/// A surface point in one view.
struct Seen {
    point: u32,
    weight: f64,
    /// Normal in the camera's frame, and one.
    normal: Vector4<f64>,
    /// Log brightness that the common light gives it.
    shading: f64,
}

/// For each view the motion of the object frame that corrects it: `obj_from_cam <- correction * obj_from_cam`. The
/// identity where a view shares too little with others, or nothing is gained.
pub(super) fn corrections(points: &[SurfacePoint], views: &[Prepared], light: &Light) -> Vec<Isometry3<f64>> {
    let center = points.iter().fold(Vector3::zeros(), |s, p| s + Vector3::from(p.position.map(f64::from)))
        / points.len().max(1) as f64;
    let seen: Vec<Vec<Seen>> = views.par_iter().map(|view| seen_points(view, points, light)).collect();
    let points: Vec<Point3<f64>> = points.iter().map(|p| Point3::from(p.position.map(f64::from))).collect();
    let mut corrections = vec![Isometry3::identity(); views.len()];
    for (radius, rounds) in STAGES {
        let images: Vec<Image<f32>> = views.par_iter().map(|view| log_brightness(view, radius)).collect();
        let mut means = vec![None; points.len()];
        let mut left = vec![Vector4::zeros(); views.len()];
        for _ in 0..rounds {
            let samples: Vec<Vec<Option<f64>>> = (0..views.len())
                .into_par_iter()
                .map(|v| brightness(&views[v], &images[v], &seen[v], &points, &corrections[v]))
                .collect();
            means = mean_brightness(&seen, &samples, &left, &means);
            left = (0..views.len()).map(|v| light_left(&seen[v], &samples[v], &means)).collect();
            corrections = (0..views.len())
                .into_par_iter()
                .map(|v| {
                    let fit =
                        Fit { view: &views[v], image: &images[v], points: &points, center, means: &means };
                    fit.step(&seen[v], &left[v], &corrections[v])
                })
                .collect();
            take_out_drift(&mut corrections, views, center);
        }
    }
    for correction in &mut corrections {
        // Distance of the correction where the object is, not at the frame's origin.
        let shift = (*correction * Point3::from(center) - Point3::from(center)).norm();
        // Written so that a NaN fails it.
        let plausible = shift <= LARGEST[0] && correction.rotation.angle() <= LARGEST[1];
        if !plausible {
            *correction = Isometry3::identity();
        }
    }
    corrections
}

/// Takes out what all views were moved by in common in the camera's frame, at the object's middle. Images can't tell
/// where on the mesh they all belong together, and light that is left pulls every view the same way.
fn take_out_drift(corrections: &mut [Isometry3<f64>], views: &[Prepared], center: Vector3<f64>) {
    let rotations = || views.iter().map(|view| view.cam_from_obj().rotation);
    let (mut shift, mut turn) = (Vector3::zeros(), Vector3::zeros());
    for (correction, cam_from_obj) in corrections.iter().zip(rotations()) {
        shift += cam_from_obj * (correction * Point3::from(center) - Point3::from(center));
        turn += cam_from_obj * correction.rotation.scaled_axis();
    }
    let count = corrections.len().max(1) as f64;
    let origin = Translation3::from(center);
    for (correction, cam_from_obj) in corrections.iter_mut().zip(rotations()) {
        let back = cam_from_obj.inverse();
        let common = Isometry3::new(back * shift / count, back * turn / count);
        *correction = origin * common.inverse() * origin.inverse() * *correction;
    }
}

fn seen_points(view: &Prepared, points: &[SurfacePoint], light: &Light) -> Vec<Seen> {
    let rotation = view.cam_from_obj().rotation;
    let seen = points.iter().zip(0u32..).filter_map(|(p, point)| {
        let sight = view.sight(p.position, p.normal)?;
        let normal = rotation * Vector3::from(p.normal.map(f64::from));
        (sight.inset >= INSET && sight.cosine >= GRAZING).then(|| Seen {
            point,
            weight: f64::from(sight.cosine * view.quality),
            normal: normal.push(1.0),
            shading: light.log(view, p),
        })
    });
    seen.collect()
}

/// Value and gradient of an image at a pixel; `None` at its border.
fn sample(image: &Image<f32>, u: f64, v: f64) -> Option<[f64; 3]> {
    let (width, height) = image.size();
    // Written so that a NaN fails it.
    let inside = u >= 1.0 && v >= 1.0 && u < width as f64 - 2.0 && v < height as f64 - 2.0;
    if !inside {
        return None;
    }
    let (x, y) = (u as usize, v as usize);
    let (s, t) = (u.fract(), v.fract());
    let at = |x: usize, y: usize| f64::from(image[(x, y)]);
    let (a, b, c, d) = (at(x, y), at(x + 1, y), at(x, y + 1), at(x + 1, y + 1));
    let value = (a * (1.0 - s) + b * s) * (1.0 - t) + (c * (1.0 - s) + d * s) * t;
    Some([value, (b - a) * (1.0 - t) + (d - c) * t, (c - a) * (1.0 - s) + (d - b) * s])
}

fn brightness(
    view: &Prepared,
    image: &Image<f32>,
    seen: &[Seen],
    points: &[Point3<f64>],
    correction: &Isometry3<f64>,
) -> Vec<Option<f64>> {
    let cam_from_obj = view.cam_from_obj() * correction.inverse();
    let value = |s: &Seen| {
        let [u, v] = view.intrinsics().project((cam_from_obj * points[s.point as usize]).coords.into())?;
        sample(image, u, v).map(|[value, ..]| value - s.shading)
    };
    seen.iter().map(value).collect()
}

/// Weighted mean over the views, of points that at least two see; others have none. What is far from the last mean
/// counts less.
fn mean_brightness(
    seen: &[Vec<Seen>],
    samples: &[Vec<Option<f64>>],
    left: &[Vector4<f64>],
    last: &[Option<f64>],
) -> Vec<Option<f64>> {
    let mut sums = vec![(0.0f64, 0.0f64, 0u32); last.len()];
    for ((seen, samples), left) in seen.iter().zip(samples).zip(left) {
        for (s, value) in seen.iter().zip(samples) {
            let Some(value) = value.map(|v| v - left.dot(&s.normal)) else { continue };
            let weight = s.weight * last[s.point as usize].map_or(1.0, |mean| huber(value - mean));
            let (sum, weights, count) = &mut sums[s.point as usize];
            *sum += weight * value;
            *weights += weight;
            *count += 1;
        }
    }
    sums.into_iter().map(|(sum, weight, count)| (count > 1 && weight > 0.0).then(|| sum / weight)).collect()
}

fn huber(error: f64) -> f64 {
    (HUBER * NOISE / error.abs()).min(1.0)
}

/// What a view's brightness has beyond the means: a linear function of the normal.
fn light_left(seen: &[Seen], samples: &[Option<f64>], means: &[Option<f64>]) -> Vector4<f64> {
    let (mut h, mut g) = (Matrix4::zeros(), Vector4::zeros());
    for (s, value) in seen.iter().zip(samples) {
        if let (Some(value), Some(mean)) = (value, means[s.point as usize]) {
            let weight = s.weight * huber(value - mean) / (NOISE * NOISE * CORRELATED);
            h += s.normal * s.normal.transpose() * weight;
            g += s.normal * (weight * (value - mean));
        }
    }
    for (i, size) in LEFT.iter().enumerate() {
        h[(i, i)] += size.powi(-2);
    }
    h.cholesky().map_or_else(Vector4::zeros, |factor| factor.solve(&g))
}

/// One view against the means.
struct Fit<'a> {
    view: &'a Prepared,
    image: &'a Image<f32>,
    points: &'a [Point3<f64>],
    center: Vector3<f64>,
    means: &'a [Option<f64>],
}

impl Fit<'_> {
    /// One Gauss-Newton step on the correction, a twist about the object's middle.
    fn step(&self, seen: &[Seen], left: &Vector4<f64>, correction: &Isometry3<f64>) -> Isometry3<f64> {
        let cam_from_obj = self.view.cam_from_obj() * correction.inverse();
        let rotation = cam_from_obj.rotation.to_rotation_matrix();
        let k = self.view.intrinsics();
        let (mut hessian, mut gradient) = (Matrix6::zeros(), Vector6::zeros());
        for s in seen {
            let Some(mean) = self.means[s.point as usize] else { continue };
            let p = self.points[s.point as usize];
            let q = cam_from_obj * p;
            let Some([u, v]) = k.project(q.coords.into()) else { continue };
            let Some([value, du, dv]) = sample(self.image, u, v) else { continue };
            // Change of brightness with the camera-frame point, then with the twist of the object frame.
            let (gx, gy) = (du * k.fx / q.z, dv * k.fy / q.z);
            let along = rotation.inverse() * Vector3::new(gx, gy, -(gx * q.x + gy * q.y) / q.z);
            let arm = p.coords - self.center;
            let turn = along.cross(&arm);
            let row = Vector6::new(-along.x, -along.y, -along.z, turn.x, turn.y, turn.z);
            let error = value - s.shading - left.dot(&s.normal) - mean;
            let weight = s.weight * huber(error) / (NOISE * NOISE * CORRELATED);
            hessian += row * row.transpose() * weight;
            gradient += row * (weight * error);
        }
        // The given pose is an observation, too.
        let shift = *correction * Point3::from(self.center) - Point3::from(self.center);
        let turned = correction.rotation.scaled_axis();
        for i in 0..6 {
            let weight = PRIOR[i / 3].powi(-2);
            hessian[(i, i)] += weight;
            gradient[i] += weight * if i < 3 { shift[i] } else { turned[i - 3] };
        }
        let Some(factor) = hessian.cholesky() else { return *correction };
        let twist = -factor.solve(&gradient);
        let origin = Translation3::from(self.center);
        let motion = Isometry3::new(twist.fixed_rows::<3>(0).into(), twist.fixed_rows::<3>(3).into());
        origin * motion * origin.inverse() * correction
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_of_a_ramp_are_exact() {
        let image = Image::from_fn(10, 8, |x, y| 3.0 * x as f32 - 2.0 * y as f32);
        let [value, du, dv] = sample(&image, 4.3, 2.6).unwrap();
        assert!((value - (12.9 - 5.2)).abs() < 1e-6 && (du - 3.0).abs() < 1e-6 && (dv + 2.0).abs() < 1e-6);
        assert!(sample(&image, 0.5, 3.0).is_none() && sample(&image, f64::NAN, 3.0).is_none());
    }
}
