//! One pose graph over all keyframes: what a field round ends with, and the whole round of the paper's GPG ablation.

use std::sync::{
    Arc,
    atomic::{AtomicBool, Ordering},
};

use nalgebra::{Isometry3, SymmetricEigen};
use neural_field::TrainedField;
use posegraph::{DenseEdge, Node, PoseGraph, PosePrior, SdfTerm, Solution, SolveOptions, solve};
use se3_lie::{distance::swing_angle, se3};

use crate::{
    config::MAX_DENSE_SWING, field_model::FieldModel, field_worker::FieldRequest, observation::Observation,
};

/// Keyframes by swing angle that each one is compared with densely.
const NEIGHBOURS: usize = 6;

/// Most solves in which the weight of the field's poses is found, and by what share it may still change at the end.
const WEIGHINGS: usize = 20;
const WEIGHED: f64 = 0.1;
/// Where the search for it starts: next to nothing. A prior that begins with all that it claims may pull everything to itself
/// and then has no residuals.
const UNWEIGHED: f64 = 1e-6;

/// `obj_from_cam` of all keyframes of the request, started at `poses`, the first one held. With a `field` each keyframe
/// is also drawn to where its training left it, as much as the field's surface determines it. What nothing tells of a pose
/// stays as the request has it: training turns a plain can about its axis, round by round towards the views beside it,
/// until all sides that were seen are one. `None` if the graph can't be built or solved.
pub(crate) fn optimise(
    request: &FieldRequest,
    poses: &[Isometry3<f64>],
    field: Option<&TrainedField>,
) -> Option<Vec<Isometry3<f64>>> {
    let options = request.graph.solve_options(field.is_some());
    let priors = field.map_or_else(Vec::new, |field| field_priors(request, field, &options));
    let held: Vec<_> = request.frames.iter().map(|(_, _, pose)| *pose).collect();
    Some(solve(&graph(request, (poses, &held), &priors)?, &options).ok()?.poses)
}

/// As [`optimise`], but what no measurement tells of a pose stays as in `held`, and how much the field's poses count is
/// found from how well they agree with everything else. Also answers that weight: 1 is what [`optimise`] gives them, and
/// none has more. Ends with what it has when `stop` is set.
///
/// The prior takes the field's errors for noise of its points. They are not: the surface is smoother or rougher than the
/// true one, and all points of a view are off together. So its variance is measured in the units that it claims, its
/// residuals squared over its redundancy, and it counts by the inverse (Helmert's estimate of variance components).
/// Matches and depth count as the config says: their residuals don't show what all have wrong together, a depth that is
/// off by the same everywhere.
pub(crate) fn optimise_weighed(
    request: &FieldRequest,
    poses: &[Isometry3<f64>],
    held: &[Isometry3<f64>],
    field: Option<&TrainedField>,
    stop: &AtomicBool,
) -> Option<(Vec<Isometry3<f64>>, f64)> {
    let options = SolveOptions { covariance: true, ..request.graph.solve_options(field.is_some()) };
    let claimed = field.map_or_else(Vec::new, |field| field_priors(request, field, &options));
    weigh(request, (poses, held), &claimed, &options, stop)
}

/// The poses and the weight of the priors, from what these claim.
fn weigh(
    request: &FieldRequest,
    (poses, held): (&[Isometry3<f64>], &[Isometry3<f64>]),
    claimed: &[PosePrior],
    options: &SolveOptions,
    stop: &AtomicBool,
) -> Option<(Vec<Isometry3<f64>>, f64)> {
    let mut weight = UNWEIGHED;
    let mut found = None;
    for _ in 0..WEIGHINGS {
        if stop.load(Ordering::Relaxed) {
            break;
        }
        let scaled = |p: &PosePrior| PosePrior { information: p.information * weight, ..*p };
        let priors: Vec<_> = claimed.iter().map(scaled).collect();
        let solution = solve(&graph(request, (poses, held), &priors)?, options).ok()?;
        let variance = prior_variance(&priors, &solution);
        tracing::debug!(
            weight,
            variance,
            matches = solution.feature_rms,
            depth = solution.dense_rms,
            "field weighed"
        );
        found = Some((solution.poses, weight));
        let Some(variance) = variance else { break };
        let next = (weight / variance).min(1.0);
        if (next - weight).abs() <= WEIGHED * weight {
            break;
        }
        weight = next;
    }
    found
}

