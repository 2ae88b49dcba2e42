//! Robust least squares over a handful of rigid poses: matched points, dense point-to-plane alignment, a signed
//! distance model and priors, with fixed nodes eliminated from the system.
//!
//! # The problem
//! Several RGB-D frames saw the same rigid object. For each frame, find the pose `obj_from_cam` such that matched
//! points coincide, surfaces lie on each other and points lie on the object's model, where some poses are already
//! known and some of the matches are wrong (BundleSDF, CVPR 2023, eq. `L_pg`):
//!
//! ```text
//! E =  sum  w_f rho(|T_i p_i - T_j p_j|)              feature edges, eq. L_f
//!    + sum  w_p rho(n . (q_t - T_t^-1 T_s p_s))       dense edges, eq. L_p, re-associated every iteration
//!    + sum  w_s rho(sdf(T_i p))                       SDF terms, eq. L_s
//!    + sum  1/2 |log(T_i T_prior^-1)|^2               priors
//! ```
//!
//! # Example
//! ```
//! use nalgebra::Isometry3;
//! use posegraph::{FeatureEdge, Node, PoseGraph, SolveOptions, solve};
//!
//! let mut graph = PoseGraph::new();
//! let anchor = graph.add_node(Node { obj_from_cam: Isometry3::identity(), fixed: true });
//! let moving = graph.add_node(Node { obj_from_cam: Isometry3::identity(), fixed: false });
//! let points_i = vec![[0.0, 0.0, 0.5], [0.1, 0.0, 0.5], [0.0, 0.1, 0.5], [0.1, 0.1, 0.6]];
//! let points_j = points_i.iter().map(|p| [p[0] - 0.01, p[1], p[2]]).collect();
//! graph.add_feature_edge(FeatureEdge { i: anchor, j: moving, points_i, points_j, weights: Vec::new() })?;
//! let solution = solve(&graph, &SolveOptions::default())?;
//! assert!((solution.poses[moving].translation.x - 0.01).abs() < 1e-6);
//! # Ok::<(), posegraph::Error>(())
//! ```
//!
//! # The design decision
//! *Fixed* means constant. A fixed node is not an unknown whose increment is thrown away afterwards: then its
//! neighbours would be solved against a pose it does not have. It is not in the system at all, and comes back bit for
//! bit. What remains (about ten poses) is small enough for a dense Cholesky factorisation, so the work is in summing
//! 6x6 blocks: every term adds blocks and nothing else. Points are stored relative to centres near them and summed in
//! single precision, eight at a time; totals, poses and the system are double.
//!
//! # What is not observed
//! Noise moves a pose along motions that no residual tells of: the turn of a can without print. [`solve`] finds such
//! motions in every node's information matrix and holds the node there at its prediction
//! ([`PoseGraph::set_prediction`], by default its initial pose). [`Solution::observability`] names them for the newest
//! node and has its covariance. "Not observed" is measured, not set: a motion must have more information than the noise
//! of the normals, known from how much matched normals differ, gives to a surface that slides along itself.
//!
//! # Precision
//! A matched point is known well across its ray and badly along it ([`SolveOptions::feature_angle`] against the depth
//! noise), so that views from different sides complement each other. Residuals are divided by their standard deviation,
//! and an edge's weights are capped in sum (see [`SolveOptions`]),
//! so that the inverse Hessian is usable as a covariance. Results are deterministic.
//!
//! # Features
//! - `sparse`: graphs of thousands of poses joined by relative-pose measurements (module `sparse`) and the g2o text
//!   format (module `g2o`). The solver above does not need it.
//! - `rayon`: dense edges on all cores. Edges are summed in order, so results do not change.

mod cloud;
mod dense;
mod error;
mod feature;
#[cfg(feature = "sparse")]
pub mod g2o;
mod graph;
mod jacobian;
mod lanes;
mod matches;
mod normal;
mod observability;
mod options;
mod parallel;
mod prior;
mod problem;
mod rays;
mod sdf;
mod search;
mod simd;
mod solve;
#[cfg(feature = "sparse")]
pub mod sparse;
mod stats;
mod transform;
mod view;

pub use error::Error;
pub use graph::{DenseEdge, FeatureEdge, Node, PoseGraph, PosePrior, SdfModel, SdfTerm};
pub use observability::{Direction, Observability};
pub use options::SolveOptions;
pub use solve::{Solution, solve};
pub use view::{DenseView, Pinhole};

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
