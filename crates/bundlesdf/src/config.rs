//! Every number a user may set, with its default and unit.
//!
//! A config file is TOML with the same structure; keys that are missing keep their default, unknown keys are refused.

use matcher::learned::MatcherSpec;
use posegraph::SolveOptions;
use serde::{Deserialize, Serialize};

/// Settings of the whole system.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Depth clean-up and working resolution.
    pub preprocess: PreprocessConfig,
    /// Frame-to-frame and frame-to-memory correspondences, RANSAC, motion gates.
    pub coarse: CoarseConfig,
    /// Which frames are remembered and which take part in the pose graph.
    pub memory: MemoryConfig,
    /// Online pose-graph optimisation.
    pub graph: GraphConfig,
    /// Neural Object Field.
    pub field: FieldSettings,
    /// Extraction of the final mesh.
    pub mesh: MeshConfig,
    /// Seed of every random choice.
    pub seed: u64,
}

/// Depth clean-up and working resolution.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PreprocessConfig {
    /// Images whose shorter side is at least twice this are reduced by an integer factor (pixels).
    pub working_side: usize,
    /// Depth below this is missing (metres).
    pub min_depth: f32,
    /// Depth beyond this is missing (metres).
    pub max_depth: f32,
    /// Neighbours further than this from the centre pixel don't take part in the smoothing (metres, at 1 m;
    /// grows with the square of the depth, never below half of it).
    pub smoothing_gate: f32,
    /// Surface seen at less than this angle is dropped (degrees; the paper's release uses 10).
    pub grazing_deg: f32,
    /// Fewest mask pixels for a frame to be tracked.
    pub min_mask_pixels: usize,
    /// Pixels taken off the border of the mask, where depth mixes object and background.
    pub mask_erosion: usize,
}

impl Default for PreprocessConfig {
    fn default() -> Self {
        Self {
            working_side: 480,
            min_depth: 0.1,
            max_depth: 10.0,
            smoothing_gate: 0.01,
            grazing_deg: 10.0,
            min_mask_pixels: 100,
            mask_erosion: 1,
        }
    }
}

/// Correspondences, RANSAC and motion gates.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CoarseConfig {
    /// What compares views that are too far apart for point tracks: `classical`, or a network with the file of its
    /// weights, `edgepoint2:FILE` or `xfeat:FILE`.
    #[serde(with = "matcher_name")]
    pub matcher: MatcherSpec,
    /// Corners tracked from the previous frame.
    pub max_corners: usize,
    /// Corners tracked from each memory frame.
    pub max_corners_memory: usize,
    /// RANSAC hypotheses per pair.
    pub hypotheses: usize,
    /// Largest distance of an inlier (metres, at 0.5 m; grows with the depth noise).
    pub inlier_distance: f64,
    /// Largest part of that distance across the line of sight (pixels; widened by what the depth noise adds when the
    /// view turns).
    pub inlier_lateral_px: f64,
    /// Largest angle between the normals of an inlier (degrees).
    pub inlier_normal_deg: f64,
    /// Fewest inliers for a motion to be believed.
    pub min_inliers: usize,
    /// Fewest inliers for a memory frame to become the reference after a loss (paper supplement: more than 10).
    pub min_relocalise_inliers: usize,
    /// Largest translation between consecutive frames (metres).
    pub max_translation: f64,
    /// Largest rotation between consecutive frames (degrees).
    pub max_rotation_deg: f64,
}

impl Default for CoarseConfig {
    fn default() -> Self {
        Self {
            matcher: MatcherSpec::Classical,
            max_corners: 300,
            max_corners_memory: 120,
            hypotheses: 500,
            inlier_distance: 0.006,
            inlier_lateral_px: 2.0,
            inlier_normal_deg: 45.0,
            min_inliers: 8,
            min_relocalise_inliers: 11,
            max_translation: 0.06,
            max_rotation_deg: 30.0,
        }
    }
}

/// A matcher as it is written on a command line.
mod matcher_name {
    use matcher::learned::MatcherSpec;
    use serde::{Deserialize, Deserializer, Serializer, de::Error};

    pub(super) fn serialize<S: Serializer>(spec: &MatcherSpec, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(spec)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<MatcherSpec, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(D::Error::custom)
    }
}

