//! Levenberg-Marquardt over a sparse graph.

use nalgebra::Isometry3;
use se3_lie::se3;

use super::edge::{linearise, squared_error};
use super::graph::{Error, Graph};
use super::normal::SparseNormal;
use crate::jacobian::huber;

/// Steps tried at one linearisation.
const MAX_ATTEMPTS: usize = 12;
/// Least damping: the matrix is positive definite without, this only bounds the time to get back from it.
const MIN_DAMPING: f64 = 1e-12;
/// Half chi squared of an edge that is nothing but rounding.
const ROUNDING: f64 = 1e-18;

/// Loss of an edge as a function of its error `e = sqrt(r^T information r)`, in standard deviations.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Kernel {
    /// Least squares, `e^2 / 2`.
    #[default]
    None,
    /// Huber's loss: quadratic up to this error, linear beyond.
    Huber(f64),
}

impl Kernel {
    /// Loss and weight `rho'(e) / e`.
    #[inline]
    fn of(self, squared: f64) -> (f64, f64) {
        match self {
            Self::None => (0.5 * squared, 1.0),
            // Rounding can push the square of an error below zero.
            Self::Huber(delta) => huber(squared.max(0.0).sqrt(), delta),
        }
    }
}

/// Options of [`solve`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// Linearisations at most.
    pub max_iterations: usize,
    /// First damping, relative to the diagonal of the normal matrix.
    pub initial_damping: f64,
    /// Converged when a step lowers the cost by less than this fraction.
    pub relative_decrease: f64,
    /// Robust loss.
    pub kernel: Kernel,
}

impl Default for Options {
    fn default() -> Self {
        Self { max_iterations: 100, initial_damping: 1e-8, relative_decrease: 1e-6, kernel: Kernel::None }
    }
}

impl Options {
    fn validate(&self) -> Result<(), Error> {
        let huber = match self.kernel {
            Kernel::None => 1.0,
            Kernel::Huber(delta) => delta,
        };
        for (name, value, positive) in [
            ("initial_damping", self.initial_damping, true),
            ("relative_decrease", self.relative_decrease, false),
            ("kernel", huber, true),
        ] {
            if !value.is_finite() || value < 0.0 || (positive && value == 0.0) {
                return Err(Error::InvalidOption { name, value });
            }
        }
        Ok(())
    }
}

/// The result of a solve. Indices are those of the graph.
#[derive(Debug, Clone, PartialEq)]
pub struct Solution {
    /// World pose of every node; fixed and held nodes are bit-identical to the input.
    pub poses: Vec<Isometry3<f64>>,
    /// Objective at the input poses: half of chi squared if there is no robust kernel.
    pub cost_initial: f64,
    /// Objective at `poses`; never above `cost_initial`.
    pub cost_final: f64,
    /// Linearisations made.
    pub iterations: usize,
    /// Whether the tolerance was reached (or there was nothing to do) within the iterations allowed.
    pub converged: bool,
}

/// Minimises the graph's objective over the nodes that are not fixed. A step is taken only if it lowers the cost.
/// Deterministic.
///
/// # Errors
/// A graph with missing nodes, numbers that are not finite or unusable information matrices, an option out of range,
/// or a graph too large for memory.
pub fn solve(graph: &Graph, options: &Options) -> Result<Solution, Error> {
    options.validate()?;
    graph.validate()?;
    let mut poses = graph.poses.clone();
    let mut normal = SparseNormal::new(graph, &graph.constants())?;
    let cost_initial = cost(graph, &poses, options.kernel);
    let (cost_final, iterations, converged) = iterate(graph, &mut normal, &mut poses, cost_initial, options);
    Ok(Solution { poses, cost_initial, cost_final, iterations, converged })
}

/// Improves `poses`; returns the cost, the linearisations made and whether the tolerance was reached.
fn iterate(
    graph: &Graph,
    normal: &mut SparseNormal,
    poses: &mut Vec<Isometry3<f64>>,
    mut current: f64,
    options: &Options,
) -> (f64, usize, bool) {
    let negligible = ROUNDING * graph.edges.len() as f64;
    if normal.is_empty() || current <= negligible {
        return (current, 0, true);
    }
    let mut trial = poses.clone();
    let mut damping = options.initial_damping.max(MIN_DAMPING);
    for iteration in 1..=options.max_iterations {
        if !assemble(graph, poses, normal, options.kernel) || !current.is_finite() {
            return (current, iteration, false);
        }
        if normal.gradient_is_zero() {
            return (current, iteration, true);
        }
        let Some((cost, ratio)) =
            descend(graph, normal, poses, &mut trial, current, &mut damping, options.kernel)
        else {
            // No step helps: a minimum up to rounding, unless nothing could be factorised.
            return (current, iteration, normal.solve(damping).is_some());
        };
        let decrease = current - cost;
        std::mem::swap(poses, &mut trial);
        let done = decrease <= options.relative_decrease * current || cost <= negligible;
        current = cost;
        if done {
            return (current, iteration, true);
        }
        if ratio > 0.75 {
            damping = (damping * 0.1).max(MIN_DAMPING);
        } else if ratio < 0.25 {
            damping *= 4.0;
        }
    }
    (current, options.max_iterations, false)
}

/// Raises the damping until a step lowers the cost; writes the poses to `trial` and returns their cost and its
/// decrease in terms of what the quadratic model promised.
fn descend(
    graph: &Graph,
    normal: &mut SparseNormal,
    poses: &[Isometry3<f64>],
    trial: &mut [Isometry3<f64>],
    current: f64,
    damping: &mut f64,
    kernel: Kernel,
) -> Option<(f64, f64)> {
    let mut growth = 10.0;
    for _ in 0..MAX_ATTEMPTS {
        if let Some(predicted) = normal.solve(*damping) {
            for (node, (pose, trial)) in poses.iter().zip(trial.iter_mut()).enumerate() {
                *trial = *pose;
                if let Some(step) = normal.step(node) {
                    *trial *= se3::exp(&step);
                    trial.rotation.renormalize();
                }
            }
            let cost = cost(graph, trial, kernel);
            if cost < current {
                return Some((cost, (current - cost) / predicted));
            }
        }
        // Faster and faster: there may be ten orders of magnitude to go.
        *damping *= growth;
        growth *= 2.0;
    }
    None
}

fn cost(graph: &Graph, poses: &[Isometry3<f64>], kernel: Kernel) -> f64 {
    graph.edges.iter().map(|e| kernel.of(squared_error(e, &poses[e.from], &poses[e.to])).0).sum()
}

/// Builds the normal equations; false if they are not finite.
fn assemble(graph: &Graph, poses: &[Isometry3<f64>], normal: &mut SparseNormal, kernel: Kernel) -> bool {
    normal.clear();
    for (k, e) in graph.edges.iter().enumerate() {
        let l = linearise(e, &poses[e.from], &poses[e.to]);
        normal.add(k, (e.from, e.to), &l, kernel.of(l.squared).1);
    }
    normal.finish()
}
