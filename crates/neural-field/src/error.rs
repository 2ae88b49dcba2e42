//! What can go wrong before or during a round.

use thiserror::Error;

/// Why a round gave no field.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum FieldError {
    /// No frame was given.
    #[error("no frames to train on: give at least one")]
    NoFrames,
    /// Frames and poses differ in number.
    #[error("{frames} frames but {poses} poses: give one pose per frame")]
    PoseCount {
        /// Number of frames.
        frames: usize,
        /// Number of poses.
        poses: usize,
    },
    /// A pose has a number that is not finite.
    #[error("the pose of frame {id} is not finite: leave the frame out or give it a pose")]
    Pose {
        /// The frame's `id`.
        id: u64,
    },
    /// A frame's images or intrinsics are unusable.
    #[error("frame {id}: {need}")]
    Frame {
        /// The frame's `id`.
        id: u64,
        /// What it would need.
        need: &'static str,
    },
    /// No pixel of any frame is in the mask and has a depth.
    #[error("no masked pixel has a depth: check mask polarity, depth units and that both have the same size")]
    NoSurface,
    /// A parameter is out of range.
    #[error("config key {key} must be {need}")]
    Config {
        /// The parameter.
        key: &'static str,
        /// What it must be.
        need: &'static str,
    },
    /// Training left the range of finite numbers.
    #[error("training diverged at step {step}: lower the learning rate")]
    Diverged {
        /// The step.
        step: usize,
    },
    /// The GPU can't do it, or did not.
    #[error("gpu: {0}")]
    Gpu(String),
    /// The caller asked to stop.
    #[error("stopped by the caller")]
    Stopped,
}
