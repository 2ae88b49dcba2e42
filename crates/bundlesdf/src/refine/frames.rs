//! Every frame's pose against the refined keyframes and the field.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use neural_field::TrainedField;
use rayon::prelude::*;

use super::{Progress, RefineError, RefinedFrame, Run, keyframes};
use crate::{
    config::MemoryConfig,
    observation::Observation,
    pool::{Keyframe, MemoryPool},
    report::FrameReport,
    tracker::{Status, offline},
};

/// Less depth agreement than this contradicts a pose.
const CONVINCING: f64 = 0.5;

/// Known frames over which a velocity is taken at the ends of a gap.
const VELOCITY: usize = 4;
/// A cubic curve whose slopes are at most so many times that of the straight line doesn't overshoot along that line
/// (Fritsch and Carlson, "Monotone Piecewise Cubic Interpolation", SIAM J. Numer. Anal. 1980).
const STEEPEST: f64 = 3.0;

/// All frames, with their keyframes as given. The field counts by the weight that its poses had against matches and
/// depth.
pub(super) fn place_all(
    run: &Run<'_>,
    reports: &[FrameReport],
    keyframes: &[keyframes::Keyframe],
    (field, weight): (&TrainedField, f64),
    stop: &AtomicBool,
    progress: &(dyn Fn(Progress) + Sync),
) -> Result<Vec<RefinedFrame>, RefineError> {
    let pool = pool(keyframes);
    let mut config = run.config.clone();
    config.graph.sdf_weight *= weight;
    let run = &Run { config: &config, ..*run };
    let guesses = guesses(run, reports, keyframes)?;
    let done = AtomicUsize::new(0);
    let place = |(index, report): (usize, &FrameReport)| {
        if stop.load(Ordering::Relaxed) {
            return Err(RefineError::Stopped);
        }
        let known = pool.get(index).map(|k| k.obj_from_cam);
        let measured = known.or_else(|| {
            // A frame whose images or mask can't be read again keeps the pose between its neighbours.
            let observation = run.observe(index, &report.id).ok().flatten()?;
            measure(run, &pool, field, &observation, &guesses[index], report.status)
        });
        progress(Progress::Frames(done.fetch_add(1, Ordering::Relaxed) + 1, reports.len()));
        Ok(RefinedFrame {
            index,
            id: report.id.clone(),
            cam_from_obj: measured.unwrap_or(guesses[index]).inverse(),
            measured: measured.is_some(),
        })
    };
    reports.par_iter().enumerate().map(place).collect()
}

/// Keyframes that the field has refined: constants for every other frame.
fn pool(keyframes: &[keyframes::Keyframe]) -> MemoryPool {
    let unlimited = MemoryConfig { capacity: usize::MAX, ..MemoryConfig::default() };
    let mut pool = MemoryPool::default();
    for keyframe in keyframes {
        let keyframe = Keyframe {
            index: keyframe.observation.index,
            id: keyframe.id.clone(),
            obj_from_cam: keyframe.refined,
            refined_by_field: true,
            observation: keyframe.observation.clone(),
        };
        pool.add(keyframe, [], &unlimited);
    }
    pool
}

/// The pose of a frame that is no keyframe; `None` when nothing of it speaks for a pose.
fn measure(
    run: &Run<'_>,
    pool: &MemoryPool,
    field: &TrainedField,
    observation: &Observation,
    guess: &Isometry3<f64>,
    status: Status,
) -> Option<Isometry3<f64>> {
    let agreement = |pose: &Isometry3<f64>| offline::agreement(pool, observation, pose);
    let placed = offline::place(pool, field, observation, guess, run.config);
    let trusted = matches!(status, Status::Tracked | Status::Relocalised);
    let convincing = |pose: &Isometry3<f64>| agreement(pose).is_some_and(|a| a >= CONVINCING);
    if trusted || convincing(&placed) {
        return Some(placed);
    }
    let found = offline::find(pool, observation, run.config)?;
    let placed = offline::place(pool, field, observation, &found, run.config);
    convincing(&placed).then_some(placed)
}

/// Where each frame should be: its online pose, carried along with the corrections of the keyframes before and after
/// it; a lost frame's on the way between its neighbours.
fn guesses(
    run: &Run<'_>,
    reports: &[FrameReport],
    keyframes: &[keyframes::Keyframe],
) -> Result<Vec<Isometry3<f64>>, RefineError> {
    let mut known: Vec<(usize, Isometry3<f64>)> = Vec::with_capacity(reports.len());
    for (index, report) in reports.iter().enumerate() {
        if report.status != Status::Lost {
            let online = run.folder.read_pose(&report.id)?.inverse();
            // Seen from the camera the object moves about itself: that is what can be interpolated.
            known.push((index, (correction(keyframes, index) * online).inverse()));
        }
    }
    Ok((0..reports.len()).map(|index| on_the_way(&known, index).inverse()).collect())
}

/// What takes a pose of the time of frame `index` to the refined keyframes.
fn correction(keyframes: &[keyframes::Keyframe], index: usize) -> Isometry3<f64> {
    let corrections: Vec<_> =
        keyframes.iter().map(|k| (k.observation.index, k.refined * k.online.inverse())).collect();
    between(&corrections, index)
}

