//! What the field is trained on.

use crate::error::FieldError;
use nalgebra::{Isometry3, Point3};

/// One frame's images, cropped to the object or whole. All images are row-major with `width * height` pixels, pixel
/// centres at integers; the camera is OpenCV (x right, y down, z forward).
///
/// Immutable and without a pose, so that one copy can be shared by every round. Leave a margin around the mask when
/// cropping: pixels just outside it tell where the object is not.
#[derive(Clone, Debug)]
pub struct FieldImages {
    /// The caller's name for the frame; appears in errors.
    pub id: u64,
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Principal point of these (cropped) images, pixels.
    pub cx: f64,
    /// Principal point of these (cropped) images, pixels.
    pub cy: f64,
    /// RGB.
    pub color: Vec<[u8; 3]>,
    /// Depth along the optical axis, metres; 0 is missing.
    pub depth: Vec<f32>,
    /// Object mask, 0 is background.
    pub mask: Vec<u8>,
    /// How far the object may reach beyond its mask, pixels: what was eroded, and the blur of its border.
    pub mask_margin: f32,
}

impl FieldImages {
    pub(crate) fn validate(&self) -> Result<(), FieldError> {
        let fail = |need| Err(FieldError::Frame { id: self.id, need });
        let n = self.width.checked_mul(self.height);
        if [self.color.len(), self.depth.len(), self.mask.len()].iter().any(|&l| Some(l) != n) {
            return fail("color, depth and mask must each have width * height pixels");
        }
        let intrinsics = [self.fx, self.fy, self.cx, self.cy];
        if !(intrinsics.iter().all(|v| v.is_finite()) && self.fx > 0.0 && self.fy > 0.0) {
            return fail("intrinsics must be finite and focal lengths positive");
        }
        if !(self.mask_margin >= 0.0 && self.mask_margin.is_finite()) {
            return fail("mask_margin must be a finite number of at least 0");
        }
        Ok(())
    }

    /// Depth at a pixel, `None` where missing.
    #[inline]
    pub(crate) fn depth_at(&self, u: usize, v: usize) -> Option<f32> {
        let z = self.depth[v * self.width + u];
        (z.is_finite() && z > 0.0).then_some(z)
    }

    #[inline]
    pub(crate) fn masked(&self, u: usize, v: usize) -> bool {
        self.mask[v * self.width + u] != 0
    }

    /// The camera ray through a pixel with z = 1.
    #[inline]
    pub(crate) fn ray(&self, u: usize, v: usize) -> [f64; 3] {
        [(u as f64 - self.cx) / self.fx, (v as f64 - self.cy) / self.fy, 1.0]
    }

    /// Inclusive box `[u0, v0, u1, v1]` of the mask.
    pub(crate) fn mask_box(&self) -> Option<[usize; 4]> {
        let mut b: Option<[usize; 4]> = None;
        for v in 0..self.height {
            for u in 0..self.width {
                if self.masked(u, v) {
                    let [u0, v0, u1, v1] = b.unwrap_or([u, v, u, v]);
                    b = Some([u0.min(u), v0.min(v), u1.max(u), v1.max(v)]);
                }
            }
        }
        b
    }

    /// Typical distance between neighbouring points of [`points`](Self::points) on a surface across the line of sight,
    /// metres; `None` without any.
    pub(crate) fn point_spacing(&self, most: usize) -> Option<f32> {
        let mut depths = Vec::new();
        let bounds = self.mask_box()?;
        let stride = raster(bounds, most);
        let [u0, v0, u1, v1] = bounds;
        for v in (v0..=v1).step_by(stride) {
            depths.extend(
                (u0..=u1).step_by(stride).filter(|u| self.masked(*u, v)).filter_map(|u| self.depth_at(u, v)),
            );
        }
        let middle = depths.len() / 2;
        let (_, z, _) =
            (!depths.is_empty()).then(|| depths.select_nth_unstable_by(middle, f32::total_cmp))?;
        Some(*z * stride as f32 / self.fx.min(self.fy) as f32)
    }

    /// About `most` masked depth points in the object frame, on a regular pixel raster.
    pub(crate) fn points(&self, obj_from_cam: &Isometry3<f64>, most: usize, out: &mut Vec<[f32; 3]>) {
        let Some([u0, v0, u1, v1]) = self.mask_box() else { return };
        let stride = raster([u0, v0, u1, v1], most);
        for v in (v0..=v1).step_by(stride) {
            for u in (u0..=u1).step_by(stride) {
                if let (true, Some(z)) = (self.masked(u, v), self.depth_at(u, v)) {
                    let p = obj_from_cam * Point3::from(self.ray(u, v).map(|c| c * f64::from(z)));
                    out.push([p.x as f32, p.y as f32, p.z as f32]);
                }
            }
        }
    }
}

/// Step between the pixels of a box (inclusive) of which about `most` are wanted.
fn raster([u0, v0, u1, v1]: [usize; 4], most: usize) -> usize {
    let area = (u1 - u0 + 1) * (v1 - v0 + 1);
    ((area as f64 / most as f64).sqrt().ceil() as usize).max(1)
}
