//! Does a frame show the object well, and much of what the frame before showed?

use nalgebra::Isometry3;
use rgbd_io::{BLURRED, Mask, RgbdFrame, sharpness};
use serde::{Deserialize, Serialize};

use super::{Notice, WarningKind};
use crate::{
    checkpoint::{PoseBits, bits, pose},
    tracker::{FrameResult, Status},
};

/// Rotation between two frames beyond which they have little in common (degrees).
const TURN: f64 = 20.0;
/// Shift of the mask's box beyond which it is no slow motion, as a share of the box.
const JUMP: f64 = 0.6;
/// Bad frames before it is told.
const PATIENCE: usize = 4;
/// Fewest mask pixels to measure anything.
const PIXELS: usize = 200;
/// Half as sharp as the sharpest frame so far is blurred too, below this.
const SOFT: f64 = 0.055;

/// What the frames before looked like.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct View {
    /// Left, top, right, bottom of the mask.
    last: Option<[usize; 4]>,
    last_pose: Option<PoseBits>,
    /// Sharpness of the sharpest frame so far.
    sharpest: f64,
}

/// Whether a first mask marks the background.
pub(super) fn inverted(mask: &Mask) -> Option<Notice> {
    let (w, h) = mask.size();
    let covered = mask.pixels().iter().filter(|m| **m != 0).count() as f64 / (w * h).max(1) as f64;
    let on = |x: usize, y: usize| mask.get(x, y).is_some_and(|m| *m != 0);
    let corners = [
        (0, 0),
        (w.saturating_sub(1), 0),
        (0, h.saturating_sub(1)),
        (w.saturating_sub(1), h.saturating_sub(1)),
    ];
    let framed = corners.iter().filter(|(x, y)| on(*x, *y)).count() >= 3;
    (covered > 0.5 && framed).then(|| Notice {
        kind: WarningKind::MaskInverted,
        patience: 1,
        message: format!("the first mask marks {:.0} % of the image, corners included", 100.0 * covered),
        remedy: "the mask looks inverted: paint the object white and the background black",
    })
}

impl View {
    pub(super) fn check(
        &mut self,
        frame: &RgbdFrame,
        mask: &Mask,
        result: &FrameResult,
        has_depth: bool,
    ) -> Vec<Notice> {
        let Some(bounds) = bounds(mask) else {
            self.last = None;
            return Vec::new();
        };
        let mut notices = Vec::new();
        let jumped = self.last.replace(bounds).is_some_and(|last| shift(&last, &bounds) > JUMP);
        let tracked = matches!(result.status, Status::Tracked | Status::Weak);
        let last_pose = std::mem::replace(&mut self.last_pose, tracked.then(|| bits(&result.cam_from_obj)));
        let turned =
            last_pose.filter(|_| tracked).is_some_and(|last| turn(&pose(last), &result.cam_from_obj) > TURN);
        // In view with depth, and yet nothing like what was seen before.
        let unmatched = !tracked && !result.keyframe && has_depth && depth_share(frame, mask) > 0.5;
        if jumped || turned || unmatched {
            notices.push(Notice {
                kind: WarningKind::LittleOverlap,
                patience: PATIENCE,
                message: "the object is in view and has little in common with the frames before".into(),
                remedy: "move the object or the camera more slowly, record at a higher rate, or use a smaller --stride",
            });
        }
        if sharpness(&frame.color, mask).is_some_and(|s| self.is_blurred(s)) {
            notices.push(Notice {
                kind: WarningKind::MotionBlur,
                patience: PATIENCE,
                message: "the object is blurred".into(),
                remedy: "move it more slowly, add light, or set a shorter exposure; check the focus",
            });
        }
        notices
    }
}

impl View {
    fn is_blurred(&mut self, sharpness: f64) -> bool {
        self.sharpest = self.sharpest.max(sharpness);
        sharpness < BLURRED || (sharpness < SOFT && sharpness < 0.5 * self.sharpest)
    }
}

fn bounds(mask: &Mask) -> Option<[usize; 4]> {
    let mut b = [usize::MAX, usize::MAX, 0, 0];
    let mut count = 0;
    for y in 0..mask.height() {
        for (x, _) in mask.row(y).iter().enumerate().filter(|(_, m)| **m != 0) {
            b = [b[0].min(x), b[1].min(y), b[2].max(x), b[3].max(y)];
            count += 1;
        }
    }
    (count >= PIXELS).then_some(b)
}

/// How far the middle moved, in sizes of the smaller box.
fn shift(a: &[usize; 4], b: &[usize; 4]) -> f64 {
    let middle = |r: &[usize; 4], k: usize| (r[k] + r[k + 2]) as f64 / 2.0;
    let size = |r: &[usize; 4], k: usize| (r[k + 2] - r[k] + 1) as f64;
    (0..2).map(|k| (middle(a, k) - middle(b, k)).abs() / size(a, k).min(size(b, k))).fold(0.0, f64::max)
}

fn turn(a: &Isometry3<f64>, b: &Isometry3<f64>) -> f64 {
    a.rotation.angle_to(&b.rotation).to_degrees()
}

/// Share of the object's pixels with depth.
fn depth_share(frame: &RgbdFrame, mask: &Mask) -> f64 {
    let object = || frame.depth.pixels().iter().zip(mask.pixels()).filter(|(_, m)| **m != 0);
    object().filter(|(d, _)| **d > 0.0).count() as f64 / object().count().max(1) as f64
}
