//! A run that was stopped goes on where it was, with the same result bit for bit.
//!
//! A checkpoint holds what can't be computed again: poses, masks and matches of the keyframes, the segmentation's
//! memory, counters. What can be computed again is: the observations from the video and the stored masks, and the
//! newest field by training its round once more, which gives the same bits. That keeps a checkpoint near a megabyte
//! instead of a hundred, and going on costs at most reading the keyframes' frames, one round, and the frames since
//! the checkpoint.

mod envelope;
mod folder;
mod packed_mask;
mod pose;
mod state;

pub use folder::{Earlier, Manifest, StateFolder};
pub(crate) use folder::{is_in_use, remove_from};
pub(crate) use packed_mask::PackedMask;
pub(crate) use pose::{PoseBits, bits, pose};
pub(crate) use state::{SavedKeyframe, SavedObservation, SavedRound, SavedSummary, TrackerState};

pub(crate) use envelope::{fingerprint, open, seal};

/// Why a checkpoint can't be gone on from.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CheckpointError {
    /// The bytes are not a checkpoint, or not all of it.
    #[error("the checkpoint is damaged")]
    Damaged,
    /// Another version, config, schedule or video wrote it.
    #[error("the checkpoint belongs to another run (version, config, schedule or video differ)")]
    OtherRun,
    /// A keyframe's frame can't be read any more.
    #[error("a keyframe's frame can't be read any more: {0}")]
    Frame(rgbd_io::Error),
    /// A keyframe's frame shows something else than it did.
    #[error("frame {id} is not what it was when the checkpoint was written")]
    Changed {
        /// Name of the frame.
        id: String,
    },
    /// The field could not be trained again.
    #[error("the field of the last round can't be trained again: {0}")]
    Field(String),
}
