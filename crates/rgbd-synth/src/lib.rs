//! Perfect RGB-D sequences with exact poses, masks and meshes, and the sensor's faults on request.
//!
//! A tracker's error can only be measured where the truth is known better than the tracker knows it. Recorded
//! sequences have truth to a few millimetres at best; a rendered one has it exactly, for the pose, the visible mask,
//! the depth and the surface, and its difficulties can be switched on one at a time.
//!
//! ```
//! use rgbd_synth::{Sensor, Sequence};
//!
//! let sequence = Sequence::tiny();
//! let noisy = sequence.render(3);
//! let perfect = sequence.with_sensor(Sensor::perfect()).render(3);
//! assert_eq!(noisy.cam_from_obj, perfect.cam_from_obj);
//! let missing = noisy.frame.depth.pixels().iter().filter(|&&z| z == 0.0).count();
//! assert!(missing > 0);
//! assert_eq!(perfect.frame.depth, perfect.true_depth);
//! assert!(sequence.mesh().triangles.len() > 1000);
//! ```
//!
//! The design decision: a frame is a pure function of the description and its index. The motion is a function of
//! time, colour is a function of the surface point, and the sensor's random values follow from seed, frame and pixel,
//! so frames can be rendered in any order, on any number of threads, with identical bits. [`Sequence`] is therefore a
//! [`rgbd_io::FrameSource`] like any folder, without a file being written; [`write_custom`] makes the folder.
//!
//! [`Sequence::demo`] is one sequence to look at, [`Sequence::suite`] names thirteen that each make one thing hard: no
//! texture, symmetry, thin parts, shine, speed, occlusion, bad masks, bad depth, small, large, a full turn, a moving
//! camera.
//!
//! Solids are described as signed distances ([`Shape`]) and meshed as one piece, so that the true mesh
//! ([`Sequence::mesh`]) is the outer surface and nothing else. The object frame is the mesh's own; an evaluation that
//! compares with a tracker's frame aligns both at the first frame.

mod atlas;
mod backdrop;
mod error;
mod hand;
mod layouts;
mod mask_faults;
mod motion;
mod noise;
mod object;
mod presets;
mod raster;
mod scene;
mod sensor;
mod sensor_models;
mod sequence;
mod shape;
mod suite;
mod surface;
mod tessellate;
mod texture;
mod write;

pub use backdrop::{Backdrop, Plane};
pub use error::Error;
pub use hand::{Grip, Hand};
pub use layouts::{write_behave, write_bop, write_ho3d, write_tum, write_ycbineoat};
pub use mask_faults::MaskFaults;
pub use motion::{Motion, Tumble};
pub use object::Object;
pub use presets::{jug, room};
pub use scene::{Gloss, Light};
pub use sensor::Sensor;
pub use sequence::{Masks, Occluder, Sequence, SequenceSpec, SynthFrame};
pub use shape::Shape;
pub use texture::{Layer, Mapping, Pattern, Texture};
pub use write::write_custom;

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
