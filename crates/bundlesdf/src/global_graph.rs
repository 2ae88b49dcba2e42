//! One pose graph over all keyframes: the refiner of the paper's GPG ablation.

use std::sync::Arc;

use nalgebra::Isometry3;
use posegraph::{DenseEdge, FeatureEdge, Node, PoseGraph, SolveOptions, solve};
use se3_lie::distance::swing_angle;

use crate::{config::GraphConfig, observation::Observation, pool::MemoryEdge};

/// Keyframes by swing angle that each one is compared with densely.
const NEIGHBOURS: usize = 6;
/// Beyond this swing two views share too little surface for a dense comparison (radians).
const MAX_SWING: f64 = 1.0;

/// Poses (`obj_from_cam`) of all `frames`, the first one held; `None` if the graph can't be built or solved.
pub(crate) fn optimise(
    frames: &[(usize, Arc<Observation>, Isometry3<f64>)],
    edges: &[((usize, usize), MemoryEdge)],
    config: &GraphConfig,
) -> Option<Vec<Isometry3<f64>>> {
    let mut graph = PoseGraph::new();
    for (position, (_, observation, pose)) in frames.iter().enumerate() {
        let node = graph.add_node(Node { obj_from_cam: *pose, fixed: position == 0 });
        graph.set_view(node, &observation.dense).ok()?;
    }
    let position = |index: usize| frames.iter().position(|(i, _, _)| *i == index);
    for ((older, newer), edge) in edges {
        let (Some(i), Some(j)) = (position(*older), position(*newer)) else { continue };
        let edge = FeatureEdge {
            i,
            j,
            points_i: edge.older.clone(),
            points_j: edge.newer.clone(),
            weights: edge.weights.clone(),
        };
        graph.add_feature_edge(edge).ok()?;
    }
    for (source, target) in dense_pairs(frames) {
        graph.add_dense_edge(DenseEdge { source, target }).ok()?;
    }
    let options = SolveOptions {
        max_iterations: config.iterations,
        feature_weight: config.feature_weight,
        dense_weight: config.dense_weight,
        sdf_weight: 0.0,
        feature_huber: config.huber,
        dense_huber: config.huber,
        covariance: false,
        ..SolveOptions::default()
    };
    Some(solve(&graph, &options).ok()?.poses)
}

/// Each keyframe with the nearest of those before it.
fn dense_pairs(frames: &[(usize, Arc<Observation>, Isometry3<f64>)]) -> Vec<(usize, usize)> {
    let mut pairs = Vec::new();
    for (i, (_, _, pose)) in frames.iter().enumerate() {
        let swing = |j: &usize| swing_angle(&pose.rotation, &frames[*j].2.rotation);
        let mut near: Vec<usize> = (0..i).filter(|j| swing(j) < MAX_SWING).collect();
        near.sort_by(|a, b| swing(a).total_cmp(&swing(b)));
        pairs.extend(near.into_iter().take(NEIGHBOURS).map(|j| (i, j)));
    }
    pairs
}
