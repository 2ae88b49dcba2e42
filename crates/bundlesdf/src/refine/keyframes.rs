//! The keyframes of a run, read again, and one pose graph over all of them.

use std::sync::{
    Arc,
    atomic::{AtomicBool, AtomicUsize, Ordering},
};

use nalgebra::Isometry3;
use neural_field::TrainedField;
use rayon::prelude::*;
use se3_lie::distance::swing_angle;

use super::{Progress, RefineError, Run};
use crate::{
    config::Config,
    field_worker::{FieldRequest, Round},
    global_graph,
    observation::Observation,
    pool::MemoryEdge,
    report::KeyframeReport,
    tracker::offline,
};

/// Earlier keyframes that each one is matched with, nearest by swing first.
const PARTNERS: usize = 8;
/// Views further apart than this share too little to be matched (radians).
const MAX_SWING: f64 = 0.9;

/// A keyframe on its way to its refined pose.
#[derive(Clone)]
pub(super) struct Keyframe {
    pub(super) id: String,
    pub(super) observation: Arc<Observation>,
    /// `obj_from_cam` that its frame was given while the video ran: what its neighbours were tracked against.
    pub(super) online: Isometry3<f64>,
    /// The best pose so far.
    pub(super) refined: Isometry3<f64>,
}

/// Reads all keyframes; one that can't be observed again, or has no pose, is left out.
pub(super) fn read(
    run: &Run<'_>,
    stop: &AtomicBool,
    progress: &(dyn Fn(Progress) + Sync),
) -> Result<Vec<Keyframe>, RefineError> {
    let reports = run.folder.read_keyframes()?;
    let done = AtomicUsize::new(0);
    let read = |report: &KeyframeReport| {
        if stop.load(Ordering::Relaxed) {
            return Err(RefineError::Stopped);
        }
        let observation = run.observe(report.index, &report.id)?;
        progress(Progress::Reading(done.fetch_add(1, Ordering::Relaxed) + 1, reports.len()));
        let (Some(observation), Some(pose)) = (observation, report.pose()) else { return Ok(None) };
        let online = run.folder.read_pose(&report.id)?.inverse();
        Ok(Some(Keyframe {
            id: report.id.clone(),
            observation: Arc::new(observation),
            online,
            refined: pose.inverse(),
        }))
    };
    let keyframes: Vec<_> = reports.par_iter().map(read).collect::<Result<_, _>>()?;
    Ok(keyframes.into_iter().flatten().collect())
}

/// Matches between the keyframes, by frame index, `(older, newer)`.
pub(super) type Edges = Vec<((usize, usize), MemoryEdge)>;

/// Matches of each keyframe with those before it that look from nearly the same side.
pub(super) fn matches(keyframes: &[Keyframe], config: &Config) -> Edges {
    let with_earlier = |(newer, keyframe): (usize, &Keyframe)| {
        let view = |position: usize| {
            let other = &keyframes[position];
            (other.observation.index, (&*other.observation, &other.refined))
        };
        let others = partners(keyframes, newer).into_iter().map(view);
        let (_, edges) = offline::matched(others, &keyframe.observation, &keyframe.refined, config);
        edges.into_iter().map(|(older, edge)| ((older, keyframe.observation.index), edge)).collect::<Vec<_>>()
    };
    let edges: Vec<_> = keyframes.par_iter().enumerate().flat_map_iter(with_earlier).collect();
    tracing::debug!(edges = edges.len(), "keyframes matched with each other");
    edges
}

/// Moves the keyframes to where matches and depth of all pairs, and a field that was trained on them, agree best; the
/// first one stays. What none of these shows of a pose, the turn of a plain can, stays as the tracker had it. Closes loops
/// that are wider open than the field's own pull on the poses reaches. Answers the weight of the field against matches and
/// depth, from 0 to 1.
pub(super) fn align(
    keyframes: &mut [Keyframe],
    edges: &Edges,
    config: &Config,
    field: Option<&TrainedField>,
    stop: &AtomicBool,
) -> f64 {
    let poses: Vec<_> = keyframes.iter().map(|k| k.refined).collect();
    let held: Vec<_> = keyframes.iter().map(|k| k.online).collect();
    let request = FieldRequest {
        round: Round::PoseGraph,
        graph: config.graph.clone(),
        edges: edges.clone(),
        frames: keyframes.iter().map(|k| (k.observation.index, k.observation.clone(), k.refined)).collect(),
    };
    let Some((poses, weight)) = global_graph::optimise_weighed(&request, &poses, &held, field, stop) else {
        return 0.0;
    };
    for (keyframe, pose) in keyframes.iter_mut().zip(poses) {
        keyframe.refined = pose;
    }
    weight
}

/// Keyframes to match with: the predecessor and those before it that look from nearly the same side.
fn partners(keyframes: &[Keyframe], newer: usize) -> Vec<usize> {
    let swing = |k: &usize| swing_angle(&keyframes[*k].refined.rotation, &keyframes[newer].refined.rotation);
    let mut near: Vec<usize> = (0..newer).filter(|k| swing(k) < MAX_SWING).collect();
    near.sort_by(|a, b| swing(a).total_cmp(&swing(b)));
    near.truncate(PARTNERS);
    if let Some(predecessor) = newer.checked_sub(1)
        && !near.contains(&predecessor)
    {
        near.push(predecessor);
    }
    near
}

#[cfg(test)]
mod tests {
    use rgbd_synth::Sequence;

    use super::*;

    #[test]
    fn highlights_do_not_turn_keyframes_that_are_right() {
        let config = Config::default();
        let video = Sequence::named("specular").unwrap();
        let keyframe = |index: usize| {
            let shot = video.render(index);
            let observation = Observation::new(index, &shot.frame, &shot.visible_mask, &config).unwrap();
            let pose = shot.cam_from_obj.inverse();
            let (id, observation) = (shot.frame.id, Arc::new(observation));
            Keyframe { id, observation, online: pose, refined: pose }
        };
        let truth: Vec<_> = (142..186).step_by(4).map(keyframe).collect();
        let furthest = |edges: &Edges| {
            let mut keyframes = truth.clone();
            align(&mut keyframes, edges, &config, None, &AtomicBool::new(false));
            let turn = |k: &Keyframe| k.refined.rotation.angle_to(&k.online.rotation).to_degrees();
            keyframes.iter().map(turn).fold(0.0, f64::max)
        };
        let together = furthest(&matches(&truth, &config));
        assert!(together < 5.0, "turned by {together} degrees");

        // The scene is one where a pair alone believes its highlights.
        let mut apart = Edges::new();
        for (newer, keyframe) in truth.iter().enumerate() {
            for older in partners(&truth, newer) {
                let (index, other) = (truth[older].observation.index, &truth[older]);
                let pair = [(index, (&*other.observation, &other.refined))];
                let (_, edges) = offline::matched(pair, &keyframe.observation, &keyframe.refined, &config);
                apart.extend(edges.into_iter().map(|(i, edge)| ((i, keyframe.observation.index), edge)));
            }
        }
        let apart = furthest(&apart);
        assert!(apart > 3.0 * together, "turned by {apart} degrees, {together} together");
    }
}
