//! Normals for shading: smoothed as far as that explains the light better.
//!
//! A reconstructed surface has bumps that the object hasn't. Light that is divided out by the normals of such bumps
//! leaves blotches, and one can't tell by the surface alone which bumps are real: but those that are change their
//! brightness when the object turns in the light. The scale of smoothing is the one at which the shading leaves the
//! least of that change unexplained.

use marching_cubes::TriMesh;
use nalgebra::Vector3;

use super::{light, sample, view::Prepared};

/// Rings of neighbours over which normals are averaged, tried in this order until one explains no more.
const RINGS: [usize; 5] = [0, 2, 5, 10, 20];
/// Surface points to judge by.
const POINTS: usize = 3_000;

/// `mesh` with normals that its shading in the views is best explained by.
pub(super) fn for_shading(mesh: &TriMesh, views: &[Prepared]) -> TriMesh {
    let mut tried = mesh.clone();
    let mut best = (f64::INFINITY, mesh.normals.clone());
    let mut done = 0;
    for rings in RINGS {
        while done < rings {
            tried.normals = averaged(&tried);
            done += 1;
        }
        let left = light::unexplained(&sample::spread(&tried, POINTS), views);
        // Written so that a NaN fails it.
        let better = left < best.0;
        if !better {
            break;
        }
        best = (left, tried.normals.clone());
    }
    tried.normals = best.1;
    tried
}

/// Normals averaged over the faces around each vertex.
fn averaged(mesh: &TriMesh) -> Vec<[f32; 3]> {
    let normal = |i: u32| Vector3::from(mesh.normals[i as usize]);
    let mut sums: Vec<Vector3<f32>> = mesh.normals.iter().map(|n| Vector3::from(*n)).collect();
    for t in &mesh.triangles {
        let sum = normal(t[0]) + normal(t[1]) + normal(t[2]);
        t.iter().for_each(|&i| sums[i as usize] += sum);
    }
    let unit = |(sum, old): (Vector3<f32>, &[f32; 3])| sum.try_normalize(1e-6).map_or(*old, Into::into);
    sums.into_iter().zip(&mesh.normals).map(unit).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn averages_are_unit_vectors_with_less_noise() {
        let ball = marching_cubes::extract_fn([24; 3], [-1.0; 3], 2.0 / 23.0, 0.0, |p| {
            p.iter().map(|v| v * v).sum::<f32>().sqrt() - 0.7
        });
        let radial = |p: &[f32; 3]| Vector3::from(*p).normalize();
        let mut noisy = ball.clone();
        noisy.normals = (0u32..)
            .zip(&ball.vertices)
            .map(|(i, p)| {
                let noise = Vector3::from(
                    [1.0, 2.0, 3.0].map(|k| ((i as f32 * k * 12.9898).sin() * 43758.5).fract()),
                );
                (radial(p) + 0.5 * noise).normalize().into()
            })
            .collect();
        let error = |mesh: &TriMesh| {
            let angles =
                mesh.vertices.iter().zip(&mesh.normals).map(|(p, n)| radial(p).angle(&Vector3::from(*n)));
            angles.sum::<f32>() / mesh.vertices.len() as f32
        };
        let before = error(&noisy);
        for _ in 0..3 {
            noisy.normals = averaged(&noisy);
        }
        assert!(error(&noisy) < 0.4 * before, "{} {before}", error(&noisy));
        assert!(noisy.normals.iter().all(|n| (Vector3::from(*n).norm() - 1.0).abs() < 1e-4));
    }
}