/// The memory pool.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MemoryConfig {
    /// Without memory each frame is compared with the previous one alone.
    pub enabled: bool,
    /// What counts as a new view, and which keyframes take part in the pose graph.
    pub rule: KeyframeRule,
    /// Smallest angle to every keyframe (degrees): of swing (rotation without roll about the optical axis), or by the
    /// rule `full-rotation` of the whole rotation.
    pub min_swing_deg: f64,
    /// Fewest depth pixels of a keyframe, as a share of the first frame's.
    pub min_valid_share: f64,
    /// A keyframe gives way to a frame of the same side that is this many times as good ([`Quality::over`]), if nothing
    /// is lost that it alone shows. Each time that a side changes its keyframe the next has to be so much better again.
    ///
    /// [`Quality::over`]: crate::Quality::over
    pub replace_ratio: f64,
    /// Most keyframes kept.
    pub capacity: usize,
    /// Memory frames in the pose graph, beside the new frame (K in the paper).
    pub selected: usize,
    /// Least share of a keyframe's points that face the new camera (paper: 0.1).
    pub min_visible: f64,
    /// Largest angle between a point's normal and its viewing ray to count as visible (degrees).
    pub visible_deg: f64,
}

impl Default for MemoryConfig {
    fn default() -> Self {
        Self {
            enabled: true,
            rule: KeyframeRule::Compact,
            min_swing_deg: 5.0,
            min_valid_share: 0.1,
            replace_ratio: 1.5,
            capacity: 64,
            selected: 10,
            min_visible: 0.1,
            visible_deg: 70.0,
        }
    }
}

/// How keyframes are told apart and chosen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum KeyframeRule {
    /// By the swing of the optical axis; roll shows nothing new. The visible keyframes nearest to the new frame take
    /// part (paper section 3.2 and 3.3).
    #[default]
    Compact,
    /// By the whole rotation, roll included; those with the least total distance among each other and to the new
    /// frame take part (Wen and Bekris, *BundleTrack*, IROS 2021, section III-D).
    FullRotation,
}

/// Online pose-graph optimisation (paper eq. L_pg).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GraphConfig {
    /// Gauss-Newton iterations (paper: 7).
    pub iterations: usize,
    /// Weight of the feature term, w_f.
    pub feature_weight: f64,
    /// Weight of the dense point-to-plane term, w_p.
    pub dense_weight: f64,
    /// Weight of the SDF term, w_s.
    pub sdf_weight: f64,
    /// Huber threshold of the dense and the SDF term (metres).
    pub huber: f64,
    /// Standard deviation of a matched point across its ray (radians): that of its pixel over the focal length.
    pub match_angle: f64,
    /// Standard deviation of depth at distance z is this (metres)
    pub depth_sigma: f64,
    /// and this times the square of z (1/metres).
    pub depth_sigma_quadratic: f64,
    /// Points of the new frame that are compared with the field.
    pub sdf_points: usize,
    /// Target pixels of the downscaled cloud for the dense term.
    pub dense_pixels: usize,
}

/// Beyond this swing two views share too little surface for a dense comparison (radians).
pub(crate) const MAX_DENSE_SWING: f64 = 1.0;

impl GraphConfig {
    /// What the solver is told; without a field there is nothing that the SDF term could ask.
    pub(crate) fn solve_options(&self, has_field: bool) -> SolveOptions {
        SolveOptions {
            max_iterations: self.iterations,
            feature_weight: self.feature_weight,
            dense_weight: self.dense_weight,
            sdf_weight: if has_field { self.sdf_weight } else { 0.0 },
            dense_huber: self.huber,
            sdf_huber: self.huber,
            feature_angle: self.match_angle,
            depth_sigma_constant: self.depth_sigma,
            depth_sigma_quadratic: self.depth_sigma_quadratic,
            // Nobody reads it, and it costs a linearisation.
            covariance: false,
            ..SolveOptions::default()
        }
    }
}

impl Default for GraphConfig {
    fn default() -> Self {
        Self {
            iterations: 7,
            feature_weight: 1.0,
            dense_weight: 1.0,
            sdf_weight: 1.0,
            huber: 0.005,
            match_angle: 0.000_5,
            depth_sigma: 0.001,
            depth_sigma_quadratic: 0.002,
            sdf_points: 600,
            dense_pixels: 5000,
        }
    }
}

/// When and how the Neural Object Field is trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FieldSettings {
    /// What refines the keyframes beside the tracker; only the field makes a mesh.
    pub refiner: Refiner,
    /// Rays around the mask tell the field where the object is not, and where that is uncertain (the paper's hybrid
    /// SDF); without them it sees the inside of the masks only.
    pub hybrid: bool,
    /// Keyframes before the first round (paper: 10, the authors' release: 5).
    pub first_round_keyframes: usize,
    /// New keyframes that start a further round in the `lockstep` schedule.
    pub keyframes_per_round: usize,
    /// Where rounds are trained.
    pub device: FieldDevice,
    /// Training steps of an online round.
    pub steps: usize,
    /// Training steps of the last round, from which the mesh is taken.
    pub final_steps: usize,
    /// Training steps of each of the two rounds of a refinement: one that moves keyframes, one on where they end up.
    pub refine_steps: usize,
    /// Furthest that a round may move a keyframe along an axis (metres).
    pub max_translation: f64,
    /// Furthest that a round may turn a keyframe about an axis (degrees).
    pub max_rotation_deg: f64,
}

