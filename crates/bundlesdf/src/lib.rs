//! 6-DoF tracking and 3-D reconstruction of an unknown rigid object in an RGB-D video.
//!
//! Colour, registered depth, intrinsics and the object's mask in the first frame go in; a pose per frame and one
//! metric mesh come out. It is the method of *BundleSDF: Neural 6-DoF Tracking and 3D Reconstruction of Unknown
//! Objects* (Wen et al., CVPR 2023): coarse pose from matches and RANSAC, a memory pool of keyframes, online
//! pose-graph optimisation, and a Neural Object Field trained beside the tracker, which refines the keyframes' poses.
//!
//! ```
//! use bundlesdf::{Config, Schedule, Status, Tracker};
//! use rgbd_synth::Sequence;
//!
//! let video = Sequence::tiny();
//! let mut tracker = Tracker::new(Config::default(), Schedule::Lockstep)?;
//! for index in 0..3 {
//!     let result = tracker.track(&video.render(index).frame);
//!     println!("{}: {:?} {}", result.id, result.status, result.cam_from_obj);
//!     assert_ne!(result.status, Status::Lost);
//! }
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! The design decision: [`Tracker::track`] never fails. What a frame can't tell is a [`Status`], the pose is then the
//! last good one, and everything that was learnt so far stays. Two loops share one [`MemoryPool`]: the tracker owns
//! it, the field's thread gets immutable snapshots and answers with poses. With [`Schedule::Lockstep`] the tracker
//! waits for each round and a run is reproducible, with [`Schedule::Realtime`] it never waits.

mod ablation;
pub mod canonical;
pub mod checkpoint;
pub mod config;
mod coverage;
mod depth;
pub mod diagnostics;
pub mod draw;
pub mod evaluate;
pub mod export;
mod field_model;
mod field_worker;
mod global_graph;
pub mod html;
pub mod input;
mod link;
pub mod observation;
pub mod output;
mod pool;
mod quality;
mod raster;
pub mod refine;
pub mod report;
mod rigid;
pub mod segmenter;
mod surface;
mod sync;
pub mod texture;
mod tracker;
mod video;
mod zoom;

pub use ablation::Ablation;
pub use checkpoint::{CheckpointError, Manifest, StateFolder};
pub use config::{Config, ConfigError, FieldDevice, Schedule};
pub use depth::depth_sigma;
pub use diagnostics::{Warning, WarningKind};
pub use input::VideoInput;
pub use observation::{Observation, Unusable};
pub use output::OutputFolder;
pub use pool::{Keyframe, MemoryPool};
pub use quality::Quality;
pub use report::{KeyframeReport, RoundReport, RunReport};
pub use segmenter::SegmenterChoice;
pub use tracker::{
    FieldSummary, FrameResult, HeldMotion, MotionKind, Reconstruction, StageTimes, Status, Tracker,
    Uncertainty,
};
pub use video::{Observer, RunError, RunSoFar, VideoRun, continue_video, run_video};

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
