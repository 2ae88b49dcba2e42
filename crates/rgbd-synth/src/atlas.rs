//! A texture's colours computed once for a mesh of small triangles.

use crate::Texture;
use marching_cubes::TriMesh;
use rayon::prelude::*;

/// Samples along a triangle's edge, less one.
const STEPS: usize = 2;
/// Samples of a triangle: corners and middles of the edges.
const SAMPLES: usize = (STEPS + 1) * (STEPS + 2) / 2;
/// Triangles with longer edges than this (metres) are not small: their samples would be too far apart to stand for
/// the texture.
const LONGEST: f32 = 0.008;

/// Colours at the corners and edge middles of every triangle of a mesh, between which a pixel's colour is
/// interpolated. The interpolation is a low-pass filter that is fixed to the surface, so a pixel needs one sample
/// alone, and its colour doesn't flicker while the body turns.
#[derive(Clone, Debug)]
pub(crate) struct Atlas(Vec<[[u8; 4]; SAMPLES]>);

impl Atlas {
    /// `None` when the mesh has long edges, or nothing is gained since it has few triangles.
    pub(crate) fn bake(mesh: &TriMesh, texture: &Texture) -> Option<Self> {
        let longest = mesh.triangles.iter().flat_map(|t| {
            let [a, b, c] = t.map(|v| mesh.vertices[v as usize]);
            [square(a, b), square(b, c), square(c, a)]
        });
        // Written so that a NaN fails it.
        let small = longest.fold(0.0, f32::max) <= LONGEST * LONGEST;
        if !small || mesh.triangles.len() < 2000 {
            return None;
        }
        let colors = mesh.triangles.par_iter().map(|t| triangle(mesh, texture, *t)).collect();
        Some(Self(colors))
    }

    /// RGB in `[0, 1]` on triangle `id` where its second and third corner have the weights `wb` and `wc`.
    #[inline]
    pub(crate) fn color(&self, id: usize, wb: f32, wc: f32) -> [f32; 3] {
        let samples = &self.0[id];
        let (s, t) = (wb * STEPS as f32, wc * STEPS as f32);
        let (i, j) = ((s as usize).min(STEPS - 1), (t as usize).min(STEPS - 1));
        // Rounding can put a point on the long edge beyond it.
        let i = i.min(STEPS - 1 - j);
        let (s, t) = (s - i as f32, t - j as f32);
        let corners = if s + t <= 1.0 || i + j == STEPS - 1 {
            [(i, j, 1.0 - s - t), (i + 1, j, s), (i, j + 1, t)]
        } else {
            [(i + 1, j + 1, s + t - 1.0), (i + 1, j, 1.0 - t), (i, j + 1, 1.0 - s)]
        };
        let mut sum = [0.0f32; 3];
        for (i, j, weight) in corners {
            let c = samples[place(i, j)];
            sum = std::array::from_fn(|k| sum[k] + weight * f32::from(c[k]));
        }
        sum.map(|v| v.max(0.0) * (1.0 / 255.0))
    }
}

/// Number of the sample `i` steps towards the second and `j` towards the third corner.
#[inline]
fn place(i: usize, j: usize) -> usize {
    j * (2 * STEPS + 3 - j) / 2 + i
}

fn triangle(mesh: &TriMesh, texture: &Texture, corners: [u32; 3]) -> [[u8; 4]; SAMPLES] {
    let mut out = [[0; 4]; SAMPLES];
    let [a, b, c] = corners.map(|v| mesh.vertices[v as usize]);
    let [na, nb, nc] = corners.map(|v| mesh.normals[v as usize]);
    for j in 0..=STEPS {
        for i in 0..=STEPS - j {
            let (s, t) = (i as f32 / STEPS as f32, j as f32 / STEPS as f32);
            let blend = |a: [f32; 3], b: [f32; 3], c: [f32; 3]| {
                std::array::from_fn(|k| a[k] * (1.0 - s - t) + b[k] * s + c[k] * t)
            };
            let [r, g, b] = texture.color(blend(a, b, c), blend(na, nb, nc)).map(|v| (v * 255.0 + 0.5) as u8);
            out[place(i, j)] = [r, g, b, 0];
        }
    }
    out
}

fn square(a: [f32; 3], b: [f32; 3]) -> f32 {
    (0..3).map(|k| (a[k] - b[k]).powi(2)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Object, Shape};

    #[test]
    fn samples_are_the_textures_and_blends_lie_between_them() {
        let texture = Texture {
            palette: vec![[0.1, 0.3, 0.9], [0.8, 0.6, 0.2]],
            scale: 0.02,
            octaves: 2,
            layers: vec![],
            seed: 4,
        };
        let ball = Object::from_shape(Shape::Sphere { radius: 0.03 }, texture.clone(), 0.002).unwrap();
        let (mesh, atlas) = (ball.mesh(), ball.atlas().unwrap());
        for id in (0..mesh.triangles.len()).step_by(37) {
            let [a, b, c] = mesh.triangles[id].map(|v| mesh.vertices[v as usize]);
            for (wb, wc) in
                [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.5, 0.5), (0.0, 0.5), (0.3, 0.4), (0.1, 0.85)]
            {
                let p = std::array::from_fn(|k| a[k] * (1.0 - wb - wc) + b[k] * wb + c[k] * wc);
                let (seen, asked) = (atlas.color(id, wb, wc), texture.color(p, [0.0, 0.0, 1.0]));
                for k in 0..3 {
                    assert!((seen[k] - asked[k]).abs() < 0.02, "{wb} {wc}: {seen:?} {asked:?}");
                }
            }
        }
    }

    #[test]
    fn large_triangles_are_left_to_the_texture() {
        assert!(Atlas::bake(&crate::tessellate::cuboid([0.1; 3]), &Texture::plain([0.5; 3])).is_none());
    }
}
