//! Last corrections of the views' poses: surface points get one colour in all views.
//!
//! A tracked pose is good to a millimetre or two, which is a pixel or two of texture. As in Zhou and Koltun, "Color Map
//! Optimization for 3D Reconstruction with Consumer Depth Cameras" (SIGGRAPH 2014), with rigid motions alone, two steps
//! alternate: the mean brightness of every surface point over the views, and for each view the motion that brings its
//! image closest to these means. Brightness is taken relative to the surroundings, since shading moves over an object
//! that turns under a lamp.

use marching_cubes::TriMesh;
use nalgebra::{Isometry3, Matrix6, Point3, Translation3, Vector3, Vector6};
use rayon::prelude::*;
use rgbd_io::Image;

use super::view::{Prepared, contrast};

/// Surface points that take part.
const POINTS: usize = 12_000;
/// Blur radius (pixels) and rounds of each stage.
const STAGES: [(usize, usize); 2] = [(2, 12), (1, 10)];
/// Points nearer to the border of the usable area (pixels) are left out: their gradient isn't the surface's.
const INSET: f32 = 4.0;
/// Least cosine at which a point takes part.
const GRAZING: f32 = 0.3;
/// Standard deviation of a point's brightness (128 = as bright as its surroundings), and the Huber limit in these units.
const NOISE: f64 = 8.0;
const HUBER: f64 = 1.5;
/// Neighbouring points see the same pixels: so many of them count as one.
const CORRELATED: f64 = 40.0;
/// How far the given poses may be off: metres and radians.
const PRIOR: [f64; 2] = [0.002, 0.01];
/// Corrections beyond this are mistakes: metres and radians.
const LARGEST: [f64; 2] = [0.006, 0.03];

/// A surface point in one view.
struct Seen {
    point: u32,
    weight: f32,
}

