//! Which parts of the field's surface the frames have seen.

use crate::field::TrainedField;
use crate::frame::FieldImages;
use marching_cubes::TriMesh;
use nalgebra::{Isometry3, Point3, Vector3};
use rayon::prelude::*;
use std::sync::Arc;

/// Frames and poses, to ask what they have seen.
pub(crate) struct Sight<'a> {
    /// Images with `cam_from_obj`.
    views: Vec<(&'a FieldImages, Isometry3<f64>)>,
    /// How far from a measured depth a point may be, metres.
    reach: f64,
}

impl<'a> Sight<'a> {
    pub(crate) fn new(frames: &'a [Arc<FieldImages>], obj_from_cam: &[Isometry3<f64>], reach: f64) -> Self {
        let views = frames.iter().zip(obj_from_cam).map(|(f, pose)| (&**f, pose.inverse())).collect();
        Self { views, reach }
    }

    /// Whether a point with this outward direction (object frame) has been looked at from outside, at the depth that
    /// was measured there.
    ///
    /// Behind the surface, further than samples reach, the field knows nothing: there it may turn to "outside" again,
    /// and this inner surface faces away from every camera that measured depth near it. Where depth is noisy it can't
    /// be told from the surface by its distance to measured points alone.
    pub(crate) fn has_seen(&self, point: [f32; 3], outward: [f32; 3]) -> bool {
        let point = Point3::from(point.map(f64::from));
        let outward = Vector3::from(outward.map(f64::from));
        self.views.iter().any(|view| self.is_seen_in(view, &point, &outward))
    }

    fn is_seen_in(
        &self,
        (image, cam_from_obj): &(&FieldImages, Isometry3<f64>),
        point: &Point3<f64>,
        outward: &Vector3<f64>,
    ) -> bool {
        let p = cam_from_obj * point;
        let faces_away = (cam_from_obj * outward).dot(&p.coords) >= 0.0;
        if p.z <= 0.0 || faces_away {
            return false;
        }
        let u = (image.fx * p.x / p.z + image.cx).round();
        let v = (image.fy * p.y / p.z + image.cy).round();
        if !(u >= 0.0 && v >= 0.0 && u < image.width as f64 && v < image.height as f64) {
            return false;
        }
        let (u, v) = (u as usize, v as usize);
        image.masked(u, v) && image.depth_at(u, v).is_some_and(|z| (f64::from(z) - p.z).abs() <= self.reach)
    }
}

impl TrainedField {
    /// Takes out the triangles of which no frame has seen any corner; the mesh must have normals.
    pub(crate) fn drop_unseen(&self, mesh: &mut TriMesh) {
        let sight = Sight::new(self.frames(), self.poses(), self.reach());
        let seen: Vec<bool> =
            mesh.vertices.par_iter().zip(&mesh.normals).map(|(p, n)| sight.has_seen(*p, *n)).collect();
        mesh.triangles.retain(|t| t.iter().any(|i| seen[*i as usize]));
        mesh.drop_unused_vertices();
    }
}
