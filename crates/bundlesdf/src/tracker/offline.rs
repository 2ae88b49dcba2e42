//! What the tracker does with one frame, without the tracker: for work on a video that has ended.

use matcher::klt::KltOptions;
use nalgebra::Isometry3;
use neural_field::TrainedField;
use se3_lie::distance::swing_angle;

use super::{
    coarse::{self, Descriptors, Gates, Search, agreement_with_memory, coarse_from_matches, within},
    correspond::guided_tracks,
    graph::{GraphProblem, GraphResult},
};
use crate::{
    config::Config,
    observation::Observation,
    pool::{MemoryEdge, MemoryPool},
};

/// An observation at a pose (`obj_from_cam`).
pub(crate) type Placed<'a> = (&'a Observation, &'a Isometry3<f64>);

/// Verified matches of two observations whose poses are known roughly; `None` when they agree on too few.
pub(crate) fn matched_pair(older: Placed<'_>, newer: Placed<'_>, config: &Config) -> Option<MemoryEdge> {
    let c = &config.coarse;
    let to_from = newer.1.inv_mul(older.1);
    let tracks = guided_tracks(older.0, newer.0, &to_from, c.max_corners_memory, &KltOptions::default());
    let search = Search {
        config: c,
        gates: Gates::CORRECTION,
        min_inliers: c.min_inliers,
        focal: newer.0.intrinsics.fx,
        swing: swing_angle(&older.1.rotation, &newer.1.rotation),
        seed: config.seed ^ ((newer.0.index as u64) << 20) ^ older.0.index as u64,
    };
    let verified = coarse_from_matches(tracks, older.1, newer.1, &search)?;
    Some(MemoryEdge::from_matches(&verified.matches))
}

/// Pose of an observation against the keyframes of `pool`, which stay where they are, and the field, from a guess;
/// the guess itself where the pose graph fails or runs away.
pub(crate) fn place(
    pool: &MemoryPool,
    field: &TrainedField,
    observation: &Observation,
    guess: &Isometry3<f64>,
    config: &Config,
) -> Isometry3<f64> {
    let selected = pool.select(guess, &config.memory);
    let edges: Vec<_> = selected
        .iter()
        .filter_map(|position| {
            let keyframe = pool.keyframes().get(*position)?;
            let older = (&*keyframe.observation, &keyframe.obj_from_cam);
            Some((*position, matched_pair(older, (observation, guess), config)?))
        })
        .collect();
    let problem = GraphProblem {
        observation,
        guess: *guess,
        prediction: None,
        pool,
        selected: &selected,
        edges: &edges,
        previous: None,
        field: Some(field),
        config: &config.graph,
    };
    match problem.solve() {
        Some(GraphResult { pose, .. }) if within(Gates::CORRECTION, guess, &pose) => pose,
        _ => *guess,
    }
}

/// Share of the compared depth that agrees with a pose, 0 to 1, where enough could be compared.
pub(crate) fn agreement(pool: &MemoryPool, observation: &Observation, pose: &Isometry3<f64>) -> Option<f64> {
    agreement_with_memory(pool, observation, pose).known_share()
}

/// Pose of an observation without a guess, by descriptors.
pub(crate) fn find(pool: &MemoryPool, observation: &Observation, config: &Config) -> Option<Isometry3<f64>> {
    coarse::relocalise(pool, observation, &Descriptors::default(), config).map(|found| found.pose)
}
