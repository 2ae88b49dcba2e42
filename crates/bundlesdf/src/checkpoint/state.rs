//! What a tracker's checkpoint holds.

use serde::{Deserialize, Serialize};

use super::{PackedMask, PoseBits};
use crate::{pool::MemoryEdge, report::RoundReport};

/// A remembered frame without what was seen in it.
#[derive(Serialize, Deserialize)]
pub(crate) struct SavedKeyframe {
    pub(crate) index: usize,
    pub(crate) id: String,
    pub(crate) obj_from_cam: PoseBits,
    pub(crate) refined_by_field: bool,
}

/// What an observation is made again from, beside the frame itself.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct SavedObservation {
    pub(crate) index: usize,
    pub(crate) mask: PackedMask,
    /// Object pixels with depth: what tells whether the frame is still the same.
    pub(crate) valid: usize,
}

/// A field round as it was asked for: training it again gives the same field.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct SavedRound {
    pub(crate) steps: usize,
    /// Frame index and `obj_from_cam` before the round, the anchor first.
    pub(crate) frames: Vec<(usize, PoseBits)>,
}

/// What the field has done.
#[derive(Serialize, Deserialize)]
pub(crate) struct SavedSummary {
    pub(crate) rounds: usize,
    pub(crate) steps: usize,
    pub(crate) ms_per_round_median: f64,
    pub(crate) failures: Vec<String>,
    pub(crate) history: Vec<RoundReport>,
    pub(crate) device: String,
    pub(crate) warnings: Vec<String>,
    pub(crate) times: Vec<f64>,
}

/// A tracker between two frames.
#[derive(Serialize, Deserialize)]
pub(crate) struct TrackerState {
    pub(crate) keyframes: Vec<SavedKeyframe>,
    pub(crate) edges: Vec<((usize, usize), MemoryEdge)>,
    /// How the keyframes, the reference and the round's frames were observed.
    pub(crate) observed: Vec<SavedObservation>,
    /// Frame index and `obj_from_cam`.
    pub(crate) reference: Option<(usize, PoseBits)>,
    pub(crate) motion: [Option<(usize, PoseBits)>; 2],
    pub(crate) segmenter: Vec<u8>,
    /// The last frame that came with its own mask, if masks are still given.
    pub(crate) given: Option<usize>,
    /// Position and normal of the observed surface.
    pub(crate) surface: Vec<[f32; 6]>,
    /// The round of the newest field.
    pub(crate) round: Option<SavedRound>,
    pub(crate) summary: SavedSummary,
    pub(crate) new_keyframes: usize,
    pub(crate) next_index: usize,
    pub(crate) first_valid: usize,
    pub(crate) adrift: bool,
}