/// Variance of the priors over what they claim, given a solution with them; `None` where they alone determine it.
fn prior_variance(priors: &[PosePrior], solution: &Solution) -> Option<f64> {
    let (mut squares, mut redundancy) = (0.0, 0.0);
    for prior in priors {
        let Some(covariance) = solution.covariances.get(prior.node).copied().flatten() else { continue };
        let residual = se3::log(&(solution.poses.get(prior.node)? * prior.obj_from_cam.inverse()));
        squares += residual.dot(&(prior.information * residual));
        // A motion of which the prior says nothing has no residual and no redundancy.
        let known = SymmetricEigen::new(prior.information).eigenvalues;
        let dimensions = known.iter().filter(|value| **value > 1e-6 * known.max()).count() as f64;
        redundancy += dimensions - (covariance * prior.information).trace();
    }
    let variance = squares / redundancy;
    (redundancy > 0.0 && variance.is_finite() && variance > 0.0).then_some(variance)
}

/// Where the training left each free keyframe, as far as the field's surface determines it.
fn field_priors(request: &FieldRequest, field: &TrainedField, options: &SolveOptions) -> Vec<PosePrior> {
    let model = FieldModel(field);
    let prior =
        |(node, ((_, observation, _), trained)): (usize, (&(_, Arc<Observation>, _), &Isometry3<f64>))| {
            let points = observation.sdf_points(request.graph.sdf_points);
            let information = SdfTerm { node, points, model: &model }.information(trained, options);
            PosePrior { node, obj_from_cam: *trained, information }
        };
    request.frames.iter().zip(field.poses()).enumerate().map(prior).collect()
}

/// The graph over all keyframes, at `start`; what no measurement tells of a pose stays as in `held`.
fn graph<'r>(
    request: &'r FieldRequest,
    (start, held): (&[Isometry3<f64>], &[Isometry3<f64>]),
    priors: &[PosePrior],
) -> Option<PoseGraph<'r>> {
    let mut graph = PoseGraph::new();
    for (position, ((_, observation, _), (pose, held))) in
        request.frames.iter().zip(start.iter().zip(held)).enumerate()
    {
        let node = graph.add_node(Node { obj_from_cam: *pose, fixed: position == 0 });
        graph.set_view(node, &observation.dense).ok()?;
        graph.set_prediction(node, *held).ok()?;
    }
    for prior in priors {
        graph.add_prior(*prior).ok()?;
    }
    let position = |index: usize| request.frames.iter().position(|(i, _, _)| *i == index);
    for ((older, newer), edge) in &request.edges {
        let (Some(i), Some(j)) = (position(*older), position(*newer)) else { continue };
        graph.add_feature_edge(edge.feature_edge(i, j)).ok()?;
    }
    for (source, target) in dense_pairs(start) {
        graph.add_dense_edge(DenseEdge { source, target }).ok()?;
    }
    Some(graph)
}

