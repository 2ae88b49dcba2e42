//! Running summaries of residuals and of the points they come from.

use nalgebra::{Isometry3, Matrix6, Point3, Vector3};

use crate::jacobian::huber;
use crate::lanes;
use crate::simd::Vector;

/// Robustly weighted root mean square.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Residuals {
    weight: f64,
    squares: f64,
}

impl Residuals {
    /// Adds a residual; true if it lies in the quadratic zone of the loss.
    pub(crate) fn add(&mut self, e: f64, delta: f64, weight: f64) -> bool {
        let w = weight * huber(e.abs(), delta).1;
        if w.is_finite() && e.is_finite() {
            self.weight += w;
            self.squares += w * e * e;
        }
        e.abs() <= delta
    }

    /// Adds the residuals of an edge; returns how many lie in the quadratic zone of the loss.
    pub(crate) fn add_edge(&mut self, tally: &Tally) -> usize {
        if tally.weight.is_finite() && tally.squares.is_finite() {
            self.weight += tally.weight;
            self.squares += tally.squares;
        }
        tally.inliers as usize
    }

    /// 0 if there was none.
    pub(crate) fn rms(&self) -> f64 {
        if self.weight > 0.0 { (self.squares / self.weight).sqrt() } else { 0.0 }
    }
}

/// The residuals of one edge: sums of robust weights and of weighted squares, and how many matches lie in the quadratic
/// zone of the loss.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Tally {
    pub(crate) weight: f64,
    pub(crate) squares: f64,
    pub(crate) inliers: f64,
}

/// The sums of a few blocks on their way to a [`Tally`].
pub(crate) struct Sums<V> {
    weight: V,
    squares: V,
    inliers: V,
}

impl<V: Vector> Default for Sums<V> {
    #[inline(always)]
    fn default() -> Self {
        let zero = V::splat(0.0);
        Self { weight: zero, squares: zero, inliers: zero }
    }
}

impl<V: Vector> Sums<V> {
    /// Adds eight residuals `e >= 0`; a lane without a match has no weight.
    #[inline(always)]
    pub(crate) fn add(&mut self, e: V, weight: V, delta: V) {
        self.add_robust(e, weight, lanes::huber(e, weight, delta).1, delta);
    }

    /// The same where `weight` has been made robust already, to `w`.
    #[inline(always)]
    pub(crate) fn add_robust(&mut self, e: V, weight: V, w: V, delta: V) {
        let (zero, one) = (V::splat(0.0), V::splat(1.0));
        self.weight = self.weight + w;
        self.squares = self.squares + w * e * e;
        self.inliers = self.inliers + V::if_at_most(e, delta, V::if_less(zero, weight, one, zero), zero);
    }

    #[inline(always)]
    pub(crate) fn add_to(&self, tally: &mut Tally) {
        tally.weight += self.weight.total();
        tally.squares += self.squares.total();
        tally.inliers += self.inliers.total();
    }
}

/// Centre and size of a cloud.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Extent {
    pub(crate) centre: Vector3<f64>,
    /// Root mean square distance from the centre, metres.
    pub(crate) radius: f64,
}

impl Extent {
    pub(crate) fn of(points: impl Iterator<Item = [f32; 3]>) -> Self {
        let (mut count, mut sum, mut squares) = (0.0, Vector3::zeros(), 0.0);
        for point in points {
            let point = Vector3::from(point).cast::<f64>();
            count += 1.0;
            sum += point;
            squares += point.norm_squared();
        }
        let centre = sum / f64::max(count, 1.0);
        let variance = squares / f64::max(count, 1.0) - centre.norm_squared();
        Self { centre, radius: variance.max(0.0).sqrt() }
    }

    /// The arm by which angles count as ways.
    pub(crate) fn arm(&self) -> f64 {
        if self.radius > 1e-6 { self.radius } else { 0.1 }
    }

    /// The same cloud in the frame that `pose` leads to.
    pub(crate) fn moved(&self, pose: &Isometry3<f64>) -> Self {
        Self { centre: (pose * Point3::from(self.centre)).coords, ..*self }
    }

    /// `B` of `[rho; phi] = B [v; arm phi]`, where `v` is the velocity of the centre: in `[v; arm phi]` a unit moves a
    /// typical point by one metre whatever the direction.
    pub(crate) fn basis(&self) -> Matrix6<f64> {
        let mut b = Matrix6::identity();
        b.fixed_view_mut::<3, 3>(0, 3).copy_from(&(self.centre.cross_matrix() / self.arm()));
        (3..6).for_each(|k| b[(k, k)] = 1.0 / self.arm());
        b
    }

    /// `B^-1`.
    pub(crate) fn inverse_basis(&self) -> Matrix6<f64> {
        let mut b = Matrix6::identity();
        b.fixed_view_mut::<3, 3>(0, 3).copy_from(&-self.centre.cross_matrix());
        (3..6).for_each(|k| b[(k, k)] = self.arm());
        b
    }
}
