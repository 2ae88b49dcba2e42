//! Points and normals on a grid of pixels.

use crate::depth::largest_step;
use crate::rigid::{Rigid, cross, dot, scale, sub, unit};
use nalgebra::Isometry3;
use rgbd_io::{Image, Intrinsics};

/// NaN marks what is missing: every comparison with it fails.
pub(crate) const MISSING: [f32; 3] = [f32::NAN; 3];
/// A surface seen under more than 80 degrees has no normal: differences of depth are noise there.
const MIN_COS: f32 = 0.17;

/// A surface as one camera sees it: a point and a unit normal for each pixel, NaN where there is none.
#[derive(Clone, Debug)]
pub struct PointMap {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// The camera of these pixels.
    pub intrinsics: Intrinsics,
    /// Points, metres, row after row.
    pub points: Vec<[f32; 3]>,
    /// Unit normals that point towards the camera, row after row; NaN wherever the point is, and where unknown.
    pub normals: Vec<[f32; 3]>,
}

impl PointMap {
    /// Number of pixels with a point and a normal.
    pub fn count(&self) -> usize {
        self.normals.iter().filter(|n| !n[0].is_nan()).count()
    }

    /// Depth (metres, 0 = missing) to points in the camera's frame, normals from central differences; none at the rim.
    pub(crate) fn from_depth(depth: &Image<f32>, k: &Intrinsics) -> Self {
        let (width, height) = depth.size();
        let (inv_fx, inv_fy) = (1.0 / k.fx as f32, 1.0 / k.fy as f32);
        let (cx, cy) = (k.cx as f32, k.cy as f32);
        let mut points = Vec::with_capacity(width * height);
        for y in 0..height {
            for (x, &z) in depth.row(y).iter().enumerate() {
                let p = [(x as f32 - cx) * inv_fx * z, (y as f32 - cy) * inv_fy * z, z];
                points.push(if z > 0.0 { p } else { MISSING });
            }
        }
        let mut map = Self { width, height, intrinsics: *k, points, normals: vec![MISSING; width * height] };
        for y in 0..height {
            for x in 0..width {
                if let Some(n) = map.normal_at(x, y) {
                    map.normals[y * width + x] = n;
                }
            }
        }
        map
    }

    fn normal_at(&self, x: usize, y: usize) -> Option<[f32; 3]> {
        let at = y * self.width + x;
        let p = self.points[at];
        let step = largest_step(p[2], &self.intrinsics);
        if x == 0 || y == 0 || x + 1 >= self.width || y + 1 >= self.height {
            return None;
        }
        let neighbour = |i: usize| {
            let q = self.points[i];
            ((q[2] - p[2]).abs() <= step).then_some(q)
        };
        let du = sub(neighbour(at + 1)?, neighbour(at - 1)?);
        let dv = sub(neighbour(at + self.width)?, neighbour(at - self.width)?);
        let n = unit(cross(du, dv))?;
        let n = if dot(n, p) > 0.0 { scale(n, -1.0) } else { n };
        let cos = -dot(n, p) / dot(p, p).sqrt();
        (cos > MIN_COS).then_some(n)
    }

    /// The same surface in another frame.
    pub(crate) fn moved(&self, b_from_a: &Isometry3<f64>) -> Self {
        let rigid = Rigid::new(b_from_a);
        Self {
            points: self.points.iter().map(|&p| rigid.point(p)).collect(),
            normals: self.normals.iter().map(|&n| rigid.direction(n)).collect(),
            ..*self
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tilted_plane_has_its_normal_and_missing_depth_has_none() {
        let k = Intrinsics { fx: 200.0, fy: 210.0, cx: 15.5, cy: 11.5 };
        let normal = unit([0.3, -0.2, -1.0]).unwrap();
        let depth = Image::from_fn(32, 24, |x, y| {
            let ray = k.unproject(x as f64, y as f64, 1.0).map(|v| v as f32);
            if x == 7 && y == 9 { 0.0 } else { -0.5 / dot(normal, ray) }
        });
        let map = PointMap::from_depth(&depth, &k);
        assert!(map.points[9 * 32 + 7][2].is_nan() && map.normals[9 * 32 + 7][0].is_nan());
        // The rim and the neighbours of the missing pixel have no differences.
        assert_eq!(map.count(), 30 * 22 - 5);
        assert!(map.normals.iter().filter(|n| !n[0].is_nan()).all(|&n| dot(n, normal) > 0.9999));
    }
}
