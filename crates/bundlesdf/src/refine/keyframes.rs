//! The keyframes of a run, read again, and one pose graph over all of them.

use std::sync::{
    Arc,
    atomic::{AtomicBool, AtomicUsize, Ordering},
};

use nalgebra::Isometry3;
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
    tracker::offline::matched_pair,
};

/// Earlier keyframes that each one is matched with, nearest by swing first.
const PARTNERS: usize = 8;
/// Views further apart than this share too little to be matched (radians).
const MAX_SWING: f64 = 0.9;

/// A keyframe on its way to its refined pose.
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

/// Moves the keyframes to where matches and depth of all pairs agree best; the first one stays. Closes loops that are
/// wider open than the field's own pull on the poses reaches.
pub(super) fn align(keyframes: &mut [Keyframe], config: &Config) {
    let edges: Vec<((usize, usize), MemoryEdge)> = pairs(keyframes)
        .into_par_iter()
        .filter_map(|(older, newer)| {
            let (a, b) = (&keyframes[older], &keyframes[newer]);
            let edge = matched_pair((&a.observation, &a.refined), (&b.observation, &b.refined), config)?;
            Some(((a.observation.index, b.observation.index), edge))
        })
        .collect();
    tracing::debug!(edges = edges.len(), "keyframes matched with each other");
    let poses: Vec<_> = keyframes.iter().map(|k| k.refined).collect();
    let request = FieldRequest {
        round: Round::PoseGraph,
        graph: config.graph.clone(),
        edges,
        frames: keyframes.iter().map(|k| (k.observation.index, k.observation.clone(), k.refined)).collect(),
    };
    if let Some(poses) = global_graph::optimise(&request, &poses, None) {
        for (keyframe, pose) in keyframes.iter_mut().zip(poses) {
            keyframe.refined = pose;
        }
    }
}

/// Pairs to match, as positions `(older, newer)`: each keyframe with its predecessor and with those before it that
/// look from nearly the same side.
fn pairs(keyframes: &[Keyframe]) -> Vec<(usize, usize)> {
    let mut pairs = Vec::new();
    for newer in 1..keyframes.len() {
        let swing =
            |k: &usize| swing_angle(&keyframes[*k].refined.rotation, &keyframes[newer].refined.rotation);
        let mut near: Vec<usize> = (0..newer).filter(|k| swing(k) < MAX_SWING).collect();
        near.sort_by(|a, b| swing(a).total_cmp(&swing(b)));
        near.truncate(PARTNERS);
        if !near.contains(&(newer - 1)) {
            near.push(newer - 1);
        }
        pairs.extend(near.into_iter().map(|older| (older, newer)));
    }
    pairs
}
