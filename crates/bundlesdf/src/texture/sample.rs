//! Which views see which points of the surface, how well, and in which colour.

use marching_cubes::TriMesh;
use nalgebra::Vector3;
use rayon::prelude::*;

use super::view::{Prepared, bilinear};

/// Pixels from the border of the usable area at which a view counts fully.
const INSET: f32 = 6.0;

/// A point of the surface.
#[derive(Clone, Copy, Debug)]
pub(super) struct SurfacePoint {
    pub(super) position: [f32; 3],
    /// Unit length.
    pub(super) normal: [f32; 3],
}

/// The vertices, in their order.
pub(super) fn vertices(mesh: &TriMesh) -> Vec<SurfacePoint> {
    let pairs = mesh.vertices.iter().zip(&mesh.normals);
    pairs.map(|(&position, &normal)| SurfacePoint { position, normal }).collect()
}

/// About `count` points spread evenly over the surface, with interpolated normals.
pub(super) fn spread(mesh: &TriMesh, count: usize) -> Vec<SurfacePoint> {
    let vector = |v: [f32; 3]| Vector3::from(v.map(f64::from));
    let spacing = mesh.area() / count as f64;
    let mut points = Vec::with_capacity(count + 64);
    let mut owed = 0.5;
    for t in &mesh.triangles {
        let [a, b, c] = t.map(|i| vector(mesh.vertices[i as usize]));
        let normals = t.map(|i| vector(mesh.normals[i as usize]));
        owed += 0.5 * (b - a).cross(&(c - a)).norm() / spacing;
        while owed >= 1.0 {
            owed -= 1.0;
            // The plastic number's sequence (Roberts 2018) fills the triangle evenly.
            let n = points.len() as f64;
            let (mut s, mut t) = ((0.5 + n * 0.754_877_666).fract(), (0.5 + n * 0.569_840_291).fract());
            if s + t > 1.0 {
                (s, t) = (1.0 - s, 1.0 - t);
            }
            let normal = normals[0] * (1.0 - s - t) + normals[1] * s + normals[2] * t;
            let Some(normal) = normal.try_normalize(1e-9) else { continue };
            let position = a + (b - a) * s + (c - a) * t;
            points.push(SurfacePoint { position: position.cast().into(), normal: normal.cast().into() });
        }
    }
    points
}

/// A point as one view sees it.
#[derive(Clone, Debug)]
pub(super) struct Sighting {
    pub(super) view: u16,
    /// Weight of the view's broad colour: smooth over the surface.
    pub(super) broad: f32,
    /// Score of the view's detail: angle, resolution, sharpness, residual, border.
    pub(super) detail: f32,
    /// Colour, 0 to 255.
    pub(super) color: [f32; 3],
    /// What red, green and blue are multiplied by, here, to give the object's own colour.
    pub(super) factor: [f32; 3],
}

/// For each point the views that see it.
pub(super) fn sightings(points: &[SurfacePoint], views: &[Prepared]) -> Vec<Vec<Sighting>> {
    let mut sightings: Vec<Vec<(Sighting, f32)>> = points
        .par_iter()
        .map(|point| {
            let seen = views.iter().zip(0u16..).filter_map(|(view, number)| {
                let sight = view.sight(point.position, point.normal)?;
                let inset = ((sight.inset - 1.0) / INSET).clamp(0.0, 1.0);
                let broad = inset * sight.cosine * sight.cosine * view.quality;
                let color = bilinear(&view.fine, sight.pixel);
                let sighting = Sighting { view: number, broad, detail: broad, color, factor: [1.0; 3] };
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_are_spread_by_area() {
        const POINTS: usize = 5000;
        let mut mesh = TriMesh {
            vertices: vec![[0.0; 3], [0.3, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..TriMesh::default()
        };
        mesh.compute_normals();
        let points: Vec<_> =
            spread(&mesh, POINTS).into_iter().map(|p| Vector3::from(p.position.map(f64::from))).collect();
        assert!(points.len().abs_diff(POINTS) < 3);
        let flat = points.iter().filter(|p| p.z == 0.0).count();
        assert!((flat as f64 / POINTS as f64 - 0.75).abs() < 0.01);
        let middle: Vector3<f64> =
            points.iter().filter(|p| p.z == 0.0).copied().sum::<Vector3<f64>>() / flat as f64;
        assert!((middle - Vector3::new(0.1, 0.1 / 3.0, 0.0)).norm() < 1e-3, "{middle}");
    }
}
