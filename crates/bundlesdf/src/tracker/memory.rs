//! Matches of the new frame with the keyframes, and the one motion on which they agree.

use matcher::klt::KltOptions;
use nalgebra::Isometry3;
use rayon::prelude::*;

use super::{
    Tracker,
    coarse::{CoarsePose, Gates, Search, coarse_from_matches, joint_motion},
    correspond::{Correspondence, guided_tracks},
    wide::WideMatcher,
};
use crate::{observation::Observation, pool::MemoryEdge};

/// Fewest matches of a keyframe that agree with all others.
const MIN_AGREEING: usize = 3;

impl Tracker {
    /// The guess, corrected by the motion that most matches with memory and with the previous frame share, and by
    /// position in the pool the matches that follow it.
    ///
    /// A highlight or a hand's shadow stays in place while the object turns under it: each keyframe alone may agree on
    /// a wrong motion, but each on another one, since each saw it elsewhere on the object. A keyframe that contradicts
    /// the others is believed where it has a majority of its own and lies near: then its pose has drifted, and the
    /// pose graph can mend that.
    pub(super) fn memory_edges(
        &self,
        observation: &Observation,
        guess: Isometry3<f64>,
        coarse: Option<&CoarsePose>,
        selected: &[usize],
    ) -> (Isometry3<f64>, Vec<(usize, MemoryEdge)>) {
        let tracks = self.memory_tracks(observation, &guess, selected);
        let search = Search {
            config: &self.config.coarse,
            gates: Gates::CORRECTION,
            min_inliers: self.config.coarse.min_inliers,
            focal: observation.intrinsics.fx,
            swing: Search::MEMORY_SWING,
            seed: self.config.seed ^ ((observation.index as u64) << 20),
        };
        let keyframes = self.pool.keyframes();
        let mut groups: Vec<(&Isometry3<f64>, &[Correspondence])> = tracks
            .iter()
            .filter_map(|(position, t)| Some((&keyframes.get(*position)?.obj_from_cam, t.as_slice())))
            .collect();
        if let (Some(reference), Some(coarse)) = (&self.reference, coarse) {
            groups.push((&reference.pose, &coarse.matches));
        }
        let Some((pose, agreeing)) = joint_motion(&groups, &guess, &search) else {
            return (guess, Vec::new());
        };
        let edges = tracks.iter().zip(agreeing).filter_map(|((position, tracks), agreeing)| {
            if agreeing.len() >= MIN_AGREEING {
                return Some((*position, MemoryEdge::from_matches(&agreeing)));
            }
            let drifted = &keyframes.get(*position)?.obj_from_cam;
            let search = Search { gates: Gates::DRIFT, ..search };
            let own = coarse_from_matches(tracks.clone(), drifted, &pose, &search)?;
            let majority = 2 * own.matches.len() >= tracks.len().max(4 * search.min_inliers);
            majority.then(|| (*position, MemoryEdge::from_matches(&own.matches)))
        });
        let edges = edges.collect();
        (pose, edges)
    }

    /// Point tracks from each selected keyframe into the new frame, and the matches of a network where there is one.
    fn memory_tracks(
        &self,
        observation: &Observation,
        guess: &Isometry3<f64>,
        selected: &[usize],
    ) -> Vec<(usize, Vec<Correspondence>)> {
        let (pool, corners) = (&self.pool, self.config.coarse.max_corners_memory);
        let wide = self.descriptors.wide.as_ref().map(|wide| {
            let seen = selected.iter().filter_map(|position| pool.keyframes().get(*position));
            (wide, wide.turned(observation, seen.map(|k| WideMatcher::steps(&k.obj_from_cam, guess))))
        });
        let track = |position: &usize| {
            let keyframe = pool.keyframes().get(*position)?;
            let to_from = guess.inv_mul(&keyframe.obj_from_cam);
            let options = KltOptions::default();
            let mut tracks = guided_tracks(&keyframe.observation, observation, &to_from, corners, &options);
            if let Some((wide, turned)) = &wide
                && let Some(in_b) = turned.get(&WideMatcher::steps(&keyframe.obj_from_cam, guess))
            {
                tracks.extend(wide.correspondences((&keyframe.observation, observation), in_b, &to_from));
            }
            (!tracks.is_empty()).then_some((*position, tracks))
        };
        selected.par_iter().filter_map(track).collect()
    }
}
