//! Coarse pose of a new frame (paper section 3.1): matches with the previous frame, or after a loss with memory frames,
//! and RANSAC in the object frame.

use matcher::{
    CropOptions, FeatureMatcher, Features, Match, Orientation, RollCrop, ScaleSpaceMatcher,
    ScaleSpaceOptions,
    klt::KltOptions,
    ransac::{RansacOptions, estimate},
    roll_between,
};
use nalgebra::Isometry3;
use se3_lie::distance::{rotation_angle, swing_angle};

use super::{
    correspond::{Correspondence, guided_tracks},
    verify::{Agreement, depth_agreement},
};
use crate::{
    config::{CoarseConfig, Config},
    depth::depth_sigma,
    observation::Observation,
    pool::MemoryPool,
};

/// A coarse pose with the matches that support it.
pub(super) struct CoarsePose {
    /// `obj_from_cam` of the new frame.
    pub(super) pose: Isometry3<f64>,
    /// Matches with the reference (a) that agree.
    pub(super) matches: Vec<Correspondence>,
}

/// How far a motion may go from its guess.
#[derive(Clone, Copy)]
pub(super) struct Gates {
    pub(super) translation: f64,
    pub(super) rotation: f64,
}

impl Gates {
    /// The limits between consecutive frames, widened by the number of frames since the reference.
    pub(super) fn between(config: &CoarseConfig, frames: usize) -> Self {
        let frames = frames.clamp(1, 5) as f64;
        Self {
            translation: config.max_translation * frames,
            rotation: config.max_rotation_deg.to_radians() * frames,
        }
    }

    /// Small corrections of a pose that is already known roughly.
    pub(super) const CORRECTION: Self = Self { translation: 0.03, rotation: 0.26 };

    /// No limit: after a loss.
    pub(super) const NONE: Self = Self { translation: f64::INFINITY, rotation: f64::INFINITY };
}

/// Rigid motion from `matches` between `reference` (a, at `obj_from_reference`) and the new frame (b, guessed at
/// `guess`), with the matches that agree.
pub(super) fn coarse_from_matches(
    matches: Vec<Correspondence>,
    obj_from_reference: &Isometry3<f64>,
    guess: &Isometry3<f64>,
    gates: Gates,
    min_inliers: usize,
    config: &CoarseConfig,
    seed: u64,
) -> Option<CoarsePose> {
    if matches.len() < min_inliers {
        return None;
    }
    // The motion wanted maps the new frame's points onto the reference's, so the new frame is RANSAC's "a".
    let lifted: Vec<_> = matches
        .iter()
        .map(|m| {
            let swapped = Correspondence { a: m.b, normal_a: m.normal_b, b: m.a, normal_b: m.normal_a, ..*m };
            swapped.lifted(guess, obj_from_reference)
        })
        .collect();
    let depth = matches.iter().map(|m| f64::from(m.b[2])).sum::<f64>() / matches.len() as f64;
    let options = RansacOptions {
        hypotheses: config.hypotheses,
        inlier_distance: config.inlier_distance * (depth_sigma(depth) / depth_sigma(0.5)).max(1.0),
        inlier_normal_angle: config.inlier_normal_deg.to_radians(),
        max_translation: gates.translation,
        max_rotation: gates.rotation,
        min_inliers,
        seed,
    };
    let model = estimate(&lifted, &options)?;
    let matches = model.inliers.iter().filter_map(|i| matches.get(*i).copied()).collect();
    Some(CoarsePose { pose: model.motion * guess, matches })
}

/// Point tracks from `reference` into `observation`, tried from each guess until one is clearly supported; the best
/// supported motion is returned.
pub(super) fn coarse_from_tracks(
    reference: (&Observation, &Isometry3<f64>),
    observation: &Observation,
    guesses: &[Isometry3<f64>],
    gates: Gates,
    config: &CoarseConfig,
    seed: u64,
) -> Option<CoarsePose> {
    /// With this share of the corners agreeing no other guess can be much better.
    const CLEAR_SHARE: f64 = 0.5;
    let (from, obj_from_reference) = reference;
    let mut best: Option<CoarsePose> = None;
    for guess in guesses {
        let to_from = guess.inv_mul(obj_from_reference);
        let matches = guided_tracks(from, observation, &to_from, config.max_corners, &KltOptions::default());
        let found =
            coarse_from_matches(matches, obj_from_reference, guess, gates, config.min_inliers, config, seed);
        if let Some(found) = found
            && best.as_ref().is_none_or(|b| b.matches.len() < found.matches.len())
        {
            best = Some(found);
        }
        let corners = from.corners(config.max_corners).len() as f64;
        if best.as_ref().is_some_and(|b| b.matches.len() as f64 >= CLEAR_SHARE * corners) {
            break;
        }
    }
    best
}

/// The two ways to compare descriptors.
#[derive(Debug)]
pub(super) struct Descriptors {
    /// On crops whose roll is known: more distinctive.
    upright: ScaleSpaceMatcher,
    /// After a loss, when the roll is anyone's guess.
    any_roll: ScaleSpaceMatcher,
}

impl Default for Descriptors {
    fn default() -> Self {
        let with = |orientation| ScaleSpaceMatcher {
            options: ScaleSpaceOptions { orientation, ..ScaleSpaceOptions::default() },
        };
        Self { upright: with(Orientation::Upright), any_roll: with(Orientation::Dominant) }
    }
}

