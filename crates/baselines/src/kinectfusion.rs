//! KinectFusion on one object.
//!
//! Newcombe et al., *KinectFusion: Real-time dense surface mapping and tracking*, ISMAR 2011. Each frame is aligned by
//! projective point-to-plane ICP to the model as the last pose sees it, from coarse to fine, and fused. Everything
//! outside the mask is left out, so that the "camera motion" is that of the object. Depth alone is used: a surface of
//! revolution can turn unnoticed.

use crate::icp::{Alignment, Matches, schedule};
use crate::observation::Observation;
use crate::point_map::PointMap;
use crate::tracker::{Model, Registration};
use nalgebra::Isometry3;

#[derive(Debug, Default)]
pub(crate) struct KinectFusion;

impl Registration for KinectFusion {
    fn register(&mut self, observation: &Observation, model: &Model) -> Option<Isometry3<f64>> {
        // The model is seen in the live crop: where the live points fall.
        let see = |level: &PointMap| {
            model.volume.raycast(&model.cam_from_obj, &level.intrinsics, level.width, level.height)
        };
        let seen: Vec<PointMap> = observation.levels.iter().map(see).collect();
        let alignment = Alignment {
            live: &observation.levels,
            model: &seen,
            model_cam_from_obj: model.cam_from_obj,
            radius: model.radius,
            matches: Matches::default(),
        };
        alignment.run(&model.cam_from_obj, &schedule(model.truncation()))
    }
}
