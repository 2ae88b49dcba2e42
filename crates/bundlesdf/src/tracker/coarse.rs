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
    wide::{Turned, WideMatcher},
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
#[derive(Clone, Copy, Debug)]
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

    /// What a keyframe may have drifted against the others.
    pub(super) const DRIFT: Self = Self { translation: 0.015, rotation: 0.09 };

    /// No limit: after a loss.
    pub(super) const NONE: Self = Self { translation: f64::INFINITY, rotation: f64::INFINITY };
}

/// What a motion between two observations must fulfil.
#[derive(Clone, Copy, Debug)]
pub(super) struct Search<'a> {
    pub(super) config: &'a CoarseConfig,
    pub(super) gates: Gates,
    pub(super) min_inliers: usize,
    /// Focal length of the new frame's camera (pixels).
    pub(super) focal: f64,
    /// Swing between the two views (radians), or how large it may be: a depth error shows across the line of sight
    /// once the view has turned.
    pub(super) swing: f64,
    pub(super) seed: u64,
}

impl Search<'_> {
    /// Swing that is allowed for where nothing is known about it.
    pub(super) const ANY_SWING: f64 = 0.5;
    /// Swing that is usual between a frame and the keyframes it is compared with.
    pub(super) const MEMORY_SWING: f64 = 0.3;

    fn ransac(&self, depth: f64) -> RansacOptions {
        let c = self.config;
        let pixel = depth / self.focal;
        RansacOptions {
            hypotheses: c.hypotheses,
            inlier_distance: c.inlier_distance * (depth_sigma(depth) / depth_sigma(0.5)).max(1.0),
            inlier_lateral: c.inlier_lateral_px * pixel + 3.0 * depth_sigma(depth) * self.swing.sin(),
            inlier_normal_angle: c.inlier_normal_deg.to_radians(),
            max_translation: self.gates.translation,
            max_rotation: self.gates.rotation,
            min_inliers: self.min_inliers,
            seed: self.seed,
        }
    }
}

/// Rigid motion from `matches` between `reference` (a, at `obj_from_reference`) and the new frame (b, guessed at
/// `guess`), with the matches that agree.
pub(super) fn coarse_from_matches(
    matches: Vec<Correspondence>,
    obj_from_reference: &Isometry3<f64>,
    guess: &Isometry3<f64>,
    search: &Search<'_>,
) -> Option<CoarsePose> {
    if matches.len() < search.min_inliers {
        return None;
    }
    let groups = [(obj_from_reference, matches.as_slice())];
    let (pose, agreeing) = joint_motion(&groups, guess, search)?;
    Some(CoarsePose { pose, matches: agreeing.into_iter().flatten().collect() })
}

/// The pose (`obj_from_cam`) of the new frame, guessed at `guess`, on which most matches with several posed
/// observations agree, with those that agree of each group. A group has its observation's pose and matches (a: the
/// observation, b: the new frame).
pub(super) fn joint_motion(
    groups: &[(&Isometry3<f64>, &[Correspondence])],
    guess: &Isometry3<f64>,
    search: &Search<'_>,
) -> Option<(Isometry3<f64>, Vec<Vec<Correspondence>>)> {
    // The motion wanted maps the new frame's points onto the references', so the new frame is RANSAC's "a".
    let lift = |pose: &Isometry3<f64>, m: &Correspondence| {
        let swapped = Correspondence { a: m.b, normal_a: m.normal_b, b: m.a, normal_b: m.normal_a, ..*m };
        swapped.lifted(guess, pose)
    };
    let all = || groups.iter().enumerate().flat_map(|(g, (pose, ms))| ms.iter().map(move |m| (g, *pose, m)));
    let lifted: Vec<_> = all().map(|(_, pose, m)| lift(pose, m)).collect();
    let depth = all().map(|(_, _, m)| f64::from(m.b[2])).sum::<f64>() / lifted.len().max(1) as f64;
    let model = estimate(&lifted, &search.ransac(depth))?;
    let mut agreeing = vec![Vec::new(); groups.len()];
    let matches: Vec<_> = all().map(|(g, _, m)| (g, *m)).collect();
    for (group, m) in model.inliers.iter().filter_map(|i| matches.get(*i)) {
        agreeing[*group].push(*m);
    }
    Some((model.motion * guess, agreeing))
}

