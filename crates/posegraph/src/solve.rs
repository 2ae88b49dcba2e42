//! Levenberg-Marquardt with iteratively re-weighted residuals and re-association.

use nalgebra::{Isometry3, Matrix6};
use se3_lie::se3;

use crate::error::Error;
use crate::graph::{PoseGraph, is_finite_pose};
use crate::normal::NormalEquations;
use crate::observability::Observability;
use crate::options::SolveOptions;
use crate::problem::Problem;

/// Smallest damping: directions with less than about this share of a node's information keep their inertia, so that
/// single-precision noise in normals and gradients does not move what the data does not see. Observed directions still
/// converge by four digits an iteration.
const MIN_DAMPING: f64 = 1e-4;
/// Steps tried at one linearisation.
const MAX_ATTEMPTS: usize = 10;

/// The result of a solve. Indices are those of the graph.
#[derive(Debug, Clone, PartialEq)]
pub struct Solution {
    /// `obj_from_cam` of every node; fixed and held nodes are bit-identical to the input.
    pub poses: Vec<Isometry3<f64>>,
    /// Objective at the input poses, under the last dense association.
    pub cost_initial: f64,
    /// Objective at `poses`, under the same association; never above `cost_initial`.
    pub cost_final: f64,
    /// Linearisations made.
    pub iterations: usize,
    /// Whether a tolerance was reached (or there was nothing to do) within the iterations allowed.
    pub converged: bool,
    /// Marginal covariance of each node's object-frame twist `[rho; phi]`. `None` for fixed nodes, for all nodes if
    /// some direction is not observed at all, and if the option is off.
    pub covariances: Vec<Option<Matrix6<f64>>>,
    /// What the measurements tell of the newest node (the last that is free), the others given: in which directions it
    /// was held. `None` without a free node.
    pub observability: Option<Observability>,
    /// Robustly weighted RMS of the feature residuals, standard deviations of a point's three coordinates together: about
    /// `sqrt(3)` where the noise is as the options say; 0 without any.
    pub feature_rms: f64,
    /// Robustly weighted RMS of the point-to-plane residuals, metres; 0 without any.
    pub dense_rms: f64,
    /// Robustly weighted RMS of the signed distances, metres; 0 without any.
    pub sdf_rms: f64,
    /// Matches of each feature edge within the Huber threshold; 0 for edges that are skipped (two constant nodes).
    pub feature_inliers: Vec<usize>,
    /// Associated pixels of each dense edge within the Huber threshold; 0 for edges that are skipped.
    pub dense_inliers: Vec<usize>,
}

/// Minimises the graph's objective over the nodes that are not fixed.
///
/// Fixed nodes are constants: they are not part of the linear system, and terms without a free node are skipped. If
/// nothing anchors the graph (no fixed node, no prior and no SDF term), node 0 is held. Directions that no residual
/// observes stay where they are.
///
/// A step is taken only if it lowers the true robust cost under the association it was computed with; the poses
/// returned never cost more than the input. With [`SolveOptions::hold`] the cost counts what directions that are not
/// observed have moved from the prediction.
///
/// # Errors
/// A node whose pose is not finite, or an option out of range.
pub fn solve(graph: &PoseGraph<'_>, options: &SolveOptions) -> Result<Solution, Error> {
    options.validate()?;
    if let Some(node) = graph.nodes.iter().position(|n| !is_finite_pose(&n.obj_from_cam)) {
        return Err(Error::NonFinitePose { node });
    }
    let mut normal = NormalEquations::new(&constants(graph, options));
    let mut problem = Problem::new(graph, options, &normal);
    let initial: Vec<Isometry3<f64>> = graph.nodes.iter().map(|n| n.obj_from_cam).collect();
    let mut poses = initial.clone();
    let mut end = iterate(&mut problem, &mut normal, &mut poses, options);

    // One association judges both ends.
    let cost_initial = problem.cost(&initial);
    let mut cost_final = end.cost.unwrap_or(cost_initial);
    if cost_final.is_nan() || cost_final > cost_initial {
        poses.clone_from(&initial);
        cost_final = cost_initial;
        end = End { converged: false, is_linearised: false, ..end };
    }
    let mut solution = Solution {
        cost_initial,
        cost_final,
        iterations: end.iterations,
        converged: end.converged,
        covariances: vec![None; poses.len()],
        observability: None,
        feature_rms: 0.0,
        dense_rms: 0.0,
        sdf_rms: 0.0,
        feature_inliers: Vec::new(),
        dense_inliers: Vec::new(),
        poses,
    };
    describe(&mut solution, graph, &mut problem);
    if normal.free() > 0 {
        if !end.is_linearised {
            problem.linearise(&solution.poses, &mut normal);
        } else {
            problem.release(&solution.poses, &mut normal);
        }
        if normal.is_finite() {
            solution.observability = problem.observability(&solution.poses, &normal);
            if options.covariance {
                solution.covariances = normal.covariances();
            }
        }
    }
    Ok(solution)
}

