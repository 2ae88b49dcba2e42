//! An object's mask in every RGB-D frame from its mask in the first, without training.
//!
//! Tracking an unknown object needs its mask in each frame, but only the first one is drawn by hand. A video
//! segmentation network can propagate it; this crate does the same from what an RGB-D tracker has anyway: depth,
//! colour, the motion so far and the surface reconstructed so far.
//!
//! ```
//! use mask_tracker::{Prior, Propagate, VideoSegmenter};
//! use rgbd_io::{Image, Intrinsics, RgbdFrame};
//!
//! // A red square 30 cm in front of a gray wall.
//! let inside = |x: usize, y: usize| (20..40).contains(&x) && (14..34).contains(&y);
//! let frame = RgbdFrame {
//!     id: "0000".into(),
//!     color: Image::from_fn(64, 48, |x, y| if inside(x, y) { [200, 30, 30] } else { [120, 120, 120] }),
//!     depth: Image::from_fn(64, 48, |x, y| if inside(x, y) { 0.5 } else { 0.8 }),
//!     mask: None,
//!     intrinsics: Intrinsics { fx: 60.0, fy: 60.0, cx: 31.5, cy: 23.5 },
//! };
//! let first_mask = Image::from_fn(64, 48, |x, y| u8::from(inside(x, y)));
//!
//! let mut segmenter = Propagate::default();
//! segmenter.start(&frame, &first_mask);
//! let found = segmenter.next(&frame, &Prior::default()); // before the pose is known
//! let found = segmenter.refine(&frame, found, &Prior::default()); // once it is estimated
//! assert_eq!(found.area, 400);
//! assert!(found.confidence > 0.9);
//! ```
//!
//! # Design
//!
//! One energy per frame over a small grid around the object, minimised exactly by a graph cut. Every cue is a
//! signed preference per cell, so each may be missing (no depth, no pose, no model, no texture) without the others
//! noticing: the warped last mask, the colours and depths that moved along with the object or stayed behind, colour
//! models that forget slowly and never learn from a doubtful frame, and the reconstructed surface drawn at the
//! predicted pose, which tells object (same depth) from occluder (in front) and from background (behind).
//! A voxel grid in the object's frame remembers which places a camera has looked through: no part of a rigid object
//! can show up there. The trait [`VideoSegmenter`] lets a network (through [`pipe`]) or given masks ([`GivenMasks`])
//! stand in, and [`first_mask`] makes the first one from a box.

mod appearance;
mod cut;
mod distance;
mod energy;
mod first;
mod given;
mod grid;
mod math;
mod maxflow;
mod memory;
mod naming;
pub mod pipe;
mod propagate;
mod redetect;
mod saved;
mod stages;
mod surface;
mod upsample;
mod view;
mod volume;
mod warp;

pub use first::{Hints, first_mask};
pub use given::{GivenMasks, resample};
pub use naming::{NamingError, pair_masks};
pub use propagate::{Options, Propagate};
pub use stages::StageTimes;

use nalgebra::Isometry3;
use rgbd_io::{Mask, RgbdFrame};

/// A point of the reconstructed surface with its outward normal, object frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// Position, metres.
    pub position: [f32; 3],
    /// Outward unit normal; zero when unknown.
    pub normal: [f32; 3],
}

/// What the tracker knows about the object before (or, in [`VideoSegmenter::refine`], after) a frame's pose is
/// estimated. [`Prior::default`] is "nothing".
#[derive(Clone, Copy, Debug, Default)]
pub struct Prior<'a> {
    /// The object's pose in this frame: predicted in `next`, estimated in `refine`.
    pub cam_from_obj: Option<Isometry3<f64>>,
    /// The surface observed so far, in the object frame; may be empty.
    pub model: &'a [SurfacePoint],
    /// How far the pose and the model can be trusted, 0..1.
    pub confidence: f32,
}

/// The object's mask in one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Segmentation {
    /// 255 = object, 0 = background; of the frame's size. Empty when the object isn't seen.
    pub mask: Mask,
    /// 0..1: the share of the mask that depth, colour and model confirm, lowered where the object covers much less
    /// or much more than expected. Near 0 with an empty mask: the object is gone.
    pub confidence: f32,
    /// Object pixels.
    pub area: usize,
}

impl Segmentation {
    /// A segmentation from its mask (any value but 0 is object) and confidence.
    pub fn new(mask: Mask, confidence: f32) -> Self {
        // Counted in bytes, many at a time: there are many more pixels than anything else.
        let block = |block: &[u8]| usize::from(block.iter().map(|&m| u8::from(m != 0)).sum::<u8>());
        let area = mask.pixels().chunks(usize::from(u8::MAX)).map(block).sum();
        Self { mask, confidence, area }
    }
}

/// Follows an object's mask through a video: [`start`](Self::start) once, then for every further frame
/// [`next`](Self::next), the caller's pose estimate, and [`refine`](Self::refine).
pub trait VideoSegmenter: Send {
    /// Begins with the object's mask (0 = background) in the first frame; forgets everything before.
    fn start(&mut self, frame: &RgbdFrame, mask: &Mask);

    /// The object's mask before this frame's pose is known; `prior` holds the predicted pose, if there is one.
    fn next(&mut self, frame: &RgbdFrame, prior: &Prior<'_>) -> Segmentation;

    /// The mask of the frame last given to [`next`](Self::next), cleaned up with the estimated pose in `prior`.
    /// What the segmenter remembers of this frame is learnt here. Straight after [`start`](Self::start) it may be
    /// called with the first frame's pose, which returns `found` as it is.
    fn refine(&mut self, frame: &RgbdFrame, found: Segmentation, prior: &Prior<'_>) -> Segmentation;

    /// Everything remembered between two frames, for [`restore`](Self::restore); `None` if this segmenter can't tell.
    /// To be called when a frame is done.
    fn save(&mut self) -> Option<Vec<u8>> {
        None
    }

    /// Goes on from what [`save`](Self::save) returned, with the same results bit for bit. False, and nothing is
    /// changed, when the bytes are not of this version.
    fn restore(&mut self, _saved: &[u8]) -> bool {
        false
    }
}

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
