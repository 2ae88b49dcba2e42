//! How often each part of a mesh was observed.

use marching_cubes::TriMesh;
use nalgebra::Point3;
use rayon::prelude::*;
use serde::Serialize;

use crate::{depth::depth_sigma, texture::View};

/// A vertex may differ from the measured depth by this and three standard deviations of the sensor (metres).
const SLACK: f64 = 0.004;
/// Least cosine at which a surface counts as seen.
const GRAZING: f64 = 0.1;
/// Rings of vertices over which gaps between observed vertices are bridged.
const BRIDGE: usize = 3;

/// Observations of every vertex of a mesh.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Observations {
    /// Number of views whose measured depth agrees with the vertex.
    pub counts: Vec<u32>,
    /// 0 = never seen, towards 1 with every view, sooner with views that look straight at it:
    /// `1 - exp(-sum of cosines)`.
    pub confidence: Vec<f32>,
}

/// Counts for each vertex of `mesh` (object frame) the views that measured it: within the mask, facing the camera, at
/// the depth that the sensor saw.
#[must_use]
pub fn observe(mesh: &TriMesh, views: &[View]) -> Observations {
    let mut mesh = std::borrow::Cow::Borrowed(mesh);
    if !mesh.has_normals() {
        mesh.to_mut().compute_normals();
    }
    let cameras: Vec<_> = views.iter().map(|v| (v, v.obj_from_cam.inverse())).collect();
    let seen = mesh.vertices.par_iter().zip(&mesh.normals).map(|(p, n)| {
        let p = Point3::from(p.map(f64::from));
        let (mut count, mut cosines) = (0, 0.0);
        for (view, cam_from_obj) in &cameras {
            let ray = Point3::from(view.obj_from_cam.translation.vector) - p;
            let along = ray.x * f64::from(n[0]) + ray.y * f64::from(n[1]) + ray.z * f64::from(n[2]);
            let cosine = along / ray.norm();
            if cosine > GRAZING && measured(view, (cam_from_obj * p).coords.into()) {
                count += 1;
                cosines += cosine;
            }
        }
        (count, (1.0 - (-cosines).exp()) as f32)
    });
    let (counts, confidence) = seen.unzip();
    Observations { counts, confidence }
}

/// Whether the sensor measured the camera-frame point.
fn measured(view: &View, p: [f64; 3]) -> bool {
    let Some([u, v]) = view.intrinsics.project(p) else { return false };
    if u < -0.5 || v < -0.5 {
        return false;
    }
    let (x, y) = (u.round() as usize, v.round() as usize);
    let (Some(&mask), Some(&depth)) = (view.mask.get(x, y), view.depth.get(x, y)) else { return false };
    let z = f64::from(depth);
    mask != 0 && z > 0.0 && (z - p[2]).abs() <= SLACK + 3.0 * depth_sigma(z)
}

/// The mesh without what fewer than `least` views saw. Small gaps between observed vertices stay bridged, so that
/// noise doesn't perforate the surface.
pub(super) fn trimmed(mesh: &TriMesh, counts: &[u32], least: u32) -> TriMesh {
    let mut kept: Vec<bool> = counts.iter().map(|&c| c >= least).collect();
    // Closing: grown by some rings, shrunk by as many.
    for grow in [true, false] {
        for _ in 0..BRIDGE {
            let before = kept.clone();
            for t in &mesh.triangles {
                for &i in t {
                    if t.iter().any(|&j| before[j as usize] == grow) {
                        kept[i as usize] = grow;
                    }
                }
            }
        }
    }
    let mut mesh = mesh.clone();
    mesh.triangles.retain(|t| t.iter().all(|&i| kept[i as usize]));
    mesh.drop_unused_vertices();
    mesh
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Isometry3;
    use rgbd_io::{Image, Intrinsics};

    /// A ball of 10 cm seen from the front: depth of its front, exact.
    fn front() -> View {
        let k = Intrinsics { fx: 200.0, fy: 200.0, cx: 79.5, cy: 59.5 };
        let depth = Image::from_fn(160, 120, |x, y| {
            let r = k.unproject(x as f64, y as f64, 1.0);
            // |t r - (0, 0, 0.5)| = 0.1
            let (a, b, c) = (r[0] * r[0] + r[1] * r[1] + 1.0, -0.5, 0.25 - 0.01);
            let root = b * b - a * c;
            if root > 0.0 { ((-b - root.sqrt()) / a) as f32 } else { 0.0 }
        });
        View {
            color: Image::filled(160, 120, [9; 3]),
            mask: depth.map(|&z| u8::from(z > 0.0)),
            depth,
            intrinsics: k,
            obj_from_cam: Isometry3::translation(0.0, 0.0, -0.5),
        }
    }

    fn ball() -> TriMesh {
        marching_cubes::extract_fn([40; 3], [-0.12; 3], 0.24 / 39.0, 0.0, |p| {
            p.iter().map(|v| v * v).sum::<f32>().sqrt() - 0.1
        })
    }

    #[test]
    fn the_front_is_seen_and_the_back_is_not() {
        let mesh = ball();
        let mut hand = front();
        // The right half of a second view shows something nearer.
        for y in 0..120 {
            (80..160).for_each(|x| hand.depth[(x, y)] -= 0.05);
        }
        let seen = observe(&mesh, &[front(), hand]);
        for (p, (&count, &confidence)) in mesh.vertices.iter().zip(seen.counts.iter().zip(&seen.confidence)) {
            let expected = match p {
                [_, _, z] if *z > 0.0 => 0,
                [x, y, z] if x.hypot(*y) > 0.08 || z.abs() < 0.03 || x.abs() < 0.005 => continue,
                [x, ..] => {
                    if *x > 0.0 {
                        1
                    } else {
                        2
                    }
                }
            };
            assert_eq!(count, expected, "{p:?}");
            assert!((confidence > 0.0) == (count > 0) && confidence < 1.0);
        }
        let front = trimmed(&mesh, &seen.counts, 1).largest_component();
        let (low, high) = front.bounds().unwrap();
        assert!(low[2] < -0.095 && high[2] < 0.02, "{low:?} {high:?}");
        assert_eq!(front.rims().len(), 1);
    }

    #[test]
    fn a_vertex_that_noise_hid_leaves_no_hole() {
        let mesh = ball();
        let mut counts = vec![2; mesh.vertices.len()];
        counts[100] = 0;
        assert_eq!(trimmed(&mesh, &counts, 1).triangles.len(), mesh.triangles.len());
        assert!(trimmed(&mesh, &vec![0; mesh.vertices.len()], 1).triangles.is_empty());
    }
}
