//! Training parameters and the sets of them worth naming.

use crate::error::FieldError;

/// Weights of the losses. All losses are in truncation units and normalised by the number of samples (rays for the
/// colour), so weights mean the same for every object size and batch size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossWeights {
    /// Uncertain free space, one-sided L2 to [`FieldConfig::epsilon`] or the ray's clearance.
    pub uncertain: f64,
    /// Empty space, one-sided L1 to [`FieldConfig::free_distance`], beside the object to the ray's clearance.
    pub empty: f64,
    /// Near-surface distance, L2.
    pub surface: f64,
    /// Blended colour, L2 over channels in 0..1.
    pub color: f64,
    /// `(|gradient| - 1)^2` near the surface.
    pub eikonal: f64,
}

/// Parameters of one training round.
#[derive(Clone, Debug, PartialEq)]
pub struct FieldConfig {
    /// Optimisation steps.
    pub steps: usize,
    /// Rays with a measured depth inside the mask, per step.
    pub surface_rays: usize,
    /// Rays through the ring around the mask, per step.
    pub ring_rays: usize,
    /// Samples per ray over its occupied intervals (N in the paper). Rounded up to a multiple of 4.
    pub free_samples: usize,
    /// Samples per ray in the band around the measured depth (N' in the paper). Rounded up to a multiple of 4.
    pub band_samples: usize,
    /// How many of the band's samples, those around the measured depth, also get colour and eikonal terms.
    pub color_samples: usize,
    /// Truncation distance (lambda), metres.
    pub truncation: f64,
    /// How far behind the measured depth samples reach, in truncation units (the paper 0.5, the release 1); nowhere
    /// further than the silhouette's rim is away: a part may be as thin as it looks narrow, and the distance to its front
    /// is not that to its nearest side.
    pub behind: f64,
    /// Distance from the measured depth, in truncation units, at which the surface loss's weight has fallen to one
    /// half, `1 / (1 + (u / falloff)^2)`; 0 keeps it constant. Far from the surface the distance along a ray is not
    /// the distance to the surface, and views would pull the poses apart to reconcile the two.
    pub surface_falloff: f64,
    /// Largest edge of an occupancy voxel, metres; small objects get a twelfth of their extent.
    pub voxel_size: f64,
    /// Edge of the field's volume over the largest extent of the fused cloud.
    pub volume_scale: f64,
    /// Lattices of the feature grid, two features each.
    pub levels: usize,
    /// Cells per axis of the coarsest lattice.
    pub base_resolution: u32,
    /// Cells per axis of the finest lattice.
    pub finest_resolution: u32,
    /// Largest number of vertices stored per lattice, as a power of two; larger lattices are hashed.
    pub log2_table_size: u32,
    /// Width of the hidden layers, a multiple of 8.
    pub hidden: usize,
    /// Geometry features given to the colour network.
    pub geometry_features: usize,
    /// Numbers in each frame's appearance code, which lets the colour network follow light and exposure from frame to
    /// frame; queries use the mean of all frames. 0 is none.
    pub appearance: usize,
    /// Loss weights.
    pub weights: LossWeights,
    /// Distance to which uncertain free space is lifted, truncation units.
    pub epsilon: f64,
    /// Distance to which the space in front of a measured depth is lifted, truncation units (1 in the paper). On its way
    /// a ray may graze another part of the object, which a large value pushes away from it.
    pub free_distance: f64,
    /// Softness (alpha) of the bell that blends the colours of a ray around the measured depth.
    pub color_sharpness: f64,
    /// Radius of the window in which colours are compared with the brightness around them, as a share of the mask's larger
    /// side: moving light changes colours, and poses follow them, but it hardly changes such a contrast. 0 takes colours as
    /// they are.
    pub contrast_window: f64,
    /// Share of the steps that pass before colour is trained.
    pub color_start: f64,
    /// The eikonal term runs on every n-th tile of rays; 0 is never.
    pub eikonal_every: usize,
    /// Learning rate of grid and networks.
    pub learning_rate: f64,
    /// Learning rate of the pose parameters (units: share of the bounds below).
    pub pose_learning_rate: f64,
    /// Share of the steps before poses start to move; their rate then grows to its full value over as many steps.
    pub pose_start: f64,
    /// Share of the steps after which poses rest and the field settles on them.
    pub pose_end: f64,
    /// Learning rates at the last step over those at the first; exponential in between.
    pub decay: f64,
    /// Bound of a pose's correction in a round, metres per axis.
    pub max_translation: f64,
    /// Bound of a pose's correction in a round, degrees per axis.
    pub max_rotation_deg: f64,
    /// Weight of the first frame's rays, against 1 for every other frame.
    pub first_frame_weight: f64,
    /// A frame whose points lie further from the surface than this many times the frames' median loses weight, until
    /// its pose fits again; 0 trusts all frames alike.
    pub outlier_ratio: f64,
    /// Width of the ring around the mask, as a share of the mask's larger side.
    pub ring_width: f64,
    /// Multiply the distance along the ray by the cosine of incidence where depth gives a normal, and weight the
    /// surface loss by the cosine's square.
    pub incidence_correction: bool,
    /// Treat ring pixels whose measured depth is behind the object as empty space, and those in front of it as
    /// seen up to that depth only.
    pub background_depth: bool,
    /// Most candidate rays kept per frame and kind.
    pub rays_per_frame: usize,
    /// Seed of every random choice.
    pub seed: u64,
}

