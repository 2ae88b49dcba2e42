//! Exponential maps, Jacobians, distances, alignment and averaging of rigid motions on nalgebra types.
//!
//! Trackers, pose graphs and registration code need the tangent space of SO(3) and SE(3): a solver computes
//! a six-number step and has to turn it into a motion, and it has to know how a residual changes with that
//! step. `nalgebra` has the motions ([`nalgebra::Isometry3`]), not their logarithm or their Jacobians.
//!
//! ```
//! use nalgebra::Vector6;
//! use se3_lie::{nalgebra, se3};
//!
//! // Twists are [rho; phi]: translation (metres) first, rotation (radians) second.
//! let xi = Vector6::new(0.1, 0.0, 0.2, 0.0, 0.5, 0.0);
//! let world_from_body = se3::exp(&xi);
//! assert!((se3::log(&world_from_body) - xi).norm() < 1e-12);
//!
//! // A small left perturbation d moves the logarithm by the inverse left Jacobian times d.
//! let d = Vector6::new(1e-6, 0.0, 0.0, 0.0, 0.0, 2e-6);
//! let moved = se3::log(&(se3::exp(&d) * world_from_body));
//! assert!((moved - xi - se3::left_jacobian_inverse(&xi) * d).norm() < 1e-10);
//! ```
//!
//! # Design
//! Plain functions on nalgebra's own types, generic over `f32` and `f64`: there is no wrapper to convert to
//! and from. Coefficients that are 0/0 at a zero rotation are evaluated from their series until the closed
//! form no longer cancels, so no result depends on a tiny threshold being right. Angles come from `atan2` and
//! not from `acos`, so small angles keep all their digits. Nothing allocates and nothing panics: NaN in gives
//! NaN out, and what has no answer is `None`.
//!
//! Formulas follow T. Barfoot, *State Estimation for Robotics*, 2nd edition, chapter 8.
//!
//! nalgebra's minor releases are incompatible with each other: use the [`nalgebra`] that this crate re-exports.

pub mod align;
pub mod average;
pub mod distance;
pub mod se3;
mod series;
pub mod so3;

pub use nalgebra;

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
