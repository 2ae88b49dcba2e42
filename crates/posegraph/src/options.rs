//! What a caller can choose about a solve, with the defaults for a hand-sized object at arm's length.

use crate::error::Error;

/// Source pixels of a dense edge at least, however many edges share them.
const MIN_DENSE_PER_EDGE: usize = 200;

/// Options of [`solve`](crate::solve).
///
/// Every residual is divided by the standard deviation given here, so that the objective is half a sum of squared,
/// unit-variance residuals, prior information matrices are commensurate and the inverse Hessian is a covariance.
///
/// No edge dominates by count: neighbouring residuals are correlated, so an edge with more than `*_cap` residuals
/// (total weight) has its weights scaled down to sum to the cap.
#[derive(Debug, Clone, PartialEq)]
pub struct SolveOptions {
    /// Linearisations at most.
    pub max_iterations: usize,
    /// Factor on all feature edges (`w_f`); 0 switches them off.
    pub feature_weight: f64,
    /// Factor on all dense edges (`w_p`); 0 switches them off.
    pub dense_weight: f64,
    /// Factor on all SDF terms (`w_s`); 0 switches them off.
    pub sdf_weight: f64,
    /// Huber threshold on the difference of matched points, standard deviations.
    pub feature_huber: f64,
    /// Where Huber's loss of a matched pair begins to level off, standard deviations: a wrong match must not gain by turning
    /// cameras until the difference lies along their rays.
    pub feature_saturation: f64,
    /// How many times as wide both are at the first iteration; 1 from `tighten_iterations` on.
    pub feature_widening: f64,
    /// Huber threshold on the point-to-plane distance, metres.
    pub dense_huber: f64,
    /// Huber threshold on the signed distance, metres.
    pub sdf_huber: f64,
    /// Standard deviation of a matched point across its ray, radians: that of its pixel over the focal length. Along the ray
    /// it has the depth noise.
    pub feature_angle: f64,
    /// Constant part `a` of the depth noise `sigma(z) = a + b z^2` of one frame, metres.
    pub depth_sigma_constant: f64,
    /// Quadratic part `b` of the depth noise, 1/metres. A residual has the variance of its two depths.
    pub depth_sigma_quadratic: f64,
    /// Standard deviation of an SDF residual, metres.
    pub sdf_sigma: f64,
    /// Effective number of matches of one feature edge at most.
    pub feature_cap: f64,
    /// Effective number of pixels of one dense edge at most.
    pub dense_cap: f64,
    /// Effective number of points of one SDF term at most.
    pub sdf_cap: f64,
    /// Source pixels of one dense edge at most, spread evenly over the valid ones.
    pub max_dense_per_edge: usize,
    /// Source pixels of all dense edges together, about: beyond that every edge gets its share, but at least 200, and
    /// each pixel stands for several. The many edges of a node tell the same.
    pub max_dense: usize,
    /// Pixels less than this away from the projection, in both directions, are compared at the first iteration; at
    /// least 1.
    pub association_radius_initial: usize,
    /// The same from `tighten_iterations` on; at least 1.
    pub association_radius: usize,
    /// Distance gate of the association at the first iteration, metres.
    pub max_distance_initial: f64,
    /// Distance gate of the association from `tighten_iterations` on, metres.
    pub max_distance: f64,
    /// Normal gate of the association at the first iteration, radians, below pi/2.
    pub max_normal_angle_initial: f64,
    /// Normal gate of the association from `tighten_iterations` on, radians, below pi/2.
    pub max_normal_angle: f64,
    /// Iterations over which the window, the gates and the threshold on matches go from their first to their last
    /// value.
    pub tighten_iterations: usize,
    /// Dense edges between cameras that differ by more than this rotation are skipped, radians.
    pub max_pair_rotation: f64,
    /// First Levenberg-Marquardt damping, relative to the diagonal.
    pub initial_damping: f64,
    /// Converged when every node's translation step is below this, metres, and
    pub translation_tolerance: f64,
    /// every rotation step is below this, radians; or
    pub rotation_tolerance: f64,
    /// when the cost sinks by less than this fraction.
    pub cost_tolerance: f64,
    /// Whether nodes are held at their predictions in directions that the measurements don't observe: those of which
    /// noise in the normals could as well give all the information.
    pub hold: bool,
    /// Whether to compute `Solution::covariances`.
    pub covariance: bool,
}