impl Default for FieldSettings {
    fn default() -> Self {
        Self {
            refiner: Refiner::Field,
            hybrid: true,
            first_round_keyframes: 5,
            keyframes_per_round: 4,
            device: FieldDevice::Auto,
            steps: 200,
            final_steps: 800,
            refine_steps: 1500,
            max_translation: 0.02,
            max_rotation_deg: 20.0,
        }
    }
}

/// What refines the keyframes' poses beside the tracker.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Refiner {
    /// The Neural Object Field.
    #[default]
    Field,
    /// A pose graph over all keyframes (the paper's GPG ablation).
    PoseGraph,
    /// Nothing: the tracker and its online pose graph alone.
    None,
}

/// Where the field is trained.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FieldDevice {
    /// On a GPU if the build has the feature `gpu` and the machine has a real one, else on the CPU.
    #[default]
    Auto,
    /// On the CPU.
    Cpu,
    /// On a GPU; refused by a build without the feature `gpu`.
    Gpu,
}

/// Extraction of the final mesh.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MeshConfig {
    /// Marching-cubes spacing (metres).
    pub spacing: f32,
}

impl Default for MeshConfig {
    fn default() -> Self {
        Self { spacing: 0.0025 }
    }
}

/// When the field is trained relative to the tracker.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Schedule {
    /// The tracker waits for a round after each batch of new keyframes: reproducible.
    #[default]
    Lockstep,
    /// The tracker never waits; rounds run beside it on the newest keyframes.
    Realtime,
}

/// A config that can't be used.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {problem}; see the config section of the README for the keys and their defaults")]
pub struct ConfigError {
    /// File name, or `config` when it came from memory.
    pub path: String,
    /// What is wrong.
    pub problem: String,
}

impl Config {
    /// The tracker that the paper builds on: keyframes and their choice as in BundleTrack (Wen and Bekris, IROS 2021),
    /// an online pose graph, no field and no mesh.
    #[must_use]
    pub fn bundletrack() -> Self {
        let mut config = Self::default();
        config.field.refiner = Refiner::None;
        config.memory.rule = KeyframeRule::FullRotation;
        config.memory.min_swing_deg = 10.0;
        config
    }

    /// Reads a TOML text; `path` names it in errors.
    ///
    /// # Errors
    /// On a syntax error, an unknown key, or a value outside its range.
    pub fn from_toml(text: &str, path: &str) -> Result<Self, ConfigError> {
        let config: Self = toml::from_str(text).map_err(|e| ConfigError {
            path: path.to_owned(),
            problem: e.to_string().trim().replace('\n', " "),
        })?;
        config.validate().map_err(|problem| ConfigError { path: path.to_owned(), problem })?;
        Ok(config)
    }

