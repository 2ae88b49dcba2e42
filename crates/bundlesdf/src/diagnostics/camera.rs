//! Do the intrinsics belong to these images?

use rgbd_io::RgbdFrame;

use super::{Notice, WarningKind};

/// Angles of view beyond these are no depth camera's (degrees).
const VIEW: std::ops::RangeInclusive<f64> = 15.0..=120.0;
/// Farthest of the principal point from the middle, as a share of the image.
const OFF_CENTRE: f64 = 0.15;

pub(super) fn check(frame: &RgbdFrame) -> Option<Notice> {
    let (k, (w, h)) = (&frame.intrinsics, frame.color.size());
    if w == 0 || h == 0 || !k.is_valid() {
        return None;
    }
    let (width, height) = (w as f64, h as f64);
    let off = [(k.cx / width - 0.5).abs(), (k.cy / height - 0.5).abs()];
    let view =
        [2.0 * (width / (2.0 * k.fx)).atan(), 2.0 * (height / (2.0 * k.fy)).atan()].map(f64::to_degrees);
    let message = if off.iter().any(|o| *o > OFF_CENTRE) {
        format!("the principal point ({:.1}, {:.1}) is far from the middle of {w}x{h} images", k.cx, k.cy)
    } else if view.iter().any(|v| !VIEW.contains(v)) {
        format!("the intrinsics give {w}x{h} images a view of {:.0} x {:.0} degrees", view[0], view[1])
    } else {
        return None;
    };
    Some(Notice {
        kind: WarningKind::ForeignIntrinsics,
        patience: 1,
        message,
        remedy: "give the camera matrix of images of this very size: resizing multiplies its first two rows",
    })
}
