//! One number for many videos.

use crate::auc::auc;
use crate::protocol::PoseScores;

/// Areas of a whole dataset, percent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Summary {
    /// Area under the ADD recall curve.
    pub add_auc: f64,
    /// Area under the ADD-S recall curve.
    pub add_s_auc: f64,
}

impl Summary {
    /// The unweighted mean over videos, as in the published tables of HO3D: a short video counts as much as a long one.
    /// `None` without videos.
    pub fn per_video(videos: &[PoseScores]) -> Option<Self> {
        let mean = |area: fn(&PoseScores) -> f64| videos.iter().map(area).sum::<f64>() / videos.len() as f64;
        (!videos.is_empty()).then(|| Self { add_auc: mean(|v| v.add_auc), add_s_auc: mean(|v| v.add_s_auc) })
    }

    /// The areas under the curves of all frames of all videos together, as in the published table of YCBInEOAT: every
    /// frame counts the same. `max_error`: upper end of the areas, metres. `None` without frames.
    pub fn pooled(videos: &[PoseScores], max_error: f64) -> Option<Self> {
        let pool = |errors: fn(&PoseScores) -> &[f64]| -> Vec<f64> {
            videos.iter().flat_map(|video| errors(video).iter().copied()).collect()
        };
        let (add, add_s) = (pool(|v| &v.add_errors), pool(|v| &v.add_s_errors));
        (!add.is_empty()).then(|| Self { add_auc: auc(&add, max_error), add_s_auc: auc(&add_s, max_error) })
    }
}
