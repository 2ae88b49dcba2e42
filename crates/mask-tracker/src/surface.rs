//! The reconstructed surface drawn into the working grid.

use nalgebra::{Isometry3, Point3};

use crate::SurfacePoint;
use crate::grid::{Camera, Grid, Window};
use crate::math::Rigid;

/// Depth range of the model under every cell (over its 3x3 neighbourhood, so that a pose error of a cell on a
/// slanted surface is no disagreement); `near` is 0 where the model covers nothing.
pub(crate) struct Surface {
    pub(crate) near: Vec<f32>,
    pub(crate) far: Vec<f32>,
    /// Weight of the model's testimony, 0..1: the caller's confidence times the agreement with the depth image.
    pub(crate) weight: f32,
}

/// Signed distance (m) of an observed depth to the model: negative in front of it, positive behind.
#[inline]
pub(crate) fn offset(z: f32, near: f32, far: f32) -> f32 {
    if z < near {
        z - near
    } else if z > far {
        z - far
    } else {
        0.0
    }
}

impl Surface {
    /// Draws front-facing points with a z-buffer; `None` when nothing falls into the window.
    pub(crate) fn draw(
        model: &[SurfacePoint],
        cam_from_obj: &Isometry3<f32>,
        camera: &Camera,
        window: &Window,
        confidence: f32,
    ) -> Option<Self> {
        let (w, h) = (window.w, window.h);
        let motion = Rigid::new(cam_from_obj);
        let eye = cam_from_obj.inverse_transform_point(&Point3::origin()).coords.into();
        let mut bounds = [i32::MAX, i32::MAX, i32::MIN, i32::MIN];
        let mut count = 0usize;
        let mut nearest = vec![f32::INFINITY; w * h];
        for point in model.iter().filter(|p| faces(p, eye)) {
            let p = motion.apply(point.position);
            let Some([u, v]) = camera.project(p) else { continue };
            let (x, y) = window.cell(u, v);
            if x < -2 || y < -2 || x > w as i32 + 1 || y > h as i32 + 1 {
                continue;
            }
            bounds = [bounds[0].min(x), bounds[1].min(y), bounds[2].max(x), bounds[3].max(y)];
            count += 1;
            if let Some(i) = window.index((x, y)) {
                nearest[i] = nearest[i].min(p[2]);
            }
        }
        if count == 0 {
            return None;
        }
        // Footprint from the mean spacing of the visible points.
        let area = (bounds[2] - bounds[0] + 1) as f32 * (bounds[3] - bounds[1] + 1) as f32;
        let spacing = (area / count as f32).sqrt();
        let radius = ((0.6 * spacing).round() as usize).clamp(1, 4);
        // Every point a square of that radius; then back by the radius what that added at the silhouette.
        let zbuffer = extreme(&nearest, (w, h), radius, smaller);
        let covered = extreme(&zbuffer, (w, h), radius, larger);
        let behind: Vec<f32> = zbuffer.iter().map(|&z| if z.is_finite() { z } else { 0.0 }).collect();
        let mut near = extreme(&zbuffer, (w, h), 1, smaller);
        let mut far = extreme(&behind, (w, h), 1, larger);
        let mut any = false;
        for ((near, far), covered) in near.iter_mut().zip(&mut far).zip(&covered) {
            let inside = covered.is_finite();
            any |= inside;
            *near = if inside { *near } else { 0.0 };
            *far = if inside { *far } else { 0.0 };
        }
        any.then_some(Self { near, far, weight: confidence.clamp(0.0, 1.0) })
    }

