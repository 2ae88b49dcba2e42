//! Looking at a textured mesh.

use nalgebra::{Isometry3, Point3};
use rgbd_io::{Image, Intrinsics};

use super::{TexturedMesh, raster::cover};

/// An image of a textured mesh, without any shading.
#[derive(Clone, Debug, PartialEq)]
pub struct Rendering {
    /// RGB; black where the mesh isn't.
    pub color: Image<[u8; 3]>,
    /// z-depth of the pixel centres, metres; `0` where the mesh isn't.
    pub depth: Image<f32>,
}

impl TexturedMesh {
    /// What a camera sees of the mesh; triangles that reach behind the camera are left out.
    #[must_use]
    pub fn render(
        &self,
        k: &Intrinsics,
        (width, height): (usize, usize),
        cam_from_obj: &Isometry3<f64>,
    ) -> Rendering {
        let mut out = Rendering {
            color: Image::filled(width, height, [0; 3]),
            depth: Image::filled(width, height, 0.0),
        };
        let project = |p: &[f32; 3]| {
            let q = cam_from_obj * Point3::from(p.map(f64::from));
            k.project(q.coords.into()).map(|uv| (uv, 1.0 / q.z))
        };
        let points: Vec<_> = self.positions.iter().map(project).collect();
        for t in &self.triangles {
            let [Some(a), Some(b), Some(c)] = t.map(|i| points[i as usize]) else { continue };
            let uvs = t.map(|i| self.uvs[i as usize].map(f64::from));
            cover([a.0, b.0, c.0], width, height, |x, y, w| {
                // Linear in the image over depth: inverse depth, and texture coordinates times it.
                let shares = [w[0] * a.1, w[1] * b.1, w[2] * c.1];
                let z = 1.0 / shares.iter().sum::<f64>();
                let nearest = &mut out.depth[(x, y)];
                if *nearest == 0.0 || (z as f32) < *nearest {
                    *nearest = z as f32;
                    let uv = |k: usize| (0..3).map(|i| shares[i] * uvs[i][k]).sum::<f64>() * z;
                    out.color[(x, y)] = self.texel([uv(0), uv(1)]);
                }
            });
        }
        out
    }

    /// The texture at `(u, v)`, bilinear.
    fn texel(&self, uv: [f64; 2]) -> [u8; 3] {
        let (width, height) = self.texture.size();
        let at = |v: f64, size: usize| {
            let v = (v * size as f64 - 0.5).clamp(0.0, size as f64 - 1.0);
            let low = v as usize;
            (low, (low + 1).min(size - 1), v.fract())
        };
        let ((x0, x1, s), (y0, y1, t)) = (at(uv[0], width), at(uv[1], height));
        std::array::from_fn(|k| {
            let value = |x: usize, y: usize| f64::from(self.texture[(x, y)][k]);
            let top = value(x0, y0) * (1.0 - s) + value(x1, y0) * s;
            let bottom = value(x0, y1) * (1.0 - s) + value(x1, y1) * s;
            (top * (1.0 - t) + bottom * t).round() as u8
        })
    }
}
