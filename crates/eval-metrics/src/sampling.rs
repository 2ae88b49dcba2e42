//! Points on a surface.

use crate::MeshRef;
use nalgebra::Vector3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// `count` points (metres) spread over the mesh with uniform density per area.
///
/// Stratified along the cumulated area, random within a triangle; the same `seed` gives the same points.
/// Empty when the mesh has no area.
pub fn sample_surface(mesh: MeshRef<'_>, count: usize, seed: u64) -> Vec<[f64; 3]> {
    oriented_samples(mesh, count, seed).into_iter().map(|(point, _)| point).collect()
}

/// As [`sample_surface`], each point with its triangle's normal: of any length, outwards where triangles are
/// counter-clockwise from outside.
pub(crate) fn oriented_samples(mesh: MeshRef<'_>, count: usize, seed: u64) -> Vec<([f64; 3], Vector3<f64>)> {
    let mut faces = Vec::with_capacity(mesh.triangles.len());
    let mut total = 0.0;
    for triangle in mesh.triangles {
        let Some(corners) = mesh.corners(triangle) else { continue };
        let [a, b, c] = corners.map(Vector3::from);
        let (ab, ac) = (b - a, c - a);
        let area = 0.5 * ab.cross(&ac).norm();
        if area > 0.0 {
            total += area;
            faces.push((total, a, ab, ac));
        }
    }
    if faces.is_empty() || !total.is_finite() {
        return Vec::new();
    }
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut samples = Vec::with_capacity(count);
    let mut face = 0;
    for i in 0..count {
        let at = (i as f64 + rng.random::<f64>()) / count as f64 * total;
        while face + 1 < faces.len() && faces[face].0 < at {
            face += 1;
        }
        let (_, a, ab, ac) = &faces[face];
        let (r, s) = (rng.random::<f64>().sqrt(), rng.random::<f64>());
        samples.push(((a + ab * (r * (1.0 - s)) + ac * (r * s)).into(), ab.cross(ac)));
    }
    samples
}

/// One point per occupied voxel of size `voxel` (metres): the mean of the points in it.
///
/// Points that are not finite are dropped; with a `voxel` that is not positive all others are kept.
pub fn thin(points: &[[f64; 3]], voxel: f64) -> Vec<[f64; 3]> {
    let finite = points.iter().filter(|p| p.iter().all(|c| c.is_finite()));
    if voxel.partial_cmp(&0.0) != Some(std::cmp::Ordering::Greater) {
        return finite.copied().collect();
    }
    // Sorted and not hashed: the order of the result must not vary.
    let mut keyed: Vec<([i64; 3], &[f64; 3])> =
        finite.map(|p| (p.map(|c| (c / voxel).floor() as i64), p)).collect();
    keyed.sort_by_key(|(key, _)| *key);
    keyed
        .chunk_by(|a, b| a.0 == b.0)
        .map(|cell| {
            let sum: Vector3<f64> = cell.iter().map(|(_, p)| Vector3::from(**p)).sum();
            (sum / cell.len() as f64).into()
        })
        .collect()
}
