//! JSON metadata: BOP's scenes and BEHAVE's calibration.

use crate::check_pose;
use rgbd_io::datasets::{behave, bop};

pub(crate) fn run(data: &[u8]) {
    if let Ok(cameras) = bop::parse_scene_camera(data) {
        for camera in cameras.values() {
            assert!(camera.intrinsics.is_valid());
            assert!(camera.metres_per_unit.is_finite() && camera.metres_per_unit >= 0.0);
        }
    }
    if let Ok(truth) = bop::parse_scene_gt(data) {
        truth.values().flatten().for_each(|object| check_pose(&object.cam_from_obj));
    }
    if let Ok(camera) = behave::parse_color_camera(data) {
        assert!(camera.is_valid());
    }
    if let Ok(pose) = behave::parse_camera_pose(data) {
        check_pose(&pose);
    }
}
