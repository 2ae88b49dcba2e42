//! The rigid motion on which a set of 3-D matches agrees.
//!
//! RANSAC (Fischler and Bolles 1981) with a truncated quadratic score (MSAC) and local refinement (Chum et al., *Locally
//! optimized RANSAC*, DAGM 2003). Points and normals come in the **object frame under the current pose estimates**, so
//! the motion is the *residual* one: gates on it act alike near and far. "No model" is an answer: a motion outside the
//! gates is never scored and cannot leak its inliers.

pub(crate) mod triangle;
pub(crate) mod votes;

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use se3_lie::align::rigid_alignment;

use crate::simd;
use triangle::Motion;
use votes::Votes;

/// What a model must fulfil, and how long to look for it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RansacOptions {
    /// Motions to score. Samples that can't be a rigid motion, or that leave the gates, don't count; ten times as many
    /// samples are drawn at most.
    pub hypotheses: usize,
    /// Largest distance of a moved point of `a` to its point of `b`, metres.
    pub inlier_distance: f64,
    /// Largest part of that distance across the line of sight, metres, where a match has one: a pixel tells direction
    /// much better than depth. Larger than `inlier_distance` = not tested.
    pub inlier_lateral: f64,
    /// Largest angle between the normals, radians; from pi on it is not tested.
    pub inlier_normal_angle: f64,
    /// Longest translation of a model, metres (in the object frame, whose origin is near the object's centre);
    /// infinite = not tested.
    pub max_translation: f64,
    /// Largest rotation angle of a model, radians; infinite = not tested.
    pub max_rotation: f64,
    /// Fewest inliers of a model; never less than 3.
    pub min_inliers: usize,
    /// Seed of the samples: equal input and seed give an equal result.
    pub seed: u64,
}

impl Default for RansacOptions {
    fn default() -> Self {
        Self {
            hypotheses: 1000,
            inlier_distance: 0.005,
            inlier_lateral: f64::INFINITY,
            inlier_normal_angle: 30_f64.to_radians(),
            max_translation: f64::INFINITY,
            max_rotation: f64::INFINITY,
            min_inliers: 5,
            seed: 0,
        }
    }
}

/// A match with depth: points (metres) and unit normals, all in the object frame under the current poses.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LiftedMatch {
    /// Point seen in the first view.
    pub a: [f32; 3],
    /// Its normal; zero if unknown, then normals are not compared.
    pub normal_a: [f32; 3],
    /// Point seen in the second view.
    pub b: [f32; 3],
    /// Its normal; zero if unknown.
    pub normal_b: [f32; 3],
    /// Unit line of sight at `b`, either way round; zero if unknown, then all directions count the same.
    pub sight: [f32; 3],
    /// Weight of the match in score and fit, positive; matches with another weight or with a NaN are left out.
    pub weight: f32,
}

impl LiftedMatch {
    fn is_usable(&self) -> bool {
        let all = [self.a, self.normal_a, self.b, self.normal_b, self.sight];
        self.weight > 0.0 && self.weight.is_finite() && all.as_flattened().iter().all(|v| v.is_finite())
    }

    fn has_normals(&self) -> bool {
        self.normal_a != [0.0; 3] && self.normal_b != [0.0; 3]
    }
}

/// A motion and the matches that follow it.
#[derive(Clone, Debug, PartialEq)]
pub struct RigidModel {
    /// Maps points `a` to points `b`, both in the object frame.
    pub motion: Isometry3<f64>,
    /// Indices of the inliers among the matches, ascending.
    pub inliers: Vec<usize>,
    /// Sum over the inliers of `weight * (1 - r^2)`, r the residual relative to the thresholds.
    pub score: f64,
}

/// A triangle's altitudes, and the second extent of a set of inliers, relative to the extent of the matches: below, the
/// rotation about their line is noise.
const MIN_RELATIVE_WIDTH: f64 = 0.03;
const REFINEMENTS: usize = 3;
const DRAWS_PER_HYPOTHESIS: usize = 10;

/// The motion with the best score among those inside the gates; `None` if there is none with enough inliers, or if the
/// inliers don't determine it (all on a line, or in one place).
pub fn estimate(matches: &[LiftedMatch], options: &RansacOptions) -> Option<RigidModel> {
    let problem = Problem::new(matches, options)?;
    let motion = problem.best_sample()?;
    let mut best = problem.model(to_isometry(&motion));
    for _ in 0..REFINEMENTS {
        let Some(motion) = problem.fit(&best.motion, 1.0, tukey) else { break };
        if !problem.is_inside_gates(&motion) {
            break;
        }
        let refined = problem.model(motion);
        if refined.score <= best.score {
            break;
        }
        best = refined;
    }
    problem.accept(best)
}

