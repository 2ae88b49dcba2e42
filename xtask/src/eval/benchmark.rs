//! What is evaluated on: the datasets, and how each one's published table is computed.

use super::score::Score;
use rgbd_io::datasets::{Dataset, ycbineoat};
use serde::{Deserialize, Serialize};

/// A set of sequences with truth.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Benchmark {
    Synth,
    Ho3d,
    YcbInEoat,
    Behave,
    Bop,
    Custom,
}

/// How the dataset's mean is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum MeanOf {
    /// Unweighted mean over the groups.
    Groups,
    /// Areas under the curves of all frames together; chamfer is the mean over the groups.
    Frames,
}

impl Benchmark {
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Synth => "synth",
            _ => self.dataset().name(),
        }
    }

    pub(super) fn title(self) -> &'static str {
        match self {
            Self::Synth => "synthetic suite",
            Self::Ho3d => "HO3D",
            Self::YcbInEoat => "YCBInEOAT",
            Self::Behave => "BEHAVE",
            Self::Bop => "BOP",
            Self::Custom => "own sequences",
        }
    }

    /// The layout on disk; the synthetic suite is kept as folders of one's own.
    pub(super) fn dataset(self) -> Dataset {
        match self {
            Self::Synth | Self::Custom => Dataset::Custom,
            Self::Ho3d => Dataset::Ho3d,
            Self::YcbInEoat => Dataset::YcbInEoat,
            Self::Behave => Dataset::Behave,
            Self::Bop => Dataset::Bop,
        }
    }

    /// Upper end of the areas under the recall curves, metres: for things that are held, and for furniture.
    pub(super) fn max_error(self) -> f64 {
        if self == Self::Behave { 0.5 } else { 0.1 }
    }

    /// BEHAVE's images of 2048 x 1536 pixels are used at a third, as the authors' configuration has it.
    pub(super) fn scale_divisor(self) -> usize {
        if self == Self::Behave { 3 } else { 1 }
    }

    /// The line of the table that a video belongs to.
    pub(super) fn group_of(self, video: &str) -> String {
        let object = if self == Self::YcbInEoat { ycbineoat::object_of(video) } else { None };
        object.unwrap_or(video).to_owned()
    }

    /// The chamfer distance of its table: published ones were computed after ICP; alone, the paper's text counts, which has
    /// none.
    pub(super) fn chamfer(self, score: &Score) -> Option<f64> {
        if self.registers_surfaces() { score.cd_icp_cm } else { score.cd_cm }
    }

    pub(super) fn registers_surfaces(self) -> bool {
        matches!(self, Self::Ho3d | Self::YcbInEoat | Self::Behave)
    }

    /// The YCBInEOAT table pools all frames; all others average videos.
    pub(super) fn mean_of(self) -> MeanOf {
        if self == Self::YcbInEoat { MeanOf::Frames } else { MeanOf::Groups }
    }
}
