//! A neural signed distance field of an object, trained in seconds from posed RGB-D frames.
//!
//! A tracker's poses drift, and every depth image is noisy and partial. Fitting one surface to all frames at once,
//! while the frames' poses may move, gives both: a shape and poses that agree with it. This is the Neural Object
//! Field of BundleSDF (Wen et al., CVPR 2023, section 3.4) for the CPU: no GPU, no framework, a few seconds a round.
//! With the feature `gpu` the same step also runs on any GPU that wgpu knows; see [`Device`].
//!
//! ```
//! use nalgebra::Isometry3;
//! use neural_field::{Control, FieldConfig, FieldImages, train};
//! use se3_lie::nalgebra;
//! use std::sync::Arc;
//!
//! // A grey wall patch of 8 cm seen from half a metre: one frame, 48 x 48 pixels.
//! let (side, n) = (48, 48 * 48);
//! let object = |i: usize| (8..40).contains(&(i % side)) && (8..40).contains(&(i / side));
//! let frame = FieldImages {
//!     id: 0, width: side, height: side, fx: 200.0, fy: 200.0, cx: 23.5, cy: 23.5,
//!     color: vec![[128; 3]; n],
//!     depth: (0..n).map(|i| if object(i) { 0.5 } else { 0.0 }).collect(),
//!     mask: (0..n).map(|i| u8::from(object(i))).collect(),
//!     mask_margin: 0.5,
//! };
//! let config = FieldConfig { steps: 60, ..FieldConfig::realtime() };
//! let field = train(&config, &[Arc::new(frame)], &[Isometry3::identity()], &Control::default())?;
//!
//! // Positive in front of the wall, negative behind, metres; NaN where nothing was seen.
//! let mut sdf = [0.0; 3];
//! field.sdf(&[[0.0, 0.0, 0.495], [0.0, 0.0, 0.503], [0.0, 0.0, 9.0]], &mut sdf);
//! assert!(sdf[0] > 0.003 && sdf[1] < -0.0005 && sdf[2].is_nan());
//! # Ok::<(), neural_field::FieldError>(())
//! ```
//!
//! # Design
//! - **Everything in truncation units.** The network's output is distance over truncation distance and every loss is
//!   divided by its number of samples, so the same weights fit a cup and a suitcase.
//! - **Fused tiles.** Four rays with all their samples go through encoding, networks, losses and back in one pass
//!   over cache-sized buffers. The kernels are written in vectors and compiled once for AVX-512, AVX2 and what every
//!   processor has; which one runs is found out at run time. They are generic over the scalar as well: `f32` trains,
//!   `f64` checks the same code against finite differences.
//! - **Reproducible.** Sums run in a fixed order: the same input and seed give the same bits on any number of threads.
//! - **Poses by gradient.** Distance, colour and eikonal terms all pull at the poses through the sample positions.
//!   All frames move while the field is trained, then everything is moved back so that the first pose is untouched.
//!
//! The training step is written out as equations in `docs/field.md` of the repository.

// The scenes of the integration tests name the crate.
#[cfg(all(test, feature = "gpu"))]
extern crate self as neural_field;

mod adam;
#[cfg(feature = "bench")]
pub mod bench;
mod clock;
mod closing;
mod color;
mod config;
mod contrast;
mod cpu;
mod device;
mod draws;
mod eikonal;
mod engine;
mod error;
mod field;
mod frame;
mod free;
mod gemm;
#[cfg(any(test, feature = "gpu"))]
mod gpu;
#[cfg(test)]
mod gradient_check;
mod grid;
mod harmonics;
mod lanes;
mod mesh;
mod mlp;
mod pass;
mod pose;
mod query;
mod rays;
mod real;
mod round;
mod sampler;
mod scatter;
mod sight;
mod silhouette;
mod simd;
mod tile;
mod train;
mod trust;
mod volume;
mod window;

pub use config::{FieldConfig, LossWeights};
pub use cpu::CpuRound;
pub use device::{Device, Trained};
pub use error::FieldError;
pub use field::TrainedField;
pub use frame::FieldImages;
#[cfg(feature = "gpu")]
pub use gpu::{Gpu, GpuRound};
pub use round::Engine;
pub use train::{Control, Progress, StepLosses, train};

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
