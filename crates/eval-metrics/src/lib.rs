//! ADD, ADD-S, AUC and chamfer distance for 6-DoF object tracking and reconstruction.
//!
//! A tracker of an unknown object reports poses in an object frame of its own choice, and a mesh in that
//! frame. Comparing them with the truth takes a protocol: which frame aligns the two, what a missing pose
//! counts, how dense the surfaces are sampled. This crate has the metrics, and the protocol of BundleSDF
//! (CVPR 2023) and BundleTrack (IROS 2021), so that numbers can be put next to the published ones.
//!
//! ```
//! use eval_metrics::{ModelPoints, score_poses};
//! use nalgebra::Isometry3;
//!
//! let model = ModelPoints::new(vec![[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]).ok_or("no points")?;
//! let truth: Vec<_> = (0..3).map(|i| Some(Isometry3::translation(0.0, 0.01 * i as f64, 0.5))).collect();
//! // The tracker lost the object in the last frame.
//! let predicted = [truth[0], truth[1], None];
//! let scores = score_poses(&predicted, &truth, &model, 0.1);
//! assert!((scores.add_auc - 200.0 / 3.0).abs() < 1e-9);
//! # Ok::<(), &str>(())
//! ```
//!
//! # Design
//! Everything takes slices of `[f64; 3]` (metres) and `nalgebra` poses, reads no files and prints nothing.
//! ADD-S searches in the object frame, where the model does not move, so that one kd-tree ([`ModelPoints`])
//! serves every frame. A pose that is missing or not finite is infinitely wrong; it is never left out, because
//! a tracker must not gain by giving up. Random samples come from a seed: the same input gives the same number.
//!
//! `nalgebra` types in the signatures are those of [`nalgebra`], re-exported by `se3-lie`.

mod auc;
mod chamfer;
mod icp;
mod masks;
mod mesh;
mod nearest;
mod normals;
mod pose;
mod protocol;
mod sampling;
mod summary;
mod visibility;

pub use auc::{auc, recall_curve};
pub use chamfer::{Chamfer, chamfer_distance};
pub use icp::{IcpOptions, icp};
pub use masks::{BOUNDARY_TOLERANCE, MaskRef, boundary_f, region_similarity};
pub use mesh::{MeshRef, keep_faces};
pub use normals::normal_error;
pub use pose::{ModelPoints, add, add_s, alignment, rebase, rotation_error, translation_error};
pub use protocol::{MeshProtocol, PoseScores, score_mesh, score_poses};
pub use sampling::{sample_surface, thin};
pub use summary::Summary;
pub use visibility::{Camera, visible_faces};

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
