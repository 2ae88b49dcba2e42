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

/// Matches of a posed view (a) with a new one (b), not yet verified.
pub(super) struct ViewTracks<'a> {
    /// The view's number for the caller.
    pub(super) position: usize,
    /// Its `obj_from_cam`.
    pub(super) pose: &'a Isometry3<f64>,
    pub(super) tracks: Vec<Correspondence>,
}

/// Verified matches of a new view by the positions of the posed ones.
pub(crate) type ViewEdges = Vec<(usize, MemoryEdge)>;

/// The pose of a new view on which most of its matches with posed views agree, and by the views' positions the matches
/// that follow it; `previous` has a say as well, without an edge of its own. `None` if too few agree.
///
/// A highlight or a hand's shadow stays in place while the object turns under it: each view alone may agree on a wrong
/// motion, but each on another one, since each saw it elsewhere on the object. A view that contradicts the others is
/// believed where it has a majority of its own and lies near: then its pose has drifted, and the pose graph can mend
/// that.
pub(super) fn agreeing_edges(
    views: &[ViewTracks<'_>],
    previous: Option<(&Isometry3<f64>, &[Correspondence])>,
    guess: &Isometry3<f64>,
    search: &Search<'_>,
) -> Option<(Isometry3<f64>, ViewEdges)> {
    let groups: Vec<_> = views.iter().map(|v| (v.pose, v.tracks.as_slice())).chain(previous).collect();
    let (pose, agreeing) = joint_motion(&groups, guess, search)?;
    let edge = |(view, agreeing): (&ViewTracks<'_>, Vec<Correspondence>)| {
        if agreeing.len() >= MIN_AGREEING {
            return Some((view.position, MemoryEdge::from_matches(&agreeing)));
        }
        let search = Search { gates: Gates::DRIFT, ..*search };
        let own = coarse_from_matches(view.tracks.clone(), view.pose, &pose, &search)?;
        let majority = 2 * own.matches.len() >= view.tracks.len().max(4 * search.min_inliers);
        majority.then(|| (view.position, MemoryEdge::from_matches(&own.matches)))
    };
    let edges = views.iter().zip(agreeing).filter_map(edge).collect();
    Some((pose, edges))
}

impl Tracker {
    /// The guess, corrected by the motion that most matches with memory and with the previous frame share, and by
    /// position in the pool the matches that follow it (see [`agreeing_edges`]).
    pub(super) fn memory_edges(
        &self,
        observation: &Observation,
        guess: Isometry3<f64>,
        coarse: Option<&CoarsePose>,
        selected: &[usize],
    ) -> (Isometry3<f64>, ViewEdges) {
        let tracks = self.memory_tracks(observation, &guess, selected);
        let search = Search {
            config: &self.config.coarse,
            gates: Gates::CORRECTION,
            min_inliers: self.config.coarse.min_inliers,
            focal: observation.intrinsics.fx,
            swing: Search::MEMORY_SWING,
            seed: self.config.seed ^ ((observation.index as u64) << 20),
        };
        let previous = self.reference.as_ref().zip(coarse).map(|(r, c)| (&r.pose, c.matches.as_slice()));
        agreeing_edges(&tracks, previous, &guess, &search).unwrap_or((guess, Vec::new()))
    }

    /// Point tracks from each selected keyframe into the new frame, and the matches of a network where there is one.
    fn memory_tracks(
        &self,
        observation: &Observation,
        guess: &Isometry3<f64>,
        selected: &[usize],
    ) -> Vec<ViewTracks<'_>> {
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
            let pose = &keyframe.obj_from_cam;
            (!tracks.is_empty()).then_some(ViewTracks { position: *position, pose, tracks })
        };
        selected.par_iter().filter_map(track).collect()
    }
}