/// The value at `index` of a motion that is known at some indices (ascending), the nearest one beyond its ends.
fn between(known: &[(usize, Isometry3<f64>)], index: usize) -> Isometry3<f64> {
    let after = known.partition_point(|(i, _)| *i < index);
    match (after.checked_sub(1).and_then(|before| known.get(before)), known.get(after)) {
        (Some((i, a)), Some((j, b))) => {
            let share = (index - i) as f64 / (j - i) as f64;
            a.try_lerp_slerp(b, share, 1e-9).unwrap_or(*b)
        }
        (Some((_, only)), None) | (None, Some((_, only))) => *only,
        (None, None) => Isometry3::identity(),
    }
}

/// As [`between`], but leaving and arriving with the motion's own velocities (a cubic Hermite curve of position and turn).
fn on_the_way(known: &[(usize, Isometry3<f64>)], index: usize) -> Isometry3<f64> {
    let after = known.partition_point(|(i, _)| *i < index);
    let Some((before, &(end, to))) = after.checked_sub(1).zip(known.get(after)) else {
        return between(known, index);
    };
    let (start, from) = known[before];
    if end == index {
        return to;
    }
    let steps = (end - start) as f64;
    let whole = displacement(&from, &to);
    let slope = |a: usize, b: usize| {
        let (Some(&(i, a)), Some(&(j, b))) = (known.get(a), known.get(b)) else { return whole };
        let scale = if i < j { steps / (j - i) as f64 } else { return whole };
        displacement(&a, &b).map(|part| part * scale)
    };
    let leaving = slope(before.saturating_sub(VELOCITY), before);
    let arriving = slope(after, (after + VELOCITY).min(known.len() - 1));
    let s = (index - start) as f64 / steps;
    let [turn, shift]: [Vector3<f64>; 2] = std::array::from_fn(|part| {
        let whole = whole[part];
        let [leaving, arriving] =
            [leaving, arriving].map(|slope| slope[part].cap_magnitude(STEEPEST * whole.norm()));
        whole * (s * s * (3.0 - 2.0 * s)) + leaving * (s * (1.0 - s).powi(2)) - arriving * (s * s * (1.0 - s))
    });
    let rotation = UnitQuaternion::new(turn) * from.rotation;
    Isometry3::from_parts(Translation3::from(from.translation.vector + shift), rotation)
}

/// Turn (radians) and shift (metres) from one pose to another.
fn displacement(from: &Isometry3<f64>, to: &Isometry3<f64>) -> [Vector3<f64>; 2] {
    let turn = (to.rotation * from.rotation.inverse()).scaled_axis();
    [turn, to.translation.vector - from.translation.vector]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_known_lies_between_its_neighbours() {
        let at = |x: f64, turn: f64| Isometry3::new(Vector3::new(x, 0.0, 0.0), Vector3::new(0.0, turn, 0.0));
        let known = [(2, at(0.0, 0.0)), (6, at(0.4, 0.8))];
        assert_eq!(between(&known, 0), known[0].1);
        assert_eq!(between(&known, 9), known[1].1);
        assert!((between(&known, 6).to_homogeneous() - known[1].1.to_homogeneous()).norm() < 1e-12);
        assert!((between(&known, 3).to_homogeneous() - at(0.1, 0.2).to_homogeneous()).norm() < 1e-9);
        assert_eq!(between(&[], 3), Isometry3::identity());
    }

    #[test]
    fn a_smooth_motion_is_followed_through_a_gap() {
        let truth = |index: usize| {
            let t = 0.03 * index as f64;
            let place = Vector3::new(0.1 * t.sin(), 0.05 * (0.7 * t).cos(), 0.5 + 0.02 * t);
            Isometry3::new(place, Vector3::new(0.3 * t.sin(), 0.8 * t, 0.0))
        };
        let known: Vec<_> = (0..90).filter(|i| !(30..60).contains(i)).map(|i| (i, truth(i))).collect();
        let worst = |guess: &dyn Fn(usize) -> Isometry3<f64>| {
            let off = |i: usize| displacement(&guess(i), &truth(i)).map(|part| part.norm());
            (0..90).map(off).fold([0.0f64; 2], |w, e| [w[0].max(e[0]), w[1].max(e[1])])
        };
        let curve = worst(&|i| on_the_way(&known, i));
        let line = worst(&|i| between(&known, i));
        assert!(curve[0] < 0.25 * line[0] && curve[1] < 0.25 * line[1], "{curve:?} {line:?}");

        // Back where it went out of sight: a stay there, not a way around.
        let back: Vec<_> =
            known.iter().map(|(i, pose)| (*i, if *i < 30 { *pose } else { truth(29) })).collect();
        assert!(
            (30..60).all(|i| displacement(&on_the_way(&back, i), &truth(29)).iter().all(|d| d.norm() < 1e-9))
        );
        // Nothing on one side, a single frame on the other.
        assert_eq!(on_the_way(&known[..1], 7), known[0].1);
        assert_eq!(on_the_way(&[], 3), Isometry3::identity());
        let two = [(2, truth(2)), (6, truth(6))];
        assert!(displacement(&on_the_way(&two, 4), &between(&two, 4)).iter().all(|d| d.norm() < 1e-3));
    }
}
