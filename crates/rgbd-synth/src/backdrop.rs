//! What stands behind the object: textured planes and furniture.

use crate::scene::{Camera, Clean, Light, shade};
use crate::{Object, Texture};
use nalgebra::{Isometry3, Vector3};
use rayon::prelude::*;

/// A textured plane of the camera frame.
#[derive(Clone, Debug)]
pub struct Plane {
    /// Normal, towards the camera's side; unit length.
    pub normal: [f64; 3],
    /// Distance of the plane from the camera, metres: points with `normal . p = -distance`.
    pub distance: f64,
    /// Evaluated at camera-frame points.
    pub texture: Texture,
}

/// The static scene behind the object, in the camera frame.
#[derive(Clone, Debug, Default)]
pub struct Backdrop {
    /// The nearest plane along a ray is seen. Where a ray meets none, depth is `0` and colour grey.
    pub planes: Vec<Plane>,
    /// Things that stand still, with `cam_from_body`.
    pub furniture: Vec<(Object, Isometry3<f64>)>,
}

impl Plane {
    /// z-depth (metres) at which the ray `[x, y, 1]` meets the plane in front of the camera.
    pub fn depth_along(&self, ray: [f64; 3]) -> Option<f64> {
        let slope = self.normal[0] * ray[0] + self.normal[1] * ray[1] + self.normal[2] * ray[2];
        let z = -self.distance / slope;
        (z.is_finite() && z > 0.0).then_some(z)
    }
}

impl Backdrop {
    /// The planes alone. Rays without a plane get infinite depth here; the sensor turns that into "missing".
    pub(crate) fn render(&self, camera: &Camera, light: &Light) -> Clean {
        let size = camera.width * camera.height;
        let mut clean = Clean {
            color: vec![[0.5; 3]; size],
            depth: vec![f32::INFINITY; size],
            cosine: vec![1.0; size],
            label: vec![0; size],
        };
        let rows = camera.width.max(1);
        clean
            .color
            .par_chunks_mut(rows)
            .zip(clean.depth.par_chunks_mut(rows))
            .zip(clean.cosine.par_chunks_mut(rows))
            .enumerate()
            .for_each(|(y, ((color, depth), cosine))| {
                for x in 0..camera.width {
                    let (u, v) = (x as f64, y as f64);
                    let ray = camera.k.unproject(u, v, 1.0);
                    let Some((z, plane)) = self.nearest(ray) else { continue };
                    depth[x] = z as f32;
                    cosine[x] = plane.cosine(ray);
                    let mut sum = [0.0; 3];
                    for (du, dv) in [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)] {
                        let ray = camera.k.unproject(u + du, v + dv, 1.0);
                        let c = self.nearest(ray).map_or([0.5; 3], |(z, p)| p.shaded(ray, z, light));
                        sum = std::array::from_fn(|k| sum[k] + 0.25 * c[k]);
                    }
                    color[x] = sum;
                }
            });
        clean
    }

    fn nearest(&self, ray: [f64; 3]) -> Option<(f64, &Plane)> {
        self.planes
            .iter()
            .filter_map(|p| p.depth_along(ray).map(|z| (z, p)))
            .min_by(|a, b| a.0.total_cmp(&b.0))
    }
}

impl Plane {
    fn cosine(&self, ray: [f64; 3]) -> f32 {
        -Vector3::from(self.normal).dot(&Vector3::from(ray).normalize()) as f32
    }

    fn shaded(&self, ray: [f64; 3], z: f64, light: &Light) -> [f32; 3] {
        let normal = self.normal.map(|v| v as f32);
        let albedo = self.texture.color(ray.map(|v| (v * z) as f32), normal);
        let direction = Vector3::from(ray.map(|v| v as f32)).normalize();
        // Walls are matt.
        shade(&Light { specular: 0.0, ..*light }, albedo, normal.into(), direction)
    }
}
