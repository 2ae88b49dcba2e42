//! What all methods have in common: the first frame, the volume, the gates.

use crate::observation::Observation;
use crate::tsdf::{TsdfOptions, TsdfVolume};
use crate::{BaselineConfig, ObjectTracker, Pose};
use marching_cubes::TriMesh;
use nalgebra::{Isometry3, Vector3};
use rgbd_io::RgbdFrame;

/// The object as known so far.
#[derive(Clone, Debug)]
pub(crate) struct Model {
    pub(crate) volume: TsdfVolume,
    /// Pose of the last tracked frame.
    pub(crate) cam_from_obj: Isometry3<f64>,
    /// Half the diagonal of the object's first view, metres.
    pub(crate) radius: f64,
}

impl Model {
    /// The first view, which defines the object's frame.
    fn new(first: &Observation, config: &BaselineConfig) -> Self {
        let mut model = Self::empty(first, config);
        model.volume.integrate(&first.view(), &model.cam_from_obj);
        model
    }

    /// A volume that suits the object of the first view, around its middle.
    pub(crate) fn empty(first: &Observation, config: &BaselineConfig) -> Self {
        let (middle, size) = first.bounds();
        let extent = Vector3::from(size).norm().max(1e-3);
        let footprint = middle[2] / first.camera.fx.min(first.camera.fy);
        let automatic = (extent / 100.0).max(0.5 * footprint).clamp(0.001, 0.05) as f32;
        let voxel_m = config.voxel_m.filter(|v| *v > 0.0 && v.is_finite()).unwrap_or(automatic);
        let options = TsdfOptions {
            voxel_m,
            truncation_m: voxel_m * config.truncation_voxels.max(2.0),
            max_weight: config.max_weight,
            // The first view may show the object from its short side.
            radius_m: 2.0 * extent as f32,
            ..TsdfOptions::default()
        };
        Self {
            volume: TsdfVolume::new(options),
            cam_from_obj: Isometry3::translation(middle[0], middle[1], middle[2]),
            radius: 0.5 * extent,
        }
    }

    /// Half the width of the band around the surface, metres: the scale of everything that is near.
    pub(crate) fn truncation(&self) -> f32 {
        self.volume.options().truncation_m
    }
}

/// How a method finds the pose of a new frame.
pub(crate) trait Registration {
    /// `cam_from_obj` of the observation, or `None` when it can't be told. `model` is what the tracked frames gave.
    fn register(&mut self, observation: &Observation, model: &Model) -> Option<Isometry3<f64>>;

    /// Takes a frame whose pose is now known.
    fn keep(&mut self, _observation: Observation, _cam_from_obj: &Isometry3<f64>) {}
}

/// A registration and the volume into which the registered frames are fused.
pub(crate) struct FusingTracker<R> {
    registration: R,
    config: BaselineConfig,
    model: Option<Model>,
}

impl<R: Registration> FusingTracker<R> {
    pub(crate) fn new(registration: R, config: BaselineConfig) -> Self {
        Self { registration, config, model: None }
    }

    fn register(&mut self, observation: &Observation) -> Option<Isometry3<f64>> {
        let Some(model) = &mut self.model else {
            let model = Model::new(observation, &self.config);
            let pose = model.cam_from_obj;
            self.model = Some(model);
            return Some(pose);
        };
        let pose = self.registration.register(observation, model)?;
        let is_near = (pose.translation.vector - model.cam_from_obj.translation.vector).norm()
            <= self.config.max_step_m
            && pose.rotation.angle_to(&model.cam_from_obj.rotation) <= self.config.max_step_rad;
        if !is_near {
            return None;
        }
        model.cam_from_obj = pose;
        model.volume.integrate(&observation.view(), &pose);
        Some(pose)
    }
}

impl<R: Registration> ObjectTracker for FusingTracker<R> {
    fn track(&mut self, frame: &RgbdFrame) -> Pose {
        if let Some(observation) = Observation::new(frame)
            && let Some(cam_from_obj) = self.register(&observation)
        {
            self.registration.keep(observation, &cam_from_obj);
            return Pose { cam_from_obj, tracked: true };
        }
        let last = self.model.as_ref().map(|m| m.cam_from_obj);
        Pose { cam_from_obj: last.unwrap_or_else(Isometry3::identity), tracked: false }
    }

    fn mesh(&self, spacing_m: f32) -> TriMesh {
        self.model.as_ref().map_or_else(TriMesh::default, |m| m.volume.mesh(spacing_m))
    }
}