/// Point tracks from `reference` into `observation`, tried from each guess until one is clearly supported; the best
/// supported motion is returned.
pub(super) fn coarse_from_tracks(
    reference: (&Observation, &Isometry3<f64>),
    observation: &Observation,
    guesses: &[Isometry3<f64>],
    search: &Search<'_>,
) -> Option<CoarsePose> {
    /// With this share of the corners agreeing no other guess can be much better.
    const CLEAR_SHARE: f64 = 0.5;
    let (from, obj_from_reference) = reference;
    let config = search.config;
    let mut best: Option<CoarsePose> = None;
    for guess in guesses {
        let to_from = guess.inv_mul(obj_from_reference);
        let matches = guided_tracks(from, observation, &to_from, config.max_corners, &KltOptions::default());
        let swing = swing_angle(&obj_from_reference.rotation, &guess.rotation);
        let found = coarse_from_matches(matches, obj_from_reference, guess, &Search { swing, ..*search });
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
    /// A network in their place, where the config names one.
    pub(super) wide: Option<WideMatcher>,
}

impl Default for Descriptors {
    fn default() -> Self {
        let with = |orientation| ScaleSpaceMatcher {
            options: ScaleSpaceOptions { orientation, ..ScaleSpaceOptions::default() },
        };
        Self { upright: with(Orientation::Upright), any_roll: with(Orientation::Dominant), wide: None }
    }
}

impl Descriptors {
    /// With the network that the config names, if it names one.
    pub(super) fn new(wide: Option<WideMatcher>) -> Self {
        Self { wide, ..Self::default() }
    }

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
        if let Some(wide) = &self.wide {
            let turned = wide.turned(observation, [WideMatcher::steps(obj_from_reference, guess)]);
            let to_from = guess.inv_mul(obj_from_reference);
            let find = |b: &Features| wide.correspondences((reference, observation), b, &to_from);
            return turned.values().flat_map(find).collect();
        }
        let roll = roll_between(&obj_from_reference.rotation.inverse(), &guess.rotation.inverse());
        let a = Self::detect(&self.upright, reference, 0.0);
        let b = Self::detect(&self.upright, observation, roll);
        lift_matches(reference, observation, &self.upright.match_features(&a, &b))
    }

    /// The new frame's features for [`Self::at_any_roll`].
    fn turned(&self, observation: &Observation) -> Option<Turned> {
        self.wide.as_ref().map(|wide| wide.turned(observation, WideMatcher::quarter_turns()))
    }

    /// Matches that need no pose; features are detected once per observation.
    fn at_any_roll(&self, a: &Observation, b: &Observation, in_b: Option<&Turned>) -> Vec<Correspondence> {
        if let (Some(wide), Some(turned)) = (&self.wide, in_b) {
            // The turn with the most matches is the right one, or next to it.
            let matches = turned.values().map(|in_b| wide.matches(a, in_b)).max_by_key(Vec::len);
            return lift_matches(a, b, &matches.unwrap_or_default());
        }
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
    let turned = descriptors.turned(observation);
    for keyframe in pool.keyframes() {
        let matches = descriptors.at_any_roll(&keyframe.observation, observation, turned.as_ref());
        let found = coarse_from_matches(
            matches,
            &keyframe.obj_from_cam,
            &keyframe.obj_from_cam,
            &Search {
                config: &config.coarse,
                gates: Gates::NONE,
                min_inliers: config.coarse.min_relocalise_inliers,
                focal: observation.intrinsics.fx,
                swing: Search::ANY_SWING,
                seed: config.seed ^ keyframe.index as u64,
            },
        );
        let Some(found) = found else { continue };
        if best.as_ref().is_some_and(|b| b.matches.len() >= found.matches.len()) {
            continue;
        }
        let to_from = found.pose.inv_mul(&keyframe.obj_from_cam);
        let Agreement { overlap, inlier_share } =
            depth_agreement(&keyframe.observation, observation, &to_from, observation.depth_tolerance());
        if overlap >= MIN_OVERLAP && inlier_share >= MIN_AGREEMENT {
            best = Some(found);
        }
    }
    best
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
    let tolerance = observation.depth_tolerance();
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

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, UnitQuaternion, Vector3};

    use super::*;

    fn turned(deg: f64) -> Isometry3<f64> {
        let middle = Isometry3::translation(0.0, 0.0, -0.5);
        Isometry3::from_parts(
            Vector3::zeros().into(),
            UnitQuaternion::from_axis_angle(&Vector3::y_axis(), deg.to_radians()),
        ) * middle
    }

    /// Matches of `count` points on a can's front between a keyframe and the new frame, both given by `obj_from_cam`.
    fn matches(
        keyframe: &Isometry3<f64>,
        new: &Isometry3<f64>,
        count: usize,
        phase: f64,
    ) -> Vec<Correspondence> {
        let point = |i: usize| {
            let (angle, height) =
                (0.9 * (1.7 * i as f64 + phase).sin(), 0.05 * (2.3 * i as f64 + phase).cos());
            Point3::new(0.04 * angle.sin(), height, -0.04 * angle.cos())
        };
        let seen =
            |pose: &Isometry3<f64>, p: &Point3<f64>| pose.inverse_transform_point(p).cast::<f32>().into();
        (0..count)
            .map(|i| Correspondence {
                a: seen(keyframe, &point(i)),
                normal_a: [0.0; 3],
                b: seen(new, &point(i)),
                normal_b: [0.0; 3],
                weight: 1.0,
            })
            .collect()
    }

    #[test]
    fn highlights_that_every_keyframe_saw_elsewhere_are_outvoted() {
        let config = CoarseConfig::default();
        let search = Search {
            config: &config,
            gates: Gates::CORRECTION,
            min_inliers: config.min_inliers,
            focal: 600.0,
            swing: Search::MEMORY_SWING,
            seed: 1,
        };
        let new = turned(20.0);
        let keyframes = [2.0, 5.0, 8.0, 11.0].map(turned);
        let seen: Vec<Vec<Correspondence>> = keyframes
            .iter()
            .enumerate()
            .map(|(i, keyframe)| {
                let phase = i as f64;
                // A highlight stays in the image: to each keyframe it looks as if nothing had turned.
                let highlight = matches(keyframe, keyframe, 14, phase + 0.5);
                matches(keyframe, &new, 10, phase).into_iter().chain(highlight).collect()
            })
            .collect();
        let groups: Vec<_> = keyframes.iter().zip(&seen).map(|(k, m)| (k, m.as_slice())).collect();
        let (pose, agreeing) = joint_motion(&groups, &turned(19.0), &search).unwrap();
        assert!(pose.rotation.angle_to(&new.rotation).to_degrees() < 0.2, "{pose}");
        assert!(agreeing.iter().all(|a| a.len() >= 10));
        // The keyframe next to it alone believes its highlight, which has the majority.
        let alone = joint_motion(&groups[3..], &turned(19.0), &search).unwrap().0;
        assert!(alone.rotation.angle_to(&new.rotation).to_degrees() > 1.0, "{alone}");
    }
}