    /// Checks that every value is in its range; the message names the key.
    ///
    /// # Errors
    /// The first key whose value can't work, with its range.
    pub fn validate(&self) -> Result<(), String> {
        let positive = |name: &str, value: f64| {
            if value.is_finite() && value > 0.0 {
                Ok(())
            } else {
                Err(format!("{name} must be above 0, is {value}"))
            }
        };
        let between = |name: &str, value: f64, range: std::ops::RangeInclusive<f64>| {
            // NaN lies in no range.
            if range.contains(&value) {
                Ok(())
            } else {
                Err(format!("{name} must be within {} to {}, is {value}", range.start(), range.end()))
            }
        };
        let within = |name: &str, value: usize, range: std::ops::RangeInclusive<usize>| {
            if range.contains(&value) {
                Ok(())
            } else {
                Err(format!("{name} must be within {} to {}, is {value}", range.start(), range.end()))
            }
        };
        if self.field.device == FieldDevice::Gpu && !cfg!(feature = "gpu") {
            return Err(
                "field.device is gpu, but this build has no GPU engine: build it with --features gpu".into(),
            );
        }
        let (p, c, m, g, f) = (&self.preprocess, &self.coarse, &self.memory, &self.graph, &self.field);
        within("preprocess.working_side", p.working_side, 60..=4000)?;
        within("preprocess.mask_erosion", p.mask_erosion, 0..=20)?;
        positive("preprocess.max_depth - preprocess.min_depth", f64::from(p.max_depth - p.min_depth))?;
        positive("preprocess.smoothing_gate", f64::from(p.smoothing_gate))?;
        between("preprocess.grazing_deg", f64::from(p.grazing_deg), 0.0..=90.0)?;
        within("coarse.max_corners", c.max_corners, 8..=5000)?;
        within("coarse.max_corners_memory", c.max_corners_memory, 8..=5000)?;
        within("coarse.hypotheses", c.hypotheses, 1..=100_000)?;
        within("coarse.min_inliers", c.min_inliers, 3..=1000)?;
        positive("coarse.inlier_distance", c.inlier_distance)?;
        positive("coarse.inlier_lateral_px", c.inlier_lateral_px)?;
        positive("coarse.inlier_normal_deg", c.inlier_normal_deg)?;
        positive("coarse.max_translation", c.max_translation)?;
        positive("coarse.max_rotation_deg", c.max_rotation_deg)?;
        positive("memory.min_swing_deg", m.min_swing_deg)?;
        between("memory.min_valid_share", m.min_valid_share, 0.0..=1.0)?;
        between("memory.min_visible", m.min_visible, 0.0..=1.0)?;
        between("memory.visible_deg", m.visible_deg, 0.0..=90.0)?;
        between("memory.replace_ratio", m.replace_ratio, 1.0..=1e6)?;
        within("memory.capacity", m.capacity, 2..=1000)?;
        within("memory.selected", m.selected, 1..=15)?;
        within("graph.iterations", g.iterations, 1..=100)?;
        for (name, weight) in [
            ("graph.feature_weight", g.feature_weight),
            ("graph.dense_weight", g.dense_weight),
            ("graph.sdf_weight", g.sdf_weight),
        ] {
            between(name, weight, 0.0..=1e6)?;
        }
        within("graph.sdf_points", g.sdf_points, 0..=1_000_000)?;
        positive("graph.huber", g.huber)?;
        between("graph.match_angle", g.match_angle, 1e-6..=0.1)?;
        between("graph.depth_sigma", g.depth_sigma, 1e-6..=1.0)?;
        between("graph.depth_sigma_quadratic", g.depth_sigma_quadratic, 0.0..=1.0)?;
        within("graph.dense_pixels", g.dense_pixels, 100..=1_000_000)?;
        within("field.first_round_keyframes", f.first_round_keyframes, 1..=1000)?;
        within("field.keyframes_per_round", f.keyframes_per_round, 1..=1000)?;
        within("field.steps", f.steps, 1..=100_000)?;
        within("field.final_steps", f.final_steps, 1..=100_000)?;
        within("field.refine_steps", f.refine_steps, 1..=100_000)?;
        positive("field.max_translation", f.max_translation)?;
        positive("field.max_rotation_deg", f.max_rotation_deg)?;
        positive("mesh.spacing", f64::from(self.mesh.spacing))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_defaults_are_valid_and_survive_a_round_trip_through_toml() {
        let config = Config::default();
        config.validate().unwrap();
        let text = toml::to_string(&config).unwrap();
        assert_eq!(Config::from_toml(&text, "c.toml").unwrap(), config);
    }

    #[test]
    fn an_unknown_key_and_an_impossible_value_are_refused_by_name() {
        let error = Config::from_toml("[memory]\nmin_swing = 3\n", "c.toml").unwrap_err().to_string();
        assert!(error.contains("c.toml") && error.contains("min_swing"), "{error}");
        let error = Config::from_toml("[mesh]\nspacing = 0.0\n", "c.toml").unwrap_err().to_string();
        assert!(error.contains("mesh.spacing"), "{error}");
        for (section, key) in [
            ("mesh", "spacing"),
            ("preprocess", "grazing_deg"),
            ("memory", "min_valid_share"),
            ("memory", "replace_ratio"),
            ("memory", "min_visible"),
            ("memory", "visible_deg"),
            ("graph", "feature_weight"),
            ("graph", "dense_weight"),
            ("graph", "sdf_weight"),
            ("graph", "huber"),
            ("graph", "match_angle"),
            ("graph", "depth_sigma"),
            ("graph", "depth_sigma_quadratic"),
        ] {
            for value in ["nan", "-1.0", "inf"] {
                let text = format!("[{section}]\n{key} = {value}\n");
                let error = Config::from_toml(&text, "c.toml").unwrap_err().to_string();
                assert!(error.contains(&format!("{section}.{key}")), "{error}");
            }
        }
    }
}
