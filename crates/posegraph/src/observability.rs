//! What the measurements tell of a pose, direction by direction, and where it is held because they tell nothing.
//!
//! Noise in normals ties down every motion a little, also those along which a surface slides on itself (Gelfand and
//! Guibas, "Shape segmentation using local slippage analysis", 2004): where the true normals are at right angles to the
//! motion, the measured ones aren't. A direction is believed as far as its information, with matches as off together by a
//! few millimetres, exceeds what that noise gives;
//! for the rest the pose keeps to its prediction, as in Zhang, Kaess and Singh, "On degeneracy of optimization-based
//! state estimation problems" (ICRA 2016), but without a threshold at which it jumps.

use nalgebra::{Matrix3, Matrix6, SymmetricEigen, Vector3, Vector6};

use crate::normal::Own;
use crate::stats::Extent;

/// A direction with less than this times the information of noise alone counts as not observed at all, and one with
/// `OBSERVED` times as fully observed. Noise alone gives somewhat less than once: a point's way has a part along its
/// normal.
const UNOBSERVED: f64 = 1.0;
const OBSERVED: f64 = 1.5;
/// Least noise of a normal, as a variance (radians squared): sampling alone turns it that much.
const LEAST_VARIANCE: f64 = 3e-4;
/// How far the matches of a pair of views may be off together, metres: on a plain surface they follow its outline and its
/// shading instead of the surface. That is no matter for a pose that other things hold, but the turn of a can without print
/// must not be taken from it.
const MATCHES_OFF: f64 = 0.002;
/// Share of the data in a direction that is not observed at all: what is left is numerically nothing.
const LEAST_SHARE: f64 = 0.01;
/// Below this share of the largest information a direction is not observed, noise or not.
const SINGULAR: f64 = 1e-6;

/// One motion of the object, and what the measurements tell of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Direction {
    /// Object-frame twist `[rho; phi]`, such that a typical point of what the node sees moves by one metre.
    pub twist: Vector6<f64>,
    /// Information, 1/m^2, on the way of a typical point; its inverse root is the standard deviation in metres.
    pub information: f64,
    /// How far that is believed, 0 to 1: it exceeds what noisy normals pretend of a surface that slides along itself.
    pub observed: f64,
}

impl Direction {
    /// Whether noise could as well have given all of the information.
    pub fn is_held(&self) -> bool {
        self.observed < 0.5
    }
}

/// How well one node's pose is observed, the other nodes given: six motions, least observed first. They are at right
/// angles to each other where length is the way of a typical point.
#[derive(Debug, Clone, PartialEq)]
pub struct Observability {
    /// The node.
    pub node: usize,
    /// Centre of what the node sees, object frame, metres; where motions are not observed, a point of their axis.
    pub centre: Vector3<f64>,
    /// Root mean square distance of what it sees from the centre, metres: the arm by which angles count as ways.
    pub radius: f64,
    /// The motions.
    pub directions: [Direction; 6],
    /// Information that noise gives.
    floor: f64,
    /// Information on the twist.
    whole: Matrix6<f64>,
}

impl Observability {
    /// The motions that are not observed: along these the node was held at its prediction.
    pub fn held(&self) -> impl Iterator<Item = &Direction> {
        self.directions.iter().filter(|d| d.is_held())
    }

    /// Covariance of the object-frame twist `[rho; phi]`, metres and radians. A motion that is not observed has the
    /// standard deviation that any pose has: a typical point may be anywhere on the object.
    pub fn covariance(&self) -> Matrix6<f64> {
        if self.directions.iter().all(|d| d.observed == 1.0)
            && let Some(covariance) = self.whole.try_inverse()
        {
            return covariance;
        }
        let anywhere = 2.0 * self.radius;
        let part = |d: &Direction| {
            let variance = (d.information * d.observed).recip().min(anywhere * anywhere);
            d.twist * d.twist.transpose() * variance
        };
        self.directions.iter().map(part).sum()
    }

    /// From what the measurements tell of the node's object-frame twist.
    pub(crate) fn new(node: usize, own: &Own, extent: &Extent) -> Option<Self> {
        let seen = Self::about(node, own, extent)?;
        match seen.axis_offset() {
            Some(offset) => {
                let radius = extent.arm().hypot(offset.norm());
                let about_axis = Extent { centre: extent.centre + offset, radius };
                Self::about(node, own, &about_axis)
            }
            None => Some(seen),
        }
    }