/// Each keyframe with the nearest of those before it.
fn dense_pairs(poses: &[Isometry3<f64>]) -> Vec<(usize, usize)> {
    let mut pairs = Vec::new();
    for (i, pose) in poses.iter().enumerate() {
        let swing = |j: &usize| swing_angle(&pose.rotation, &poses[*j].rotation);
        let mut near: Vec<usize> = (0..i).filter(|j| swing(j) < MAX_DENSE_SWING).collect();
        near.sort_by(|a, b| swing(a).total_cmp(&swing(b)));
        pairs.extend(near.into_iter().take(NEIGHBOURS).map(|j| (i, j)));
    }
    pairs
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix6, Vector3};
    use rgbd_synth::Sequence;

    use super::*;
    use crate::{config::Config, field_worker::Round, tracker::offline};

    /// Keyframes of a short video at their true poses, in the frame of the first, with matches between neighbours.
    fn keyframes() -> FieldRequest {
        let config = Config::default();
        let video = Sequence::demo();
        let observed = |index: usize| {
            let shot = video.render(index);
            let seen = Observation::new(index, &shot.frame, &shot.visible_mask, &config).unwrap();
            (index, Arc::new(seen), shot.cam_from_obj.inverse())
        };
        let frames: Vec<_> = (0..6).map(|k| observed(2 * k)).collect();
        let edges = frames.windows(2).flat_map(|pair| {
            let [(older, a, at), (newer, b, pose)] = pair else { return Vec::new() };
            let (_, edges) = offline::matched([(*older, (&**a, at))], b, pose, &config);
            edges.into_iter().map(|(older, edge)| ((older, *newer), edge)).collect()
        });
        let edges: Vec<_> = edges.collect();
        assert_eq!(edges.len(), 5);
        FieldRequest { round: Round::PoseGraph, graph: config.graph, edges, frames }
    }

    #[test]
    fn a_turn_that_nothing_tells_stays_as_before_the_training() {
        let config = Config::default();
        let video = Sequence::named("symmetric").unwrap();
        let frames: Vec<_> = (0..4)
            .map(|k| {
                let shot = video.render(4 * k);
                let seen = Observation::new(4 * k, &shot.frame, &shot.visible_mask, &config).unwrap();
                (4 * k, Arc::new(seen), shot.cam_from_obj.inverse())
            })
            .collect();
        let truth: Vec<_> = frames.iter().map(|(_, _, pose)| *pose).collect();
        let request =
            FieldRequest { round: Round::PoseGraph, graph: config.graph, edges: Vec::new(), frames };
        // The can's axis is y. Training has turned each view about it, and tilted it, by a degree more than the one before.
        let off = |axis: Vector3<f64>, k: usize| Isometry3::rotation(axis * (k as f64).to_radians());
        let trained: Vec<_> =
            truth.iter().enumerate().map(|(k, t)| off(Vector3::y(), k) * off(Vector3::x(), k) * t).collect();
        let poses = optimise(&request, &trained, None).unwrap();
        for (pose, truth) in poses.iter().zip(&truth) {
            let error = (pose * truth.inverse()).rotation.scaled_axis().map(f64::to_degrees);
            assert!(error.y.abs() < 0.3 && error.x.hypot(error.z) < 0.5, "{error}");
        }
    }

    /// Largest turn off the truth, degrees.
    fn furthest(poses: &[Isometry3<f64>], truth: &[Isometry3<f64>]) -> f64 {
        poses
            .iter()
            .zip(truth)
            .map(|(p, t)| p.rotation.angle_to(&t.rotation))
            .fold(0.0, f64::max)
            .to_degrees()
    }

    #[test]
    fn priors_that_are_off_together_count_by_their_errors_and_not_by_what_they_claim() {
        let request = keyframes();
        let truth: Vec<_> = request.frames.iter().map(|(_, _, pose)| *pose).collect();
        let options = SolveOptions { covariance: true, ..request.graph.solve_options(true) };
        let go_on = AtomicBool::new(false);
        // A tenth of a millimetre and of a degree are claimed.
        let mut information = Matrix6::identity() * 1e8;
        information.fixed_view_mut::<3, 3>(3, 3).copy_from(&(nalgebra::Matrix3::identity() * 3e5));
        let claim = |turn: f64| -> Vec<_> {
            let off = |k: usize| Isometry3::rotation(Vector3::y() * (turn * k as f64).to_radians());
            let prior = |(node, pose)| PosePrior { node, obj_from_cam: off(node) * pose, information };
            truth.iter().enumerate().map(prior).collect()
        };
        let alone = weigh(&request, (&truth, &truth), &[], &options, &go_on).unwrap().0;
        let alone = furthest(&alone, &truth);

        // Each view is turned a degree further than the one before, as by a surface that is bent.
        let bent = claim(1.0);
        let taken = solve(&graph(&request, (&truth, &truth), &bent).unwrap(), &options).unwrap().poses;
        let (poses, weight) = weigh(&request, (&truth, &truth), &bent, &options, &go_on).unwrap();
        let (believed, weighed) = (furthest(&taken, &truth), furthest(&poses, &truth));
        assert!(believed > 10.0 * weighed && weight < 0.02, "{believed} {weighed} {weight}");
        // To claim more is of no use.
        let more = |p: &PosePrior| PosePrior { information: p.information * 100.0, ..*p };
        let bolder: Vec<_> = bent.iter().map(more).collect();
        let (poses, less) = weigh(&request, (&truth, &truth), &bolder, &options, &go_on).unwrap();
        let again = furthest(&poses, &truth);
        assert!((again - weighed).abs() < 0.05 * weighed && less < 0.02 * weight, "{again} {weighed} {less}");

        // True ones are not outvoted.
        let (poses, weight) = weigh(&request, (&truth, &truth), &claim(0.0), &options, &go_on).unwrap();
        let weighed = furthest(&poses, &truth);
        assert!(weighed < 0.5 * alone && weight > 0.5, "{weighed} {alone} {weight}");
    }
}
