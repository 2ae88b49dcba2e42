//! Pickled annotations: HO-3D's and BEHAVE's.

use crate::check_pose;
use rgbd_io::datasets::{behave, ho3d};

pub(crate) fn run(data: &[u8]) {
    if let Ok(meta) = ho3d::parse_meta(data) {
        assert!(meta.intrinsics.is_valid());
        meta.cam_from_obj.iter().for_each(check_pose);
        assert!(meta.object.is_none_or(|name| !name.contains(['/', '.'])));
    }
    if let Ok(pose) = behave::parse_fit(data) {
        check_pose(&pose);
    }
}