/// Robust alignment from an `initial` motion that is already close: iteratively re-weighted least squares with the
/// Geman-McClure weight, whose width shrinks from three inlier distances to one. Same gates and acceptance as
/// [`estimate`]; no randomness.
pub fn refine(
    matches: &[LiftedMatch],
    initial: &Isometry3<f64>,
    options: &RansacOptions,
) -> Option<RigidModel> {
    let problem = Problem::new(matches, options)?;
    if !initial.to_homogeneous().iter().all(|v| v.is_finite()) {
        return None;
    }
    let mut motion = *initial;
    for width in [3.0, 2.0, 1.5, 1.0, 1.0, 1.0] {
        motion = problem.fit(&motion, width, geman_mcclure)?;
    }
    problem.is_inside_gates(&motion).then(|| problem.model(motion)).and_then(|m| problem.accept(m))
}

/// Weight of a residual, both relative to the width squared.
fn tukey(squared: f64) -> f64 {
    (1.0 - squared).max(0.0).powi(2)
}

fn geman_mcclure(squared: f64) -> f64 {
    // Cut off where nothing is left, so that far outliers can't act together.
    if squared < 9.0 { (1.0 + squared).powi(-2) } else { 0.0 }
}

fn to_isometry(motion: &Motion) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(motion.rotation));
    Isometry3::from_parts(Translation3::from(motion.translation), rotation)
}

/// The usable matches and the thresholds.
struct Problem<'a> {
    matches: &'a [LiftedMatch],
    /// Indices of the usable matches.
    usable: Vec<usize>,
    a: Vec<Point3<f64>>,
    b: Vec<Point3<f64>>,
    options: &'a RansacOptions,
    tau: f64,
    lateral: f64,
    min_cos: f64,
}

impl<'a> Problem<'a> {
    fn new(matches: &'a [LiftedMatch], options: &'a RansacOptions) -> Option<Self> {
        let tau = options.inlier_distance;
        let usable: Vec<usize> = (0..matches.len()).filter(|&i| matches[i].is_usable()).collect();
        if !(tau > 0.0 && tau.is_finite()) || usable.len() < options.min_inliers.max(3) {
            return None;
        }
        let point = |p: [f32; 3]| Point3::from(p.map(f64::from));
        let a = usable.iter().map(|&i| point(matches[i].a)).collect();
        let b = usable.iter().map(|&i| point(matches[i].b)).collect();
        let angle = options.inlier_normal_angle;
        // A cosine of -2 is always reached; a NaN angle is no test.
        let min_cos = if angle < std::f64::consts::PI { angle.max(0.0).cos() } else { -2.0 };
        let lateral = if options.inlier_lateral > 0.0 { options.inlier_lateral.min(tau) } else { tau };
        Some(Self { matches, usable, a, b, options, tau, lateral, min_cos })
    }

    /// NaN gates let nothing through.
    fn is_gated(&self, translation: f64, cos_angle: f64) -> bool {
        let angle = cos_angle.clamp(-1.0, 1.0).acos();
        !(translation <= self.options.max_translation && angle <= self.options.max_rotation)
    }

    fn is_inside_gates(&self, motion: &Isometry3<f64>) -> bool {
        let angle = motion.rotation.angle();
        motion.translation.vector.norm() <= self.options.max_translation && angle <= self.options.max_rotation
    }

    /// The best-scored motion of three matches inside the gates.
    fn best_sample(&self) -> Option<Motion> {
        let n = self.a.len();
        let min_altitude = (MIN_RELATIVE_WIDTH * extent(&self.a)).max(1e-9);
        let usable = self.usable.iter().map(|&i| &self.matches[i]);
        let votes = Votes::new(usable, self.tau, self.lateral, self.min_cos);
        let mut rng = Pcg64Mcg::seed_from_u64(self.options.seed);
        let mut best: Option<(f32, Motion)> = None;
        let mut scored = 0;
        for _ in 0..self.options.hypotheses.saturating_mul(DRAWS_PER_HYPOTHESIS) {
            if scored == self.options.hypotheses {
                break;
            }
            let [i, j, k] = three_of(n, &mut rng);
            let (a, b) = ([self.a[i], self.a[j], self.a[k]], [self.b[i], self.b[j], self.b[k]]);
            // Two inliers are off by a threshold each, at most.
            if !triangle::are_alike(&a, &b, 2.0 * self.tau, min_altitude) {
                continue;
            }
            let Some(motion) = triangle::motion_of(&a, &b) else { continue };
            if self.is_gated(motion.translation.norm(), 0.5 * (motion.rotation.trace() - 1.0)) {
                continue;
            }
            scored += 1;
            let score = simd::score(&votes, &motion);
            if score > best.as_ref().map_or(0.0, |b| b.0) {
                best = Some((score, motion));
            }
        }
        best.map(|b| b.1)
    }

