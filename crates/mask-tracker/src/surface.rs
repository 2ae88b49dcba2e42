//! The reconstructed surface drawn into the working grid.

use nalgebra::{Isometry3, Point3, Vector3};

use crate::SurfacePoint;
use crate::grid::{Camera, Grid, Window};

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
        let (w, h) = (window.w as i32, window.h as i32);
        let mut projected = Vec::with_capacity(model.len());
        let mut bounds = [i32::MAX, i32::MAX, i32::MIN, i32::MIN];
        for point in model {
            let p = cam_from_obj * Point3::from(point.position);
            let n = cam_from_obj.rotation * Vector3::from(point.normal);
            if n.dot(&p.coords) > -0.1 * p.coords.norm() * n.norm() && n.norm_squared() > 0.25 {
                continue;
            }
            let Some([u, v]) = camera.project([p.x, p.y, p.z]) else { continue };
            let (x, y) = window.cell(u, v);
            if x < -2 || y < -2 || x > w + 1 || y > h + 1 {
                continue;
            }
            bounds = [bounds[0].min(x), bounds[1].min(y), bounds[2].max(x), bounds[3].max(y)];
            projected.push((x, y, p.z));
        }
        if projected.is_empty() {
            return None;
        }
        // Footprint from the mean spacing of the visible points.
        let area = (bounds[2] - bounds[0] + 1) as f32 * (bounds[3] - bounds[1] + 1) as f32;
        let spacing = (area / projected.len() as f32).sqrt();
        let radius = ((0.6 * spacing).round() as i32).clamp(1, 4);
        let mut zbuffer = vec![f32::INFINITY; window.len()];
        for &(x, y, z) in &projected {
            for cy in (y - radius).max(0)..=(y + radius).min(h - 1) {
                for cx in (x - radius).max(0)..=(x + radius).min(w - 1) {
                    let i = (cy * w + cx) as usize;
                    zbuffer[i] = zbuffer[i].min(z);
                }
            }
        }
        let covered = erode(&zbuffer, w, h, radius);
        let mut near = vec![0.0; window.len()];
        let mut far = vec![0.0; window.len()];
        let mut count = 0;
        for y in 0..h {
            for x in 0..w {
                let i = (y * w + x) as usize;
                if !covered[i] {
                    continue;
                }
                let (mut lo, mut hi) = (f32::INFINITY, 0.0f32);
                for cy in (y - 1).max(0)..=(y + 1).min(h - 1) {
                    for cx in (x - 1).max(0)..=(x + 1).min(w - 1) {
                        let z = zbuffer[(cy * w + cx) as usize];
                        if z.is_finite() {
                            lo = lo.min(z);
                            hi = hi.max(z);
                        }
                    }
                }
                near[i] = lo;
                far[i] = hi;
                count += 1;
            }
        }
        (count > 0).then_some(Self { near, far, weight: confidence.clamp(0.0, 1.0) })
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

/// Cells whose whole neighbourhood of `radius` is covered: takes back what the footprint added at the silhouette.
fn erode(zbuffer: &[f32], w: i32, h: i32, radius: i32) -> Vec<bool> {
    let mut rows = vec![false; zbuffer.len()];
    for y in 0..h {
        for x in 0..w {
            rows[(y * w + x) as usize] = ((x - radius).max(0)..=(x + radius).min(w - 1))
                .all(|cx| zbuffer[(y * w + cx) as usize].is_finite());
        }
    }
    let mut out = vec![false; zbuffer.len()];
    for y in 0..h {
        for x in 0..w {
            out[(y * w + x) as usize] =
                ((y - radius).max(0)..=(y + radius).min(h - 1)).all(|cy| rows[(cy * w + x) as usize]);
        }
    }
    out
}
