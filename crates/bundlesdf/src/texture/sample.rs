//! Which views see which vertices, how well, and in which colour.

use marching_cubes::TriMesh;
use rayon::prelude::*;

use super::view::{Prepared, bilinear};

/// Pixels from the border of the usable area at which a view counts fully.
const INSET: f32 = 6.0;

/// A vertex as one view sees it.
#[derive(Clone, Debug)]
pub(super) struct Sighting {
    pub(super) view: u16,
    /// Weight of the view's broad colour: smooth over the surface.
    pub(super) broad: f32,
    /// Score of the view's detail: angle, resolution, sharpness, residual, border.
    pub(super) detail: f32,
    /// Low-band colour, 0 to 255.
    pub(super) color: [f32; 3],
}

/// For each vertex the views that see it.
pub(super) fn sightings(mesh: &TriMesh, views: &[Prepared]) -> Vec<Vec<Sighting>> {
    let mut sightings: Vec<Vec<(Sighting, f32)>> = mesh
        .vertices
        .par_iter()
        .zip(&mesh.normals)
        .map(|(&p, &n)| {
            let seen = views.iter().zip(0u16..).filter_map(|(view, number)| {
                let sight = view.sight(p, n)?;
                let inset = ((sight.inset - 1.0) / INSET).clamp(0.0, 1.0);
                let broad = inset * sight.cosine * sight.cosine * view.quality;
                let color = bilinear(&view.low, sight.pixel);
                let sighting = Sighting { view: number, broad, detail: broad, color };
                (broad > 1e-4).then_some((sighting, sight.density))
            });
            seen.collect()
        })
        .collect();
    // Resolution counts next to the best there is.
    let best = sightings.iter().flatten().map(|(_, density)| *density).fold(f32::MIN_POSITIVE, f32::max);
    let finish = |list: &mut Vec<(Sighting, f32)>| {
        let list = std::mem::take(list).into_iter();
        list.map(|(s, density)| Sighting { detail: s.detail * (density / best).powi(2), ..s }).collect()
    };
    sightings.iter_mut().map(finish).collect()
}
