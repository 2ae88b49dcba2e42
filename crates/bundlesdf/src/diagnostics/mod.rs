//! What is likely wrong with a video, noticed while it is tracked: each finding once, with the remedy.
//!
//! The checks cost little beside the tracking and change nothing in it. What `bundlesdf check` finds in a folder
//! beforehand is checked here too, because frames also come from cameras and programs.

mod camera;
mod depth;
mod observability;
mod view;

use std::{collections::BTreeMap, fmt};

use rgbd_io::{Cadence, Registration, RgbdFrame};
use serde::{Deserialize, Serialize};

use crate::tracker::{FrameResult, Tracker};

/// What kind of thing is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum WarningKind {
    /// Depth is not in metres.
    DepthUnits,
    /// Depth and colour were not taken through the same lens.
    DepthNotRegistered,
    /// The intrinsics belong to images of another resolution.
    ForeignIntrinsics,
    /// The first mask marks the background.
    MaskInverted,
    /// The object is nearer than `preprocess.min_depth`.
    TooNear,
    /// The object is farther than `preprocess.max_depth`.
    TooFar,
    /// Most of the object has no depth.
    NoDepth,
    /// Two frames in a row have little in common.
    LittleOverlap,
    /// The object is smeared by its motion.
    MotionBlur,
    /// Frames are missing between others.
    FrameDrops,
    /// A motion of the object can't be seen: hardly any texture, on a shape that looks the same when moved.
    UnobservableMotion,
}

/// One thing that is likely wrong, and what to do about it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Warning {
    /// What kind of thing it is.
    pub kind: WarningKind,
    /// Name of the frame in which it was noticed first.
    pub frame: String,
    /// Number of frames in which it was noticed.
    pub frames: usize,
    /// What was noticed.
    pub message: String,
    /// What to do.
    pub remedy: String,
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "from frame {} on: {}; {}", self.frame, self.message, self.remedy)
    }
}

/// Something noticed in one frame.
struct Notice {
    kind: WarningKind,
    /// Frames in which it has to be noticed before it is told: one bad frame is no fault of the video.
    patience: usize,
    message: String,
    remedy: &'static str,
}

/// Watches a run.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Diagnostics {
    frames: usize,
    noticed: BTreeMap<WarningKind, Noticed>,
    cadence: Cadence,
    view: view::View,
    /// Gathered over the first frames only, and of no use half done.
    #[serde(skip)]
    registration: Registration,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Noticed {
    first: String,
    frames: usize,
    told: Option<(String, String)>,
}

/// Frames that are looked at for the registration of depth, evenly over the first ones.
const REGISTRATION_FRAMES: usize = 6;
const REGISTRATION_STRIDE: usize = 3;

impl Diagnostics {
    /// Looks at a frame that was tracked; returns what has to be told now.
    pub fn look(&mut self, frame: &RgbdFrame, result: &FrameResult, tracker: &Tracker) -> Vec<Warning> {
        let (config, _) = tracker.settings();
        let mask = tracker.mask().filter(|m| m.size() == frame.color.size());
        let mut notices = Vec::new();
        if self.frames == 0 {
            notices.extend(camera::check(frame));
            notices.extend(mask.and_then(view::inverted));
        }
        if let Some(mask) = mask.filter(|_| frame.depth.size() == frame.color.size()) {
            let depth = depth::check(frame, mask, &config.preprocess);
            notices.extend(self.view.check(frame, mask, result, depth.is_none()));
            notices.extend(depth);
        }
        notices.extend(self.cadence.missing_before(&frame.id).map(dropped));
        notices.extend(observability::check(result));
        notices.extend(self.registration(frame));
        self.frames += 1;
        notices.into_iter().filter_map(|notice| self.note(&frame.id, notice)).collect()
    }

    /// All that was told, with the number of frames.
    #[must_use]
    pub fn into_warnings(self) -> Vec<Warning> {
        let told = |(kind, n): (WarningKind, Noticed)| {
            let (message, remedy) = n.told?;
            Some(Warning { kind, frame: n.first, frames: n.frames, message, remedy })
        };
        self.noticed.into_iter().filter_map(told).collect()
    }

    fn registration(&mut self, frame: &RgbdFrame) -> Option<Notice> {
        let last = (REGISTRATION_FRAMES - 1) * REGISTRATION_STRIDE;
        if self.frames > last || !self.frames.is_multiple_of(REGISTRATION_STRIDE) {
            return None;
        }
        self.registration.add(&frame.color, &frame.depth);
        let shift = self.registration.shift().filter(|_| self.frames == last)?;
        let [dx, dy] = shift.pixels;
        Some(Notice {
            kind: WarningKind::DepthNotRegistered,
            patience: 1,
            message: format!("depth fits colour better when shifted by ({dx}, {dy}) pixels"),
            remedy: "export depth registered to colour (the camera's software calls it aligned depth)",
        })
    }

    fn note(&mut self, frame: &str, notice: Notice) -> Option<Warning> {
        let noticed = self.noticed.entry(notice.kind).or_insert_with(|| Noticed {
            first: frame.to_owned(),
            frames: 0,
            told: None,
        });
        noticed.frames += 1;
        if noticed.told.is_some() || noticed.frames < notice.patience {
            return None;
        }
        let (message, remedy) = (notice.message, notice.remedy.to_owned());
        noticed.told = Some((message.clone(), remedy.clone()));
        Some(Warning {
            kind: notice.kind,
            frame: noticed.first.clone(),
            frames: noticed.frames,
            message,
            remedy,
        })
    }
}

fn dropped(frames: usize) -> Notice {
    Notice {
        kind: WarningKind::FrameDrops,
        patience: 1,
        message: format!("about {frames} frames are missing before it"),
        remedy: "record with fewer pixels, to a faster disk or without other programs; slow motion tolerates drops",
    }
}