    fn about(node: usize, own: &Own, extent: &Extent) -> Option<Self> {
        let basis = extent.basis();
        let believed = basis.transpose() * (own.information - own.doubt) * basis;
        if believed.iter().any(|x| !x.is_finite()) || !own.noise.is_finite() {
            return None;
        }
        let eigen = SymmetricEigen::new((believed + believed.transpose()) * 0.5);
        let largest = eigen.eigenvalues.max().max(0.0);
        let floor = own.noise.max(SINGULAR * largest);
        let mut directions = [0, 1, 2, 3, 4, 5].map(|k| {
            let observed = share(eigen.eigenvalues[k].max(0.0), floor);
            let twist = basis * eigen.eigenvectors.column(k);
            Direction { twist, information: twist.dot(&(own.information * twist)).max(0.0), observed }
        });
        let least_first = |a: &Direction, b: &Direction| {
            a.observed.total_cmp(&b.observed).then(a.information.total_cmp(&b.information))
        };
        directions.sort_by(least_first);
        let whole = own.information;
        Some(Self { node, centre: extent.centre, radius: extent.arm(), directions, floor, whole })
    }

    /// From the centre to where the loose motions are pure turns: a point of the can's axis, the ball's centre. Only
    /// there a shift has no part in the turn that is held; about the middle of the visible front, a can that is shifted
    /// would be thought to roll, because that moves its front less.
    fn axis_offset(&self) -> Option<Vector3<f64>> {
        /// Least turn that has an axis, against the regularisation.
        const EPSILON: f64 = 1e-3;
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        let mut weights = 0.0;
        for direction in &self.directions {
            let weight = 1.0 - direction.observed;
            let (rho, phi): (Vector3<f64>, Vector3<f64>) =
                (direction.twist.fixed_rows::<3>(0).into(), direction.twist.fixed_rows::<3>(3).into());
            let cross = phi.cross_matrix();
            normal += cross.transpose() * cross * weight;
            right -= cross.transpose() * (rho + phi.cross(&self.centre)) * weight;
            weights += weight;
        }
        normal += Matrix3::identity() * (EPSILON * normal.trace());
        let offset = normal.try_inverse().filter(|_| weights > 0.0)? * right;
        let longest = 2.0 * self.radius;
        let length = offset.norm();
        length.is_finite().then(|| offset * (longest / length.max(longest)))
    }

    /// The information on the twist that exceeds what noise gives.
    pub(crate) fn beyond_noise(&self) -> Matrix6<f64> {
        let inverse = Extent { centre: self.centre, radius: self.radius }.inverse_basis();
        let part = |d: &Direction| {
            let along = inverse.transpose() * (inverse * d.twist);
            along * along.transpose() * (d.information - self.floor).max(0.0)
        };
        self.directions.iter().map(part).sum()
    }

    /// Information of a prior on the twist that makes the data count as far as it is believed; `None` if all is.
    pub(crate) fn hold(&self) -> Option<Matrix6<f64>> {
        let inverse = Extent { centre: self.centre, radius: self.radius }.inverse_basis();
        let part = |d: &Direction| {
            // (1 - share) / share times the data's own.
            let stiffness = d.information.max(self.floor) * (1.0 / d.observed - 1.0);
            let along = inverse.transpose() * (inverse * d.twist);
            along * along.transpose() * stiffness
        };
        let loose = self.directions.iter().filter(|d| d.observed < 1.0);
        let sum: Matrix6<f64> = loose.map(part).sum();
        (sum.amax() > 0.0).then_some(sum)
    }
}

/// Whether every direction has so much more information than noise that nothing needs to be held.
pub(crate) fn is_fully_observed(own: &Own, extent: &Extent) -> bool {
    let basis = extent.basis();
    let scaled = basis.transpose() * (own.information - own.doubt) * basis;
    let floor = OBSERVED * own.noise.max(SINGULAR * scaled.diagonal().amax());
    (scaled - Matrix6::identity() * floor).cholesky().is_some()
}

/// Share of the information of matches with this variance across the rays that doesn't tell whether a motion is seen.
pub(crate) fn match_doubt(variance: f64) -> f64 {
    MATCHES_OFF.powi(2) / (variance + MATCHES_OFF.powi(2))
}

/// Information per squared way of a typical point that normals whose variance per tangential direction is `variance`
/// give to motions along the surface, when the residuals' weights sum to `weight`.
pub(crate) fn noise_information(weight: f64, variance: f64) -> f64 {
    weight * variance.max(LEAST_VARIANCE)
}

fn share(information: f64, noise: f64) -> f64 {
    if noise > 0.0 {
        ((information / noise - UNOBSERVED) / (OBSERVED - UNOBSERVED)).clamp(LEAST_SHARE, 1.0)
    } else {
        LEAST_SHARE
    }
}
