//! From faces and views to texels.

use marching_cubes::TriMesh;
use rayon::prelude::*;
use rgbd_io::Image;

use super::{
    atlas::Layout,
    color::{scaled, to_bytes},
    fill,
    raster::cover,
    sample::Sighting,
    view::{Prepared, bilinear},
};

/// Detail is a factor on the broad colour, so that it doesn't depend on how brightly the view's lamp shone there; it is
/// not trusted where that colour is darker than this (0 to 255), nor beyond this factor.
const DARK: f32 = 8.0;
const MOST: f32 = 4.0;
/// A texel that shows no surface.
const EMPTY: u32 = u32::MAX;

/// Everything a texel's colour follows from.
pub(super) struct Scene<'a> {
    pub(super) mesh: &'a TriMesh,
    pub(super) views: &'a [Prepared],
    pub(super) sightings: &'a [Vec<Sighting>],
    /// Weights of the views' detail at each vertex.
    pub(super) detail: Vec<Vec<(u16, f32)>>,
    pub(super) gains: &'a [[f32; 3]],
    /// Colour of each vertex for where no view helps, 0 to 255.
    pub(super) fill: &'a [[f32; 3]],
}

/// The weights of one view over a face's corners.
#[derive(Clone, Copy)]
struct Share {
    view: u16,
    broad: [f32; 3],
    detail: [f32; 3],
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
        let blank = |view| Share { view, broad: [0.0; 3], detail: [0.0; 3] };
        for (k, &vertex) in self.mesh.triangles[face as usize].iter().enumerate() {
            let sightings = &self.sightings[vertex as usize];
            // One vertex seen by ten views weighs no more than one seen by two.
            let sum: f32 = sightings.iter().map(|s| s.broad).sum();
            for s in sightings {
                entry(shares, s.view, blank).broad[k] = s.broad / sum;
            }
            for &(view, weight) in &self.detail[vertex as usize] {
                entry(shares, view, blank).detail[k] = weight;
            }
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
        let (mut low, mut low_sum, mut high, mut high_sum) = ([0.0f32; 3], 0.0, [0.0f32; 3], 0.0);
        for share in shares {
            let weigh = |w: [f32; 3]| (0..3).map(|i| weights[i] * w[i]).sum::<f32>();
            let (broad, detail) = (weigh(share.broad), weigh(share.detail));
            let view = &self.views[usize::from(share.view)];
            let Some(pixel) = (broad + detail > 1e-4).then(|| view.project(point)).flatten() else {
                continue;
            };
            let gain = self.gains[usize::from(share.view)];
            let base = scaled(bilinear(&view.low, pixel), gain);
            (0..3).for_each(|k| low[k] += broad * base[k]);
            low_sum += broad;
            if detail > 0.0 {
                let full = scaled(bilinear(&view.color, pixel), gain);
                (0..3).for_each(|k| high[k] += detail * (full[k] / base[k].max(DARK)).min(MOST));
                high_sum += detail;
            }
        }
        if low_sum <= 1e-4 {
            return (unseen, false);
        }
        // Towards corners that nobody saw, colour turns into what was filled in.
        let known: f32 =
            (0..3).filter(|&i| !self.sightings[t[i] as usize].is_empty()).map(|i| weights[i]).sum();
        let color = std::array::from_fn(|k| {
            let detail = if high_sum > 1e-4 { high[k] / high_sum } else { 1.0 };
            unseen[k] + known.min(1.0) * (low[k] / low_sum * detail - unseen[k])
        });
        (color, true)
    }
}

fn entry(shares: &mut Vec<Share>, view: u16, blank: impl Fn(u16) -> Share) -> &mut Share {
    let at = shares.iter().position(|s| s.view == view).unwrap_or_else(|| {
        shares.push(blank(view));
        shares.len() - 1
    });
    &mut shares[at]
}
