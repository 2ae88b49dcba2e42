//! From faces and views to texels.

use marching_cubes::TriMesh;
use rayon::prelude::*;
use rgbd_io::Image;

use crate::raster::cover;

use super::{
    atlas::Layout,
    color::{scaled, to_bytes},
    fill,
    sample::Sighting,
    view::{Prepared, bilinear},
};

/// A texel that shows no surface.
const EMPTY: u32 = u32::MAX;

/// Everything a texel's colour follows from.
pub(super) struct Scene<'a> {
    pub(super) mesh: &'a TriMesh,
    pub(super) views: &'a [Prepared],
    pub(super) sightings: &'a [Vec<Sighting>],
    /// Weights of the views at each vertex.
    pub(super) weights: Vec<Vec<(u16, f32)>>,
    /// Colour of each vertex for where no view helps, 0 to 255.
    pub(super) fill: &'a [[f32; 3]],
}

/// One view over a face's corners.
#[derive(Clone, Copy)]
struct Share {
    view: u16,
    weight: [f32; 3],
    /// What its colours are multiplied by.
    factor: [[f32; 3]; 3],
}

/// Paints the texture; also the share of the surface's texels that a view saw.
pub(super) fn paint(scene: &Scene<'_>, layout: &Layout, size: usize) -> (Image<[u8; 3]>, f64) {
    let owners = owners(layout, size);
    let mut texture = Image::filled(size, size, [0u8; 3]);
    let seen: usize = texture
        .pixels_mut()
        .par_chunks_mut(size)
        .zip(owners.par_chunks(size))
        .enumerate()
        .map(|(y, (row, owners))| {
            let mut seen = 0;
            let mut face = EMPTY;
            let mut shares = Vec::new();
            for (x, (texel, &owner)) in row.iter_mut().zip(owners).enumerate() {
                if owner == EMPTY {
                    continue;
                }
                if owner != face {
                    face = owner;
                    scene.shares(face, &mut shares);
                }
                let weights = weights_at(layout, size, face, x, y);
                let (color, known) = scene.color(face, weights, &shares);
                *texel = to_bytes(color);
                seen += usize::from(known);
            }
            seen
        })
        .sum();
    let mut covered: Vec<bool> = owners.iter().map(|&o| o != EMPTY).collect();
    let total = covered.iter().filter(|c| **c).count().max(1);
    fill::over_gaps(&mut texture, &mut covered);
    (texture, seen as f64 / total as f64)
}

fn corners(layout: &Layout, size: usize, face: u32) -> [[f64; 2]; 3] {
    // Texel centres lie at integers, texture coordinates count from the image's corner.
    layout.triangles[face as usize].map(|i| layout.uvs[i as usize].map(|v| f64::from(v) * size as f64 - 0.5))
}

/// The face that each texel's centre lies on.
fn owners(layout: &Layout, size: usize) -> Vec<u32> {
    let mut owners = vec![EMPTY; size * size];
    for face in 0..layout.triangles.len() as u32 {
        cover(corners(layout, size, face), size, size, |x, y, _| owners[y * size + x] = face);
    }
    owners
}

fn weights_at(layout: &Layout, size: usize, face: u32, x: usize, y: usize) -> [f32; 3] {
    let [a, b, c] = corners(layout, size, face);
    let (u, v) = (x as f64, y as f64);
    let area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1]);
    let side = |p: [f64; 2], q: [f64; 2]| ((q[0] - p[0]) * (v - p[1]) - (u - p[0]) * (q[1] - p[1])) / area;
    [side(b, c), side(c, a), side(a, b)].map(|w| w.clamp(0.0, 1.0) as f32)
}

impl Scene<'_> {
    fn shares(&self, face: u32, shares: &mut Vec<Share>) {
        shares.clear();
        let corners = self.mesh.triangles[face as usize].map(|i| i as usize);
        for (k, &vertex) in corners.iter().enumerate() {
            for &(view, weight) in &self.weights[vertex] {
                entry(shares, view).weight[k] = weight;
            }
        }
        for share in shares {
            let factor = |i: usize| self.sightings[i].iter().find(|s| s.view == share.view).map(|s| s.factor);
            let own = corners.map(factor);
            let any = own.iter().flatten().next().copied().unwrap_or([1.0; 3]);
            share.factor = own.map(|f| f.unwrap_or(any));
        }
    }

    /// Colour (0 to 255) of the point with barycentric `weights` on a face, and whether any view saw it.
    fn color(&self, face: u32, weights: [f32; 3], shares: &[Share]) -> ([f32; 3], bool) {
        let t = self.mesh.triangles[face as usize];
        let blend = |values: [[f32; 3]; 3]| -> [f32; 3] {
            std::array::from_fn(|k| (0..3).map(|i| weights[i] * values[i][k]).sum())
        };
        let point = blend(t.map(|i| self.mesh.vertices[i as usize])).map(f64::from);
        let unseen = blend(t.map(|i| self.fill[i as usize]));
        let (mut sum, mut total) = ([0.0f32; 3], 0.0);
        for share in shares {
            let weight = (0..3).map(|i| weights[i] * share.weight[i]).sum::<f32>();
            let view = &self.views[usize::from(share.view)];
            let Some(pixel) = (weight > 1e-4).then(|| view.project(point)).flatten() else { continue };
            let color = scaled(bilinear(&view.color, pixel), blend(share.factor));
            (0..3).for_each(|k| sum[k] += weight * color[k]);
            total += weight;
        }
        if total <= 1e-6 {
            return (unseen, false);
        }
        // Towards corners that nobody saw, colour turns into what was filled in.
        let known: f32 =
            (0..3).filter(|&i| !self.sightings[t[i] as usize].is_empty()).map(|i| weights[i]).sum();
        let color = std::array::from_fn(|k| unseen[k] + known.min(1.0) * (sum[k] / total - unseen[k]));
        (color, true)
    }
}

fn entry(shares: &mut Vec<Share>, view: u16) -> &mut Share {
    let at = shares.iter().position(|s| s.view == view).unwrap_or_else(|| {
        shares.push(Share { view, weight: [0.0; 3], factor: [[1.0; 3]; 3] });
        shares.len() - 1
    });
    &mut shares[at]
}
