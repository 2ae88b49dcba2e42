//! The methods that BundleSDF is compared with, for one unknown rigid object in masked RGB-D video.
//!
//! A tracker's numbers mean little without those of simpler methods on the same frames. This crate has three of the
//! kinds that the paper (Wen et al., *BundleSDF*, CVPR 2023, section 4) compares with, each written from its own
//! publication, behind one interface: frames with masks go in, poses and a coloured mesh come out.
//!
//! ```
//! use baselines::{Baseline, BaselineConfig, ObjectTracker};
//! use rgbd_io::{Image, Intrinsics, RgbdFrame};
//!
//! // A ball of 5 cm radius, half a metre away.
//! let intrinsics = Intrinsics { fx: 200.0, fy: 200.0, cx: 49.5, cy: 49.5 };
//! let depth = Image::from_fn(100, 100, |x, y| {
//!     let [u, v, _] = intrinsics.unproject(x as f64, y as f64, 1.0);
//!     let (a, b) = (u * u + v * v + 1.0, 0.25 - 0.0025);
//!     let root = 0.25 - a * b;
//!     if root > 0.0 { ((0.5 - root.sqrt()) / a) as f32 } else { 0.0 }
//! });
//! let mask = depth.map(|&z| u8::from(z > 0.0));
//! let color = depth.map(|_| [90, 120, 60]);
//! let frame = RgbdFrame { id: "0".into(), color, depth, mask: Some(mask), intrinsics };
//!
//! let mut tracker = Baseline::KinectFusion.tracker(&BaselineConfig::default());
//! assert!(tracker.track(&frame).tracked && tracker.track(&frame).tracked);
//! assert!(tracker.mesh(0.002).triangles.len() > 1000);
//! ```
//!
//! | [`Baseline`] | aligns a frame with | by | publication |
//! |---|---|---|---|
//! | `KinectFusion` | the fused model | projective point-to-plane ICP | Newcombe et al., ISMAR 2011 |
//! | `Sdf2Sdf` | the fused model | distance fields, without correspondences | Slavcheva et al., ECCV 2016, IJCV 2018 |
//! | `FrameToFrame` | the frame before | followed corners, RANSAC, ICP | odometry without memory |
//!
//! # Design
//! All three share the volume ([`tsdf`]), the depth pyramid and the treatment of the first frame, and differ in the
//! registration alone, so that a difference in their numbers is one of method. All work on the crop around the mask, on
//! one core. The object frame has the axes of the first tracked camera and its origin in the middle of the object's
//! cloud there; an evaluation aligns it with the true one at that frame. A frame that can't be tracked is no error: its
//! pose is that of the last one that could, and [`Pose::tracked`] is false.

mod baseline;
mod depth;
mod frame_to_frame;
mod fusion;
mod icp;
mod kinectfusion;
mod normal_equations;
mod observation;
mod point_map;
mod rigid;
mod sdf2sdf;
mod tracker;
pub mod tsdf;

pub use baseline::{Baseline, BaselineConfig, ObjectTracker, Pose};
pub use fusion::PoseFusion;
pub use point_map::PointMap;

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
