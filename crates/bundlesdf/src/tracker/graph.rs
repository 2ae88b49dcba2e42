//! Online pose-graph optimisation of one new frame against memory frames (paper section 3.3).

use nalgebra::Isometry3;
use neural_field::TrainedField;
use posegraph::{DenseEdge, FeatureEdge, Node, PoseGraph, SdfTerm, SolveOptions, solve};
use se3_lie::distance::swing_angle;

use super::{Uncertainty, correspond::Correspondence};
use crate::{
    config::{GraphConfig, MAX_DENSE_SWING},
    field_model::FieldModel,
    observation::Observation,
    pool::{MemoryEdge, MemoryPool},
};

/// Pixels that all dense edges of a frame compare, about: with ten keyframes thousands of them tie every pose, and more
/// cost time without telling more.
const MAX_DENSE: usize = 16_000;

/// The new frame and what it is compared with.
pub(super) struct GraphProblem<'a> {
    pub(super) observation: &'a Observation,
    /// Coarse `obj_from_cam`.
    pub(super) guess: Isometry3<f64>,
    /// `obj_from_cam` that stands where nothing tells of a motion; `None` = the guess.
    pub(super) prediction: Option<Isometry3<f64>>,
    pub(super) pool: &'a MemoryPool,
    /// Positions in the pool of the keyframes that take part, oldest first.
    pub(super) selected: &'a [usize],
    /// Verified matches to keyframes: position in the pool and matches (keyframe = older).
    pub(super) edges: &'a [(usize, MemoryEdge)],
    /// The previous frame with its matches, when memory alone gives too few.
    pub(super) previous: Option<(&'a Observation, Isometry3<f64>, &'a MemoryEdge)>,
    pub(super) field: Option<&'a TrainedField>,
    pub(super) config: &'a GraphConfig,
}

/// What the pose graph found.
pub(super) struct GraphResult {
    /// `obj_from_cam` of the new frame.
    pub(super) pose: Isometry3<f64>,
    /// New poses of the keyframes that were free, by position in the pool.
    pub(super) moved: Vec<(usize, Isometry3<f64>)>,
    /// What is known of the new frame's pose.
    pub(super) uncertainty: Option<Uncertainty>,
}

impl MemoryEdge {
    pub(super) fn from_matches<'m>(matches: impl IntoIterator<Item = &'m Correspondence>) -> Self {
        let mut edge = Self::default();
        for m in matches {
            edge.older.push(m.a);
            edge.newer.push(m.b);
            edge.weights.push(m.weight);
        }
        edge
    }

    /// As an edge between two nodes, `i` the older.
    pub(crate) fn feature_edge(&self, i: usize, j: usize) -> FeatureEdge {
        FeatureEdge {
            i,
            j,
            points_i: self.older.clone(),
            points_j: self.newer.clone(),
            weights: self.weights.clone(),
        }
    }
}

impl GraphProblem<'_> {
    /// Solves the graph; `None` if it can't be built (the coarse pose stands then).
    pub(super) fn solve(&self) -> Option<GraphResult> {
        let model = self.field.map(FieldModel);
        let mut graph = PoseGraph::new();
        let fixed = self.fixed();
        for (position, fixed) in self.selected.iter().zip(&fixed) {
            let keyframe = self.pool.keyframes().get(*position)?;
            let node = graph.add_node(Node { obj_from_cam: keyframe.obj_from_cam, fixed: *fixed });
            graph.set_view(node, &keyframe.observation.dense).ok()?;
        }
        let new = graph.add_node(Node { obj_from_cam: self.guess, fixed: false });
        graph.set_view(new, &self.observation.dense).ok()?;
        graph.set_prediction(new, self.prediction.unwrap_or(self.guess)).ok()?;
        self.add_memory_edges(&mut graph, new, &fixed)?;
        if let Some((observation, pose, edge)) = self.previous {
            let node = graph.add_node(Node { obj_from_cam: pose, fixed: true });
            graph.set_view(node, &observation.dense).ok()?;
            graph.add_feature_edge(edge.feature_edge(node, new)).ok()?;
            graph.add_dense_edge(DenseEdge { source: new, target: node }).ok()?;
        }
        if let Some(model) = &model {
            let points = self.observation.sdf_points(self.config.sdf_points);
            graph.add_sdf_term(SdfTerm { node: new, points, model }).ok()?;
        }
        let options =
            SolveOptions { max_dense: MAX_DENSE, ..self.config.solve_options(self.field.is_some()) };
        let solution = solve(&graph, &options).ok()?;
        let pose = *solution.poses.get(new)?;
        let moved = self.selected.iter().enumerate().filter(|(node, _)| !fixed[*node]);
        let moved =
            moved.filter_map(|(node, position)| Some((*position, *solution.poses.get(node)?))).collect();
        tracing::debug!(
            initial = solution.cost_initial,
            last = solution.cost_final,
            iterations = solution.iterations,
            "pose graph"
        );
        let uncertainty = solution.observability.as_ref().map(Uncertainty::of);
        Some(GraphResult { pose, moved, uncertainty })
    }

    /// Keyframes that the field has refined and the anchor are constants; without any the oldest holds the gauge.
    fn fixed(&self) -> Vec<bool> {
        let keyframes = self.pool.keyframes();
        let mut fixed: Vec<bool> = self
            .selected
            .iter()
            .map(|p| *p == 0 || keyframes.get(*p).is_some_and(|k| k.refined_by_field))
            .collect();
        if !fixed.contains(&true)
            && let Some(oldest) = fixed.first_mut()
        {
            *oldest = true;
        }
        fixed
    }

    fn add_memory_edges(&self, graph: &mut PoseGraph<'_>, new: usize, fixed: &[bool]) -> Option<()> {
        let keyframes = self.pool.keyframes();
        for (node, position) in self.selected.iter().enumerate() {
            let keyframe = keyframes.get(*position)?;
            if let Some((_, edge)) = self.edges.iter().find(|(p, _)| p == position) {
                graph.add_feature_edge(edge.feature_edge(node, new)).ok()?;
            }
            if swing_angle(&keyframe.obj_from_cam.rotation, &self.guess.rotation) < MAX_DENSE_SWING {
                let source_is_new = self.observation.valid <= keyframe.observation.valid;
                let (source, target) = if source_is_new { (new, node) } else { (node, new) };
                graph.add_dense_edge(DenseEdge { source, target }).ok()?;
            }
            for (other, other_position) in self.selected.iter().enumerate().take(node) {
                if fixed[node] && fixed[other] {
                    continue;
                }
                let older = keyframes.get(*other_position)?;
                if let Some(edge) = self.pool.edge(older.index, keyframe.index) {
                    graph.add_feature_edge(edge.feature_edge(other, node)).ok()?;
                }
                if swing_angle(&keyframe.obj_from_cam.rotation, &older.obj_from_cam.rotation)
                    < MAX_DENSE_SWING
                {
                    graph.add_dense_edge(DenseEdge { source: node, target: other }).ok()?;
                }
            }
        }
        Some(())
    }
}
