//! One pose graph over all keyframes: what a field round ends with, and the whole round of the paper's GPG ablation.

use nalgebra::Isometry3;
use neural_field::TrainedField;
use posegraph::{DenseEdge, Node, PoseGraph, PosePrior, SdfTerm, solve};
use se3_lie::distance::swing_angle;

use crate::{config::MAX_DENSE_SWING, field_model::FieldModel, field_worker::FieldRequest};

/// Keyframes by swing angle that each one is compared with densely.
const NEIGHBOURS: usize = 6;

/// `obj_from_cam` of all keyframes of the request, started at `poses`, the first one held. With a `field` each keyframe
/// is also drawn to `poses`, where its training left it, as much as the field's surface determines it. `None` if the graph
/// can't be built or solved.
pub(crate) fn optimise(
    request: &FieldRequest,
    poses: &[Isometry3<f64>],
    field: Option<&TrainedField>,
) -> Option<Vec<Isometry3<f64>>> {
    let FieldRequest { frames, edges, graph: config, .. } = request;
    let model = field.map(FieldModel);
    let options = config.solve_options(field.is_some());
    let mut graph = PoseGraph::new();
    for (position, ((_, observation, _), pose)) in frames.iter().zip(poses).enumerate() {
        let node = graph.add_node(Node { obj_from_cam: *pose, fixed: position == 0 });
        graph.set_view(node, &observation.dense).ok()?;
        if let Some(model) = &model {
            let points = observation.sdf_points(config.sdf_points);
            let information = SdfTerm { node, points, model }.information(pose, &options);
            graph.add_prior(PosePrior { node, obj_from_cam: *pose, information }).ok()?;
        }
    }
    let position = |index: usize| frames.iter().position(|(i, _, _)| *i == index);
    for ((older, newer), edge) in edges {
        let (Some(i), Some(j)) = (position(*older), position(*newer)) else { continue };
        graph.add_feature_edge(edge.feature_edge(i, j)).ok()?;
    }
    for (source, target) in dense_pairs(poses) {
        graph.add_dense_edge(DenseEdge { source, target }).ok()?;
    }
    Some(solve(&graph, &options).ok()?.poses)
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
