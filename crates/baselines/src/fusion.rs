//! A surface from poses that somebody else found.

use crate::BaselineConfig;
use crate::observation::Observation;
use crate::tracker::Model;
use marching_cubes::TriMesh;
use nalgebra::{Isometry3, Point3, Translation3, Vector3};
use rgbd_io::RgbdFrame;

/// Fuses masked frames at given poses into one truncated signed distance field (Curless and Levoy, SIGGRAPH 1996): the
/// reconstruction of a tracker that has none of its own, as the paper gives BundleTrack one.
///
/// Voxel, truncation and the treatment of depth are those of the baselines.
#[derive(Debug)]
pub struct PoseFusion {
    config: BaselineConfig,
    /// The volume, whose origin is the middle of the first cloud, and that middle in the object's frame (metres).
    model: Option<(Model, Vector3<f64>)>,
}

impl PoseFusion {
    /// Nothing fused yet.
    pub fn new(config: &BaselineConfig) -> Self {
        Self { config: *config, model: None }
    }

    /// Fuses what [`RgbdFrame::mask`] covers, seen at `cam_from_obj`. Whether there was anything to fuse: a mask with
    /// depth in it, and a finite pose.
    pub fn add(&mut self, frame: &RgbdFrame, cam_from_obj: &Isometry3<f64>) -> bool {
        let finite = cam_from_obj.to_homogeneous().iter().all(|v| v.is_finite());
        let Some(observation) = Observation::new(frame).filter(|_| finite) else { return false };
        let (model, middle) = self.model.get_or_insert_with(|| {
            let (middle, _) = observation.bounds();
            let middle = cam_from_obj.inverse_transform_point(&Point3::from(middle)).coords;
            (Model::empty(&observation, &self.config), middle)
        });
        let cam_from_model = cam_from_obj * Translation3::from(*middle);
        model.volume.integrate(&observation.view(), &cam_from_model);
        true
    }

    /// The surface in the object's frame (metres), with normals and colours, sampled every `spacing_m` metres (between
    /// half a voxel and a voxel); open where nothing was seen.
    pub fn mesh(&self, spacing_m: f32) -> TriMesh {
        let Some((model, middle)) = &self.model else { return TriMesh::default() };
        let middle = middle.map(|v| v as f32);
        model.volume.mesh(spacing_m).transformed(|v| [v[0] + middle.x, v[1] + middle.y, v[2] + middle.z])
    }
}
