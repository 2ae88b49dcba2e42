//! Can all six motions of the object be seen?
//!
//! Depth alone leaves motions open that map the surface onto itself: the slippable motions of Gelfand and Guibas
//! (*Shape segmentation using local slippage analysis*, SGP 2004). Texture closes them; with neither, the pose along such
//! a motion is held, and wrong if the object does move so. The pose graph tells which these are.

use super::{Notice, WarningKind};
use crate::tracker::{FrameResult, MotionKind};

/// Frames in which a motion is not seen before it is told: for a moment, a handle may be out of sight.
const PATIENCE: usize = 5;

pub(super) fn check(result: &FrameResult) -> Option<Notice> {
    let held = &result.uncertainty.as_ref()?.held;
    if held.is_empty() {
        return None;
    }
    let count = |kind| held.iter().filter(|m| m.kind == kind).count();
    let told = |count: usize, one: &str| match count {
        0 => None,
        1 => Some(format!("a {one}")),
        _ => Some(format!("{count} {one}s")),
    };
    let motions = [told(count(MotionKind::Turn), "turn"), told(count(MotionKind::Slide), "slide")];
    let motions = motions.into_iter().flatten().collect::<Vec<_>>().join(" and ");
    Some(Notice {
        kind: WarningKind::UnobservableMotion,
        patience: PATIENCE,
        message: format!(
            "{motions} of the object can't be seen: it has hardly any texture and a shape that looks the same when moved"
        ),
        remedy: "its pose is held there, and wrong if it does move so: stick a few printed labels on the object, or hold \
                 it so that a handle or a corner stays in view",
    })
}