impl Default for SolveOptions {
    fn default() -> Self {
        Self {
            max_iterations: 12,
            feature_weight: 1.0,
            dense_weight: 1.0,
            sdf_weight: 1.0,
            feature_huber: 2.5,
            feature_saturation: 15.0,
            feature_widening: 4.0,
            dense_huber: 0.005,
            sdf_huber: 0.005,
            feature_angle: 0.0005,
            depth_sigma_constant: 0.001,
            depth_sigma_quadratic: 0.002,
            sdf_sigma: 0.002,
            feature_cap: 200.0,
            dense_cap: 400.0,
            sdf_cap: 1000.0,
            max_dense_per_edge: 800,
            max_dense: usize::MAX,
            association_radius_initial: 3,
            association_radius: 1,
            max_distance_initial: 0.02,
            max_distance: 0.01,
            max_normal_angle_initial: 30f64.to_radians(),
            max_normal_angle: 20f64.to_radians(),
            tighten_iterations: 3,
            max_pair_rotation: 60f64.to_radians(),
            initial_damping: 1e-3,
            translation_tolerance: 1e-5,
            rotation_tolerance: 5e-5,
            cost_tolerance: 1e-6,
            hold: true,
            covariance: true,
        }
    }
}

/// Window and gates of the association, and what matches may differ by, at one iteration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Gates {
    pub(crate) radius: usize,
    pub(crate) max_distance: f32,
    pub(crate) min_cosine: f32,
    /// Huber threshold and saturation of the matches, standard deviations.
    pub(crate) feature: [f32; 2],
    /// Whether they have reached their last value.
    pub(crate) last: bool,
}

impl SolveOptions {
    /// Gates at `iteration`; linear from the first to the last value.
    pub(crate) fn gates(&self, iteration: usize) -> Gates {
        let t = if self.tighten_iterations == 0 {
            1.0
        } else {
            (iteration as f64 / self.tighten_iterations as f64).min(1.0)
        };
        let mix = |first: f64, last: f64| first + (last - first) * t;
        Gates {
            radius: mix(self.association_radius_initial as f64, self.association_radius as f64)
                .round()
                .max(1.0) as usize,
            max_distance: mix(self.max_distance_initial, self.max_distance) as f32,
            min_cosine: mix(self.max_normal_angle_initial, self.max_normal_angle).cos() as f32,
            feature: [self.feature_huber, self.feature_saturation]
                .map(|deviations| (deviations * mix(self.feature_widening, 1.0)) as f32),
            last: t >= 1.0,
        }
    }

    /// Source pixels of each of so many dense edges at most.
    pub(crate) fn dense_share(&self, edges: usize) -> usize {
        let share = (self.max_dense / edges.max(1)).max(MIN_DENSE_PER_EDGE);
        share.min(self.max_dense_per_edge)
    }

    /// Variance of one depth measurement at depth `z`, square metres.
    pub(crate) fn depth_variance(&self, z: f64) -> f64 {
        let sigma = self.depth_sigma_constant + self.depth_sigma_quadratic * z * z;
        sigma * sigma
    }

    pub(crate) fn validate(&self) -> Result<(), Error> {
        let positive = [
            ("feature_huber", self.feature_huber),
            ("feature_saturation", self.feature_saturation),
            ("feature_widening", self.feature_widening),
            ("dense_huber", self.dense_huber),
            ("sdf_huber", self.sdf_huber),
            ("feature_angle", self.feature_angle),
            ("depth_sigma_constant", self.depth_sigma_constant),
            ("sdf_sigma", self.sdf_sigma),
            ("feature_cap", self.feature_cap),
            ("dense_cap", self.dense_cap),
            ("sdf_cap", self.sdf_cap),
            ("max_distance_initial", self.max_distance_initial),
            ("max_distance", self.max_distance),
            ("initial_damping", self.initial_damping),
        ];
        let not_negative = [
            ("feature_weight", self.feature_weight),
            ("dense_weight", self.dense_weight),
            ("sdf_weight", self.sdf_weight),
            ("depth_sigma_quadratic", self.depth_sigma_quadratic),
            ("max_normal_angle_initial", self.max_normal_angle_initial),
            ("max_normal_angle", self.max_normal_angle),
            ("max_pair_rotation", self.max_pair_rotation),
            ("translation_tolerance", self.translation_tolerance),
            ("rotation_tolerance", self.rotation_tolerance),
            ("cost_tolerance", self.cost_tolerance),
        ];
        // Caps may be infinite: that switches the normalisation off.
        let bad = |name: &str, v: f64| !(v.is_finite() || (name.ends_with("_cap") && v > 0.0));
        for (name, value) in positive {
            if bad(name, value) || value <= 0.0 {
                return Err(Error::InvalidOption { name, value });
            }
        }
        for (name, value) in not_negative {
            let right_angle = name.contains("normal_angle") && value >= std::f64::consts::FRAC_PI_2;
            if bad(name, value) || value < 0.0 || right_angle {
                return Err(Error::InvalidOption { name, value });
            }
        }
        Ok(())
    }
}