impl Default for FieldConfig {
    fn default() -> Self {
        Self::realtime()
    }
}

impl FieldConfig {
    /// The paper's counts, lattices and schedule (section 3.4 and its supplement). The loss weights are those of
    /// [`realtime`](Self::realtime): the paper's belong to losses in other units and of another normalisation.
    pub fn paper() -> Self {
        Self {
            steps: 300,
            surface_rays: 1536,
            ring_rays: 512,
            free_samples: 128,
            band_samples: 64,
            color_samples: 64,
            behind: 0.5,
            surface_falloff: 0.0,
            pose_learning_rate: 0.01,
            pose_start: 0.0,
            pose_end: 1.0,
            finest_resolution: 128,
            levels: 4,
            epsilon: 0.001,
            free_distance: 1.0,
            contrast_window: 0.0,
            color_start: 0.0,
            eikonal_every: 1,
            first_frame_weight: 1.0,
            incidence_correction: false,
            background_depth: false,
            ..Self::realtime()
        }
    }

    /// After the released online configuration: 500 steps, a band of one truncation distance on both sides, no eikonal
    /// term, a privileged first frame.
    pub fn release() -> Self {
        Self {
            steps: 500,
            behind: 1.0,
            weights: LossWeights { uncertain: 50.0, empty: 1.0, surface: 12.0, color: 10.0, eikonal: 0.0 },
            eikonal_every: 0,
            first_frame_weight: 10.0,
            ..Self::paper()
        }
    }

    /// Our default on a CPU: a round of a few seconds on two cores.
    pub fn realtime() -> Self {
        Self {
            steps: 400,
            surface_rays: 384,
            ring_rays: 128,
            free_samples: 16,
            band_samples: 16,
            color_samples: 8,
            truncation: 0.01,
            behind: 0.6,
            surface_falloff: 0.2,
            voxel_size: 0.02,
            volume_scale: 1.5,
            levels: 3,
            base_resolution: 16,
            finest_resolution: 64,
            log2_table_size: 22,
            hidden: 64,
            geometry_features: 15,
            appearance: 0,
            weights: LossWeights { uncertain: 1.0, empty: 1.0, surface: 10.0, color: 20.0, eikonal: 0.1 },
            epsilon: 0.2,
            free_distance: 0.3,
            color_sharpness: 5.0,
            contrast_window: 0.1,
            color_start: 0.0,
            eikonal_every: 2,
            learning_rate: 0.01,
            pose_learning_rate: 0.03,
            pose_start: 0.05,
            pose_end: 0.85,
            decay: 0.1,
            max_translation: 0.02,
            max_rotation_deg: 20.0,
            first_frame_weight: 4.0,
            outlier_ratio: 0.0,
            ring_width: 0.15,
            incidence_correction: true,
            background_depth: true,
            rays_per_frame: 8192,
            seed: 0,
        }
    }