    /// Squared residual of usable match `i` under `motion`, relative to the thresholds; `None` if its normals disagree.
    fn squared_residual(&self, i: usize, motion: &Isometry3<f64>) -> Option<f64> {
        let m = &self.matches[self.usable[i]];
        if self.min_cos > -1.0 && m.has_normals() {
            let normal = |v: [f32; 3]| Vector3::from(v.map(f64::from));
            if (motion.rotation * normal(m.normal_a)).dot(&normal(m.normal_b)) < self.min_cos {
                return None;
            }
        }
        let residual = motion * self.a[i] - self.b[i];
        let (along, squared) =
            (residual.dot(&Vector3::from(m.sight.map(f64::from))), residual.norm_squared());
        let tau = self.tau * self.tau;
        if m.sight == [0.0; 3] {
            return Some(squared / tau);
        }
        Some((squared - along * along).max(0.0) / (self.lateral * self.lateral) + along * along / tau)
    }

    /// Weighted alignment with robust weights at `motion`; `width` is relative to the thresholds.
    fn fit(&self, motion: &Isometry3<f64>, width: f64, robust: fn(f64) -> f64) -> Option<Isometry3<f64>> {
        let weight = |i: usize| {
            let squared = self.squared_residual(i, motion)? / (width * width);
            Some(f64::from(self.matches[self.usable[i]].weight) * robust(squared))
        };
        let weights: Vec<f64> = (0..self.a.len()).map(|i| weight(i).unwrap_or(0.0)).collect();
        rigid_alignment(&self.a, &self.b, Some(&weights))
    }

    fn model(&self, motion: Isometry3<f64>) -> RigidModel {
        let mut model = RigidModel { motion, inliers: Vec::new(), score: 0.0 };
        for i in 0..self.a.len() {
            let Some(part) = self.squared_residual(i, &motion) else { continue };
            if part <= 1.0 {
                model.inliers.push(self.usable[i]);
                model.score += f64::from(self.matches[self.usable[i]].weight) * (1.0 - part);
            }
        }
        model
    }

    /// The last word: enough inliers, spread over more than a line.
    fn accept(&self, model: RigidModel) -> Option<RigidModel> {
        if model.inliers.len() < self.options.min_inliers.max(3) {
            return None;
        }
        let points: Vec<Point3<f64>> =
            model.inliers.iter().map(|&i| Point3::from(self.matches[i].a.map(f64::from))).collect();
        let mut eigenvalues = covariance(&points).symmetric_eigenvalues();
        eigenvalues.as_mut_slice().sort_by(f64::total_cmp);
        (eigenvalues[1] > MIN_RELATIVE_WIDTH.powi(2) * eigenvalues[2]).then_some(model)
    }
}

/// Three different indices below `n >= 3`.
fn three_of(n: usize, rng: &mut Pcg64Mcg) -> [usize; 3] {
    let i = rng.random_range(0..n);
    let mut j = rng.random_range(0..n - 1);
    j += usize::from(j >= i);
    let mut k = rng.random_range(0..n - 2);
    let (low, high) = (i.min(j), i.max(j));
    k += usize::from(k >= low);
    k += usize::from(k >= high);
    [i, j, k]
}

fn covariance(points: &[Point3<f64>]) -> Matrix3<f64> {
    let n = points.len().max(1) as f64;
    let mean = points.iter().map(|p| p.coords).sum::<Vector3<f64>>() / n;
    points.iter().map(|p| (p.coords - mean) * (p.coords - mean).transpose()).sum::<Matrix3<f64>>() / n
}

/// Root mean square distance from the mean.
fn extent(points: &[Point3<f64>]) -> f64 {
    covariance(points).trace().max(0.0).sqrt()
}