/// For each view the motion of the object frame that corrects it: `obj_from_cam <- correction * obj_from_cam`. The
/// identity where a view shares too little with others, or nothing is gained.
pub(super) fn corrections(mesh: &TriMesh, views: &[Prepared]) -> Vec<Isometry3<f64>> {
    let points = surface_points(mesh);
    let center = points.iter().fold(Vector3::zeros(), |s, (p, _)| s + p.coords) / points.len().max(1) as f64;
    let seen: Vec<Vec<Seen>> = views.par_iter().map(|view| seen_points(view, &points)).collect();
    let points: Vec<Point3<f64>> = points.into_iter().map(|(p, _)| p).collect();
    let mut corrections = vec![Isometry3::identity(); views.len()];
    for (radius, rounds) in STAGES {
        let images: Vec<Image<f32>> = views.par_iter().map(|view| contrast(view, radius)).collect();
        let mut gains = vec![1.0f64; views.len()];
        for _ in 0..rounds {
            let samples: Vec<Vec<Option<f64>>> = (0..views.len())
                .into_par_iter()
                .map(|v| brightness(&views[v], &images[v], &seen[v], &points, &corrections[v]))
                .collect();
            let means = mean_brightness(&seen, &samples, &gains, points.len());
            gains = (0..views.len()).map(|v| gain(&seen[v], &samples[v], &means)).collect();
            corrections = (0..views.len())
                .into_par_iter()
                .map(|v| {
                    let fit =
                        Fit { view: &views[v], image: &images[v], points: &points, center, means: &means };
                    fit.step(&seen[v], gains[v], &corrections[v])
                })
                .collect();
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

/// Points spread evenly over the surface, with normals.
fn surface_points(mesh: &TriMesh) -> Vec<(Point3<f64>, [f32; 3])> {
    let corner = |i: u32| Vector3::from(mesh.vertices[i as usize].map(f64::from));
    let spacing = mesh.area() / POINTS as f64;
    let mut points = Vec::with_capacity(POINTS + 64);
    let mut owed = 0.5;
    for t in &mesh.triangles {
        let [a, b, c] = t.map(corner);
        let normal = (b - a).cross(&(c - a));
        let Some(unit) = normal.try_normalize(1e-15) else { continue };
        owed += 0.5 * normal.norm() / spacing;
        while owed >= 1.0 {
            owed -= 1.0;
            // The plastic number's sequence (Roberts 2018) fills the triangle evenly.
            let n = points.len() as f64;
            let (mut s, mut t) = ((0.5 + n * 0.754_877_666).fract(), (0.5 + n * 0.569_840_291).fract());
            if s + t > 1.0 {
                (s, t) = (1.0 - s, 1.0 - t);
            }
            points.push((Point3::from(a + (b - a) * s + (c - a) * t), unit.cast::<f32>().into()));
        }
    }
    points
}

fn seen_points(view: &Prepared, points: &[(Point3<f64>, [f32; 3])]) -> Vec<Seen> {
    let seen = points.iter().zip(0u32..).filter_map(|((p, n), number)| {
        let sight = view.sight(p.coords.cast::<f32>().into(), *n)?;
        (sight.inset >= INSET && sight.cosine >= GRAZING)
            .then_some(Seen { point: number, weight: sight.cosine * view.quality })
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
        sample(image, u, v).map(|[value, ..]| value)
    };
    seen.iter().map(value).collect()
}

/// Weighted mean over the views, of points that at least two see; others have none.
fn mean_brightness(
    seen: &[Vec<Seen>],
    samples: &[Vec<Option<f64>>],
    gains: &[f64],
    points: usize,
) -> Vec<Option<f64>> {
    let mut sums = vec![(0.0f64, 0.0f64, 0u32); points];
    for ((seen, samples), gain) in seen.iter().zip(samples).zip(gains) {
        for (s, value) in seen.iter().zip(samples) {
            let Some(value) = value else { continue };
            let (sum, weight, count) = &mut sums[s.point as usize];
            *sum += f64::from(s.weight) * gain * value;
            *weight += f64::from(s.weight);
            *count += 1;
        }
    }
    sums.into_iter().map(|(sum, weight, count)| (count > 1 && weight > 0.0).then(|| sum / weight)).collect()
}

/// The factor that brings a view's brightness to the means.
fn gain(seen: &[Seen], samples: &[Option<f64>], means: &[Option<f64>]) -> f64 {
    let (mut product, mut square) = (0.0, 0.0);
    for (s, value) in seen.iter().zip(samples) {
        if let (Some(value), Some(mean)) = (value, means[s.point as usize]) {
            product += f64::from(s.weight) * value * mean;
            square += f64::from(s.weight) * value * value;
        }
    }
    if square > 0.0 { (product / square).clamp(0.4, 2.5) } else { 1.0 }
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
    fn step(&self, seen: &[Seen], gain: f64, correction: &Isometry3<f64>) -> Isometry3<f64> {
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
            let (gx, gy) = (gain * du * k.fx / q.z, gain * dv * k.fy / q.z);
            let along = rotation.inverse() * Vector3::new(gx, gy, -(gx * q.x + gy * q.y) / q.z);
            let arm = p.coords - self.center;
            let turn = along.cross(&arm);
            let row = Vector6::new(-along.x, -along.y, -along.z, turn.x, turn.y, turn.z);
            let error = (gain * value - mean) / NOISE;
            let weight = f64::from(s.weight) * (HUBER / error.abs()).min(1.0) / (NOISE * NOISE * CORRELATED);
            hessian += row * row.transpose() * weight;
            gradient += row * (weight * NOISE * error);
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
    fn points_are_spread_by_area() {
        let mesh = TriMesh {
            vertices: vec![[0.0; 3], [0.3, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..TriMesh::default()
        };
        let points = surface_points(&mesh);
        assert!(points.len().abs_diff(POINTS) < 3);
        let flat = points.iter().filter(|(p, _)| p.z == 0.0).count();
        assert!((flat as f64 / POINTS as f64 - 0.75).abs() < 0.01);
        let middle: Vector3<f64> =
            points.iter().filter(|(p, _)| p.z == 0.0).map(|(p, _)| p.coords).sum::<Vector3<f64>>()
                / flat as f64;
        assert!((middle - Vector3::new(0.1, 0.1 / 3.0, 0.0)).norm() < 1e-3, "{middle}");
    }

    #[test]
    fn samples_of_a_ramp_are_exact() {
        let image = Image::from_fn(10, 8, |x, y| 3.0 * x as f32 - 2.0 * y as f32);
        let [value, du, dv] = sample(&image, 4.3, 2.6).unwrap();
        assert!((value - (12.9 - 5.2)).abs() < 1e-6 && (du - 3.0).abs() < 1e-6 && (dv + 2.0).abs() < 1e-6);
        assert!(sample(&image, 0.5, 3.0).is_none() && sample(&image, f64::NAN, 3.0).is_none());
    }
}