impl Descriptors {
    fn detect(matcher: &ScaleSpaceMatcher, observation: &Observation, roll: f64) -> Features {
        let gray = &observation.pyramid.levels()[0];
        RollCrop::new(gray, &observation.mask, roll, &CropOptions::default())
            .map(|crop| matcher.detect(&crop))
            .unwrap_or_default()
    }

    /// Matches with a reference (a) whose pose is known; the new frame's crop (b) is turned by the roll between the
    /// reference and the guess.
    pub(super) fn with_reference(
        &self,
        (reference, obj_from_reference): (&Observation, &Isometry3<f64>),
        observation: &Observation,
        guess: &Isometry3<f64>,
    ) -> Vec<Correspondence> {
        let roll = roll_between(&obj_from_reference.rotation.inverse(), &guess.rotation.inverse());
        let a = Self::detect(&self.upright, reference, 0.0);
        let b = Self::detect(&self.upright, observation, roll);
        lift_matches(reference, observation, &self.upright.match_features(&a, &b))
    }

    /// Matches that need no pose; features are detected once per observation.
    fn at_any_roll(&self, a: &Observation, b: &Observation) -> Vec<Correspondence> {
        let detect = |o: &Observation| Self::detect(&self.any_roll, o, 0.0);
        let (in_a, in_b) = (a.features(|| detect(a)), b.features(|| detect(b)));
        lift_matches(a, b, &self.any_roll.match_features(in_a, in_b))
    }
}

fn lift_matches(a: &Observation, b: &Observation, matches: &[Match]) -> Vec<Correspondence> {
    matches
        .iter()
        .filter_map(|m| {
            let (pa, normal_a) = a.lift(m.a)?;
            let (pb, normal_b) = b.lift(m.b)?;
            Some(Correspondence { a: pa, normal_a, b: pb, normal_b, weight: m.confidence })
        })
        .collect()
}

/// Compares the new frame with all memory frames and takes the one with the most agreeing matches, if the depth
/// agrees too (paper supplement: a memory frame with more than 10 correspondences becomes the reference).
pub(super) fn relocalise(
    pool: &MemoryPool,
    observation: &Observation,
    descriptors: &Descriptors,
    config: &Config,
) -> Option<CoarsePose> {
    const MIN_AGREEMENT: f64 = 0.5;
    const MIN_OVERLAP: usize = 30;
    let mut best: Option<CoarsePose> = None;
    for keyframe in pool.keyframes() {
        let matches = descriptors.at_any_roll(&keyframe.observation, observation);
        let found = coarse_from_matches(
            matches,
            &keyframe.obj_from_cam,
            &keyframe.obj_from_cam,
            Gates::NONE,
            config.coarse.min_relocalise_inliers,
            &config.coarse,
            config.seed ^ keyframe.index as u64,
        );
        let Some(found) = found else { continue };
        if best.as_ref().is_some_and(|b| b.matches.len() >= found.matches.len()) {
            continue;
        }
        let to_from = found.pose.inv_mul(&keyframe.obj_from_cam);
        let Agreement { overlap, inlier_share } =
            depth_agreement(&keyframe.observation, observation, &to_from, agreement_tolerance(observation));
        if overlap >= MIN_OVERLAP && inlier_share >= MIN_AGREEMENT {
            best = Some(found);
        }
    }
    best
}

/// Depth differences below this are noise at the observation's distance (metres).
pub(super) fn agreement_tolerance(observation: &Observation) -> f64 {
    let depth = observation.samples.first().map_or(0.5, |(p, _)| f64::from(p[2]));
    (5.0 * depth_sigma(depth)).max(0.006)
}

/// How well a pose of the new frame agrees with the depth of the keyframes nearest to it by swing angle.
pub(super) fn agreement_with_memory(
    pool: &MemoryPool,
    observation: &Observation,
    pose: &Isometry3<f64>,
) -> Agreement {
    const COMPARED: usize = 3;
    let mut nearest: Vec<_> = pool.keyframes().iter().collect();
    nearest.sort_by(|a, b| {
        let swing = |k: &crate::pool::Keyframe| swing_angle(&k.obj_from_cam.rotation, &pose.rotation);
        swing(a).total_cmp(&swing(b))
    });
    let tolerance = agreement_tolerance(observation);
    let parts = nearest
        .iter()
        .take(COMPARED)
        .map(|k| depth_agreement(&k.observation, observation, &pose.inv_mul(&k.obj_from_cam), tolerance));
    let (overlap, inliers) = parts.fold((0, 0.0), |(overlap, inliers), part| {
        (overlap + part.overlap, inliers + part.inlier_share * part.overlap as f64)
    });
    Agreement { overlap, inlier_share: if overlap == 0 { 0.0 } else { inliers / overlap as f64 } }
}

/// Whether `pose` lies within the gates around `reference` (object frame).
pub(super) fn within(gates: Gates, reference: &Isometry3<f64>, pose: &Isometry3<f64>) -> bool {
    // Motion of the camera in the object frame, measured at the object: cam_from_obj moves the object's origin.
    let moved = (pose.inverse().translation.vector - reference.inverse().translation.vector).norm();
    moved <= gates.translation && rotation_angle(&pose.rotation, &reference.rotation) <= gates.rotation
}