    /// Lowers the weight when the depth image contradicts the model as a whole, as with a wrong pose: of the cells
    /// it covers and `relevant` selects, those in front of it may be an occluder, but those behind can't be.
    pub(crate) fn weigh(&mut self, grid: &Grid, relevant: impl Fn(usize) -> bool) {
        let (mut agree, mut total) = (0.0f32, 0.0f32);
        for i in 0..self.near.len() {
            let z = grid.depth[i];
            if self.near[i] > 0.0 && z > 0.0 && relevant(i) {
                let d = offset(z, self.near[i], self.far[i]);
                total += if d < -0.02 { 0.3 } else { 1.0 };
                agree += if d.abs() < 0.012 { 1.0 } else { 0.0 };
            }
        }
        if total > 8.0 {
            self.weight *= ((agree / total - 0.3) / 0.35).clamp(0.0, 1.0);
        }
    }
}

/// Whether the point's surface can be seen from `eye` (object frame); one without a normal always can. A little
/// beyond the horizon counts: normals are noisy.
#[inline]
fn faces(point: &SurfacePoint, eye: [f32; 3]) -> bool {
    let n = point.normal;
    let ray: [f32; 3] = std::array::from_fn(|k| point.position[k] - eye[k]);
    let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let (along, size) = (dot(n, ray), dot(n, n));
    size <= 0.25 || (along < 0.0 && along * along >= 0.01 * size * dot(ray, ray))
}

#[inline]
pub(crate) fn smaller(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

#[inline]
fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// The extreme value within the square of `radius` around every cell, by rows, then by columns.
pub(crate) fn extreme(
    from: &[f32],
    (w, h): (usize, usize),
    radius: usize,
    pick: impl Fn(f32, f32) -> f32 + Copy,
) -> Vec<f32> {
    let shifted = |to: &mut [f32], from: &[f32]| {
        for (a, b) in to.iter_mut().zip(from) {
            *a = pick(*a, *b);
        }
    };
    let mut rows = from.to_vec();
    for (to, from) in rows.chunks_exact_mut(w).zip(from.chunks_exact(w)) {
        for k in 1..=radius.min(w.saturating_sub(1)) {
            shifted(&mut to[k..], &from[..w - k]);
            shifted(&mut to[..w - k], &from[k..]);
        }
    }
    let mut both = rows.clone();
    for k in 1..=radius.min(h.saturating_sub(1)) {
        shifted(&mut both[k * w..], &rows[..(h - k) * w]);
        shifted(&mut both[..(h - k) * w], &rows[k * w..]);
    }
    both
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn extremes_are_those_of_the_square() {
        let (w, h) = (7usize, 5usize);
        let values: Vec<f32> = (0..w * h).map(|i| ((i * 37) % 23) as f32).collect();
        for radius in [1usize, 2, 6] {
            let found = extreme(&values, (w, h), radius, smaller);
            for i in 0..w * h {
                let near = |j: &usize| (j % w).abs_diff(i % w) <= radius && (j / w).abs_diff(i / w) <= radius;
                let expected = (0..w * h).filter(near).map(|j| values[j]).fold(f32::INFINITY, f32::min);
                assert_eq!(found[i], expected);
            }
        }
    }

    #[test]
    fn what_faces_away_is_not_drawn() {
        let camera = Camera { fx: 50.0, fy: 50.0, cx: 19.5, cy: 19.5 };
        let window = Window { x0: 0, y0: 0, step: 1, w: 40, h: 40 };
        let plate = |z: f32, nz: f32| -> Vec<SurfacePoint> {
            (0..400)
                .map(|k| SurfacePoint {
                    position: [(k % 20) as f32 * 0.01 - 0.1, (k / 20) as f32 * 0.01 - 0.1, z],
                    normal: [0.0, 0.0, nz],
                })
                .collect()
        };
        let draw =
            |points: &[SurfacePoint]| Surface::draw(points, &Isometry3::identity(), &camera, &window, 1.0);
        let front = draw(&plate(0.5, -1.0)).unwrap();
        assert_eq!((front.near[20 * 40 + 20], front.far[20 * 40 + 20]), (0.5, 0.5));
        assert_eq!(front.near[0], 0.0);
        assert!(draw(&plate(0.5, 1.0)).is_none());
        assert!(draw(&plate(0.5, 0.0)).is_some());
    }
}