/// Which nodes are constants of the problem.
fn constants(graph: &PoseGraph<'_>, options: &SolveOptions) -> Vec<bool> {
    let mut constant: Vec<bool> = graph.nodes.iter().map(|n| n.fixed).collect();
    let has_sdf = options.sdf_weight > 0.0 && graph.sdf_terms.iter().any(|t| !t.points.is_empty());
    let anchored = constant.contains(&true) || !graph.priors.is_empty() || has_sdf;
    if !anchored && let Some(first) = constant.first_mut() {
        *first = true;
    }
    constant
}

/// Where the iterations have ended.
struct End {
    /// Linearisations made.
    iterations: usize,
    /// Whether a tolerance was reached.
    converged: bool,
    /// Cost of the poses under the last association; none without a linearisation.
    cost: Option<f64>,
    /// Whether the normal equations are those of the poses, but for a step within the tolerances.
    is_linearised: bool,
}

/// Improves `poses`.
fn iterate(
    problem: &mut Problem<'_>,
    normal: &mut NormalEquations,
    poses: &mut [Isometry3<f64>],
    options: &SolveOptions,
) -> End {
    let mut end = End { iterations: 0, converged: normal.free() == 0, cost: None, is_linearised: false };
    if end.converged {
        return end;
    }
    let mut trial = poses.to_vec();
    let mut damping = options.initial_damping.max(MIN_DAMPING);
    for iteration in 0..options.max_iterations {
        problem.associate(poses, iteration, options);
        let settled = problem.is_steady() || iteration >= options.tighten_iterations;
        let mut cost = problem.linearise(poses, normal);
        if options.hold {
            cost += problem.hold(poses, normal);
        }
        end = End { iterations: iteration + 1, cost: Some(cost), ..end };
        if !cost.is_finite() || !normal.is_finite() {
            return end;
        }
        let mut small_step = normal.gradient_is_zero();
        if !small_step {
            let mut accepted = false;
            for _ in 0..MAX_ATTEMPTS {
                if normal.solve(damping) {
                    small_step = apply_step(normal, poses, &mut trial, options);
                    let trial_cost = problem.cost(&trial);
                    if trial_cost < cost {
                        small_step |= cost - trial_cost <= options.cost_tolerance * cost;
                        poses.copy_from_slice(&trial);
                        end.cost = Some(trial_cost);
                        damping = (damping * 0.1).max(MIN_DAMPING);
                        accepted = true;
                        break;
                    }
                    if small_step {
                        break;
                    }
                }
                damping *= 10.0;
            }
            // No step helps: a minimum of this association up to rounding.
            small_step |= !accepted;
            damping = damping.min(1.0);
        }
        if small_step && settled {
            return End { converged: true, is_linearised: true, ..end };
        }
    }
    end
}

/// `trial = exp(step) * poses`; true if every step is below the tolerances.
fn apply_step(
    normal: &NormalEquations,
    poses: &[Isometry3<f64>],
    trial: &mut [Isometry3<f64>],
    options: &SolveOptions,
) -> bool {
    let mut small = true;
    for (node, (pose, trial)) in poses.iter().zip(trial).enumerate() {
        let Some(step) = normal.step(node) else { continue };
        small &= step.fixed_rows::<3>(0).norm() <= options.translation_tolerance
            && step.fixed_rows::<3>(3).norm() <= options.rotation_tolerance;
        *trial = se3::exp(&step) * pose;
        trial.rotation.renormalize();
    }
    small
}

/// Fills in the statistics of the poses found.
fn describe(solution: &mut Solution, graph: &PoseGraph<'_>, problem: &mut Problem<'_>) {
    let summary = problem.summary(&solution.poses, graph);
    solution.feature_rms = summary.feature.rms();
    solution.dense_rms = summary.dense.rms();
    solution.sdf_rms = summary.sdf.rms();
    solution.feature_inliers = summary.feature_inliers;
    solution.dense_inliers = summary.dense_inliers;
}
