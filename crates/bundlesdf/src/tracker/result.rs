//! What the tracker answers for each frame.

use std::time::Duration;

use nalgebra::Isometry3;
use serde::{Deserialize, Serialize};

use super::Uncertainty;

/// How much a frame's pose can be trusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Status {
    /// Matches and depth agree with the pose.
    Tracked,
    /// Little evidence, or evidence that partly disagrees; the pose is the best guess.
    Weak,
    /// The object isn't visible or nothing fits; the pose is the last good one.
    Lost,
    /// Found again after a loss by comparison with memory frames.
    Relocalised,
}

impl Status {
    /// The word in reports.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Tracked => "tracked",
            Self::Weak => "weak",
            Self::Lost => "lost",
            Self::Relocalised => "relocalised",
        }
    }
}

/// Time spent on a frame, by stage.
#[derive(Clone, Copy, Debug, Default)]
pub struct StageTimes {
    /// Segmentation.
    pub segment: Duration,
    /// Depth clean-up, matching, RANSAC.
    pub matching: Duration,
    /// Pose graph.
    pub posegraph: Duration,
    /// Everything but waiting for the field.
    pub total: Duration,
}

/// The answer for one frame.
#[derive(Clone, Debug)]
pub struct FrameResult {
    /// Number of the frame, counted by the tracker from 0.
    pub index: usize,
    /// Name of the frame.
    pub id: String,
    /// Maps object coordinates to camera coordinates (metres); the object frame has the axes of the first camera
    /// and its origin in the middle of what the first frame saw.
    pub cam_from_obj: Isometry3<f64>,
    /// How much the pose can be trusted.
    pub status: Status,
    /// Feature matches that agree with the pose.
    pub inliers: usize,
    /// Share of the compared depth that agrees with the pose, 0 to 1.
    pub depth_agreement: f64,
    /// How well the pose is known and which motions can't be seen; `None` where no pose graph was solved: for the first
    /// frame, without memory, and when the object is lost.
    pub uncertainty: Option<Uncertainty>,
    /// Whether the frame became a keyframe.
    pub keyframe: bool,
    /// Time by stage.
    pub times: StageTimes,
}
