//! Matches of a network between views that are too far apart for point tracks (paper section 3.1 uses LoFTR there).

use std::{collections::BTreeMap, f64::consts::PI};

use matcher::{
    CropOptions, FeatureMatcher, Features, Match, RollCrop,
    klt::{KltOptions, track_forward_backward},
    learned::{MatcherSpec, from_bytes},
    roll_between,
};
use nalgebra::Isometry3;
use rayon::prelude::*;

use super::correspond::{Correspondence, confidence, predict};
use crate::{config::ConfigError, observation::Observation};

/// Crops of the new frame are turned in steps of this: the networks tolerate more than half of it.
const ROLL_STEP: f64 = PI / 6.0;
/// Steps of a quarter turn.
const QUARTER: i32 = 3;
/// A keypoint is off by about 0.7 pixels, a point track by 0.2: a match that no track confirms counts by the ratio of
/// the variances.
const UNREFINED_WEIGHT: f32 = 0.1;
/// A track that ends further than this from its match has followed something else (pixels).
const MAX_REFINEMENT: f32 = 3.0;

/// A network that compares views, with its weights.
pub(super) struct WideMatcher(Box<dyn FeatureMatcher>);

/// Features of a new frame by the steps that its crop was turned.
pub(super) type Turned = BTreeMap<i32, Features>;

impl WideMatcher {
    /// Reads the weights; `None` for the classical matcher, which has none.
    ///
    /// # Errors
    /// When the file can't be read or isn't that network's.
    pub(super) fn load(spec: &MatcherSpec) -> Result<Option<Self>, ConfigError> {
        let Some(path) = spec.path() else { return Ok(None) };
        let refused = |problem: String| ConfigError { path: path.display().to_string(), problem };
        let bytes = std::fs::read(path).map_err(|e| {
            refused(format!(
                "the matcher's weights can't be read ({e}); give the network's own file to --matcher"
            ))
        })?;
        let network = from_bytes(spec.network(), &bytes).map_err(|e| refused(e.to_string()))?;
        Ok(Some(Self(network)))
    }

    fn detect(&self, observation: &Observation, steps: i32) -> Features {
        let gray = &observation.pyramid.levels()[0];
        let roll = f64::from(steps) * ROLL_STEP;
        RollCrop::new(gray, &observation.mask, roll, &CropOptions::default())
            .map(|crop| self.0.detect(&crop))
            .unwrap_or_default()
    }

    /// Steps by which the new frame's crop is turned to look like the one at `obj_from_a`.
    pub(super) fn steps(obj_from_a: &Isometry3<f64>, guess: &Isometry3<f64>) -> i32 {
        let roll = roll_between(&obj_from_a.rotation.inverse(), &guess.rotation.inverse());
        (roll / ROLL_STEP).round() as i32
    }

    /// The new frame's features for each of these turns.
    pub(super) fn turned(&self, observation: &Observation, steps: impl IntoIterator<Item = i32>) -> Turned {
        let mut turned: Turned = steps.into_iter().map(|steps| (steps, Features::default())).collect();
        turned.par_iter_mut().for_each(|(steps, features)| *features = self.detect(observation, *steps));
        turned
    }

    /// Quarter turns, for when nothing is known about the pose.
    pub(super) fn quarter_turns() -> [i32; 4] {
        [0, 1, 2, 3].map(|quarter| quarter * QUARTER)
    }

    /// Matches of an earlier view (a) with a new one (b), as the network finds them.
    pub(super) fn matches(&self, a: &Observation, in_b: &Features) -> Vec<Match> {
        self.0.match_features(a.wide_features(|| self.detect(a, 0)), in_b)
    }

    /// The same in three dimensions, each made as precise as a point track where one confirms it; `to_from` is the
    /// guess of the motion from a to b, by which patches are warped.
    pub(super) fn correspondences(
        &self,
        (a, b): (&Observation, &Observation),
        in_b: &Features,
        to_from: &Isometry3<f64>,
    ) -> Vec<Correspondence> {
        let mut found = Vec::new();
        let (mut points, mut guesses, mut warps) = (Vec::new(), Vec::new(), Vec::new());
        for m in self.matches(a, in_b) {
            let Some((point, normal)) = a.lift(m.a) else { continue };
            let warp = predict(a, b, to_from, m.a, point, normal).map_or([1.0, 0.0, 0.0, 1.0], |(_, w)| w);
            found.push((point, normal, m));
            points.push(m.a);
            guesses.push(m.b);
            warps.push(warp);
        }
        let options = KltOptions::default();
        let tracks =
            track_forward_backward(&a.pyramid, &b.pyramid, &points, &guesses, Some(&warps), &options);
        let lift = |((point, normal_a), m, track): (_, Match, Option<matcher::Track>)| {
            let near = |p: &[f32; 2]| (p[0] - m.b[0]).hypot(p[1] - m.b[1]) <= MAX_REFINEMENT;
            let track = track.filter(|t| near(&t.position) && is_on_mask(b, t.position));
            let unrefined = UNREFINED_WEIGHT * m.confidence;
            let (position, weight) =
                track.map_or((m.b, unrefined), |t| (t.position, confidence(&t).max(unrefined)));
            let (q, normal_b) = b.lift(position)?;
            Some(Correspondence { a: point, normal_a, b: q, normal_b, weight })
        };
        found.into_iter().zip(tracks).filter_map(|((p, n, m), track)| lift(((p, n), m, track))).collect()
    }
}

fn is_on_mask(observation: &Observation, at: [f32; 2]) -> bool {
    let (x, y) = ((at[0] + 0.5) as usize, (at[1] + 0.5) as usize);
    observation.mask.get(x, y).is_some_and(|m| *m != 0)
}

impl std::fmt::Debug for WideMatcher {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("WideMatcher")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_file_is_told_with_its_name() {
        assert!(WideMatcher::load(&MatcherSpec::Classical).unwrap().is_none());
        let spec = "xfeat:no/such/file.pt".parse().unwrap();
        let error = WideMatcher::load(&spec).unwrap_err().to_string();
        assert!(error.contains("no/such/file.pt") && error.contains("--matcher"), "{error}");
    }

    #[test]
    fn a_turn_is_counted_in_steps() {
        use nalgebra::Vector3;
        let at = |roll: f64| {
            let from_object = Isometry3::new(Vector3::new(0.0, 0.0, 0.5), Vector3::z() * roll);
            from_object.inverse()
        };
        assert_eq!(WideMatcher::steps(&at(0.0), &at(0.0)), 0);
        // The new view is rolled by -61 degrees: turned back by two steps of 30 it looks like the first.
        assert_eq!(WideMatcher::steps(&at(0.0), &at(-61f64.to_radians())), 2);
    }
}