    /// The last round over all keyframes, after the video has ended: [`realtime`](Self::realtime) with more steps, and
    /// frames that don't fit lose weight.
    ///
    /// More and finer lattices (16 up to 256 cells, hashed beyond 2^17 vertices: `levels`, `finest_resolution`,
    /// `log2_table_size`) follow the noise of the depth.
    pub fn refine() -> Self {
        Self { steps: 1500, outlier_ratio: 3.0, ..Self::realtime() }
    }

    pub(crate) fn validate(&self) -> Result<(), FieldError> {
        let positive = [
            ("truncation", self.truncation),
            ("voxel_size", self.voxel_size),
            ("learning_rate", self.learning_rate),
            ("decay", self.decay),
            ("color_sharpness", self.color_sharpness),
        ];
        let not_negative = [
            ("pose_learning_rate", self.pose_learning_rate),
            ("behind", self.behind),
            ("epsilon", self.epsilon),
            ("surface_falloff", self.surface_falloff),
            ("pose_start", self.pose_start),
            ("pose_end", self.pose_end),
            ("free_distance", self.free_distance),
            ("contrast_window", self.contrast_window),
            ("color_start", self.color_start),
            ("max_translation", self.max_translation),
            ("max_rotation_deg", self.max_rotation_deg),
            ("first_frame_weight", self.first_frame_weight),
            ("outlier_ratio", self.outlier_ratio),
            ("ring_width", self.ring_width),
            ("weights.uncertain", self.weights.uncertain),
            ("weights.empty", self.weights.empty),
            ("weights.surface", self.weights.surface),
            ("weights.color", self.weights.color),
            ("weights.eikonal", self.weights.eikonal),
        ];
        for (key, value) in positive {
            if !(value.is_finite() && value > 0.0) {
                return Err(FieldError::Config { key, need: "a positive finite number" });
            }
        }
        for (key, value) in not_negative {
            if !(value.is_finite() && value >= 0.0) {
                return Err(FieldError::Config { key, need: "a finite number of at least 0" });
            }
        }
        let ranges = [
            ("surface_rays", self.surface_rays, 1, 1 << 16),
            ("ring_rays", self.ring_rays, 0, 1 << 16),
            ("free_samples", self.free_samples, 1, 1024),
            ("band_samples", self.band_samples, 1, 1024),
            ("color_samples", self.color_samples, 1, 1024),
            ("levels", self.levels, 1, 16),
            ("base_resolution", self.base_resolution as usize, 2, 4096),
            ("finest_resolution", self.finest_resolution as usize, self.base_resolution as usize, 4096),
            ("log2_table_size", self.log2_table_size as usize, 8, 24),
            ("hidden", self.hidden, 8, 256),
            ("geometry_features", self.geometry_features, 1, 64),
            ("appearance", self.appearance, 0, 32),
            ("rays_per_frame", self.rays_per_frame, 1, 1 << 24),
        ];
        for (key, value, low, high) in ranges {
            if !(low..=high).contains(&value) {
                return Err(FieldError::Config { key, need: "a number in its documented range" });
            }
        }
        if !self.hidden.is_multiple_of(8) {
            return Err(FieldError::Config { key: "hidden", need: "a multiple of 8" });
        }
        if !(1.0..=8.0).contains(&self.volume_scale) {
            return Err(FieldError::Config { key: "volume_scale", need: "a number from 1 to 8" });
        }
        Ok(())
    }
}
