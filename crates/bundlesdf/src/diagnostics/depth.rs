//! Is the object's depth there, in metres, and within the limits?

use rgbd_io::{Mask, RgbdFrame};

use super::{Notice, WarningKind};
use crate::config::PreprocessConfig;

/// Median distances that no depth camera measures: the unit is not the metre.
const PLAUSIBLE: std::ops::RangeInclusive<f32> = 0.05..=20.0;
/// Share of the object's pixels that has to be without usable depth.
const MOST: f64 = 0.8;
/// Bad frames before it is told.
const PATIENCE: usize = 5;

pub(super) fn check(frame: &RgbdFrame, mask: &Mask, config: &PreprocessConfig) -> Option<Notice> {
    let object = mask.pixels().iter().filter(|m| **m != 0).count();
    if object < config.min_mask_pixels {
        return None;
    }
    let inside = frame.depth.pixels().iter().zip(mask.pixels()).filter(|(_, m)| **m != 0);
    let mut depth: Vec<f32> = inside.map(|(d, _)| *d).filter(|d| d.is_finite() && *d > 0.0).collect();
    let share = |n: usize| n as f64 / object as f64;
    if share(depth.len()) < 1.0 - MOST {
        return Some(Notice {
            kind: WarningKind::NoDepth,
            patience: PATIENCE,
            message: format!("only {:.0} % of the object has depth", 100.0 * share(depth.len())),
            remedy: "hold the object farther away (0.3 m for most cameras), avoid shiny, black and transparent \
                     surfaces, and check that depth is recorded at all",
        });
    }
    let near = depth.iter().filter(|d| **d < config.min_depth).count();
    let far = depth.iter().filter(|d| **d > config.max_depth).count();
    let middle = depth.len() / 2;
    let median = *depth.select_nth_unstable_by(middle, f32::total_cmp).1;
    let of_depth = |n: usize| n as f64 / (2 * middle).max(1) as f64;
    if !PLAUSIBLE.contains(&median) {
        return Some(Notice {
            kind: WarningKind::DepthUnits,
            patience: 1,
            message: format!("the object's median depth of {median} m is no distance of a depth camera"),
            remedy: "pass --depth-scale with the metres per unit of the depth files (0.001 for millimetres), or \
                     convert depth to metres",
        });
    }
    if of_depth(near) > MOST {
        return Some(Notice {
            kind: WarningKind::TooNear,
            patience: PATIENCE,
            message: format!(
                "the object at {median:.2} m is nearer than preprocess.min_depth = {}",
                config.min_depth
            ),
            remedy: "hold it farther away, or lower preprocess.min_depth in the config",
        });
    }
    (of_depth(far) > MOST).then(|| Notice {
        kind: WarningKind::TooFar,
        patience: PATIENCE,
        message: format!(
            "the object at {median:.2} m is farther than preprocess.max_depth = {}",
            config.max_depth
        ),
        remedy: "hold it nearer, or raise preprocess.max_depth in the config",
    })
}
