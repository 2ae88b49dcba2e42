//! What the tracker does with one frame, without the tracker: for work on a video that has ended.

use matcher::klt::KltOptions;
use nalgebra::Isometry3;
use neural_field::TrainedField;

use super::{
    coarse::{self, Descriptors, Gates, Search, agreement_with_memory, within},
    correspond::guided_tracks,
    graph::{GraphProblem, GraphResult},
    memory::{ViewEdges, ViewTracks, agreeing_edges},
};
use crate::{config::Config, observation::Observation, pool::MemoryPool};

/// An observation at a pose (`obj_from_cam`).
pub(crate) type Placed<'a> = (&'a Observation, &'a Isometry3<f64>);

/// The pose of an observation, guessed at `guess`, on which most matches with other posed observations agree, and the
/// matches that follow it, by the position of the other; the guess and no matches when too few agree.
pub(crate) fn matched<'a>(
    others: impl IntoIterator<Item = (usize, Placed<'a>)>,
    observation: &Observation,
    guess: &Isometry3<f64>,
    config: &Config,
) -> (Isometry3<f64>, ViewEdges) {
    let c = &config.coarse;
    let tracks = |(position, (other, pose)): (usize, Placed<'a>)| {
        let to_from = guess.inv_mul(pose);
        let options = KltOptions::default();
        let tracks = guided_tracks(other, observation, &to_from, c.max_corners_memory, &options);
        ViewTracks { position, pose, tracks }
    };
    let views: Vec<_> = others.into_iter().map(tracks).collect();
    let search = Search {
        config: c,
        gates: Gates::CORRECTION,
        min_inliers: c.min_inliers,
        focal: observation.intrinsics.fx,
        swing: Search::MEMORY_SWING,
        seed: config.seed ^ ((observation.index as u64) << 20),
    };
    agreeing_edges(&views, None, guess, &search).unwrap_or((*guess, Vec::new()))
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
    let keyframes = selected.iter().filter_map(|position| {
        let keyframe = pool.keyframes().get(*position)?;
        Some((*position, (&*keyframe.observation, &keyframe.obj_from_cam)))
    });
    let (start, edges) = matched(keyframes, observation, guess, config);
    let problem = GraphProblem {
        observation,
        guess: start,
        prediction: Some(*guess),
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
