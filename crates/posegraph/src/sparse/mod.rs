//! Graphs of thousands of poses joined by relative-pose measurements: Levenberg-Marquardt on a block-sparse normal
//! matrix (feature `sparse`).
//!
//! ```
//! use nalgebra::{Isometry3, Matrix6, Vector3};
//! use posegraph::sparse::{Graph, Options, RelativePose, solve};
//!
//! // A square walked with odometry that turns 2 degrees too far at each corner; the last edge closes the loop.
//! let step = |degrees: f64| Isometry3::new(Vector3::x(), Vector3::z() * degrees.to_radians());
//! let mut graph = Graph { poses: vec![Isometry3::identity()], ..Graph::default() };
//! for k in 0..4 {
//!     graph.poses.push(graph.poses[k] * step(92.0));
//!     graph.edges.push(RelativePose::new(k, k + 1, step(92.0), Matrix6::identity()));
//! }
//! graph.edges.push(RelativePose::new(4, 0, Isometry3::identity(), Matrix6::identity() * 1e6));
//! let solution = solve(&graph, &Options::default())?;
//! assert!(solution.converged && solution.cost_final < 0.1 * solution.cost_initial);
//! assert!((solution.poses[4].translation.vector - solution.poses[0].translation.vector).norm() < 1e-3);
//! # Ok::<(), posegraph::sparse::Error>(())
//! ```
//!
//! # The objective
//! ```text
//! E = sum  rho( sqrt(r^T information r) ),    r = log(Z^-1 T_from^-1 T_to),    Z = from_from_to
//! ```
//! with `rho(e) = e^2 / 2` or Huber's loss: half of chi squared.
//!
//! # The design decision
//! The dense solver of this crate perturbs poses from the left because all its nodes see one object near the origin.
//! A map has no such centre: here `T <- T exp(delta)`, **right** perturbation, so that an increment is a motion in the
//! pose's own frame and neither Jacobians nor damping depend on how far from the origin a pose is. The normal matrix
//! has one 6x6 block per node and per joined pair. Blocks are ordered once by approximate minimum degree, before they
//! are expanded to scalars (36 times fewer entries to order), and the symbolic factorisation (faer, supernodal) is
//! computed once and reused by every step.

mod edge;
mod graph;
mod normal;
mod ordering;
mod solve;

pub(crate) use graph::is_information;
pub use graph::{Error, Graph, RelativePose};
pub use solve::{Kernel, Options, Solution, solve};
