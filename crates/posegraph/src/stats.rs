//! Running summaries of residuals and of the points they come from.

use nalgebra::{Matrix6, Vector3};

use crate::jacobian::huber;

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

    /// 0 if there was none.
    pub(crate) fn rms(&self) -> f64 {
        if self.weight > 0.0 { (self.squares / self.weight).sqrt() } else { 0.0 }
    }
}

/// Centre and radius of a cloud.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Extent {
    count: f64,
    sum: [f64; 3],
    squares: f64,
}

impl Extent {
    pub(crate) fn add(&mut self, x: [f64; 3]) {
        self.count += 1.0;
        for k in 0..3 {
            self.sum[k] += x[k];
            self.squares += x[k] * x[k];
        }
    }

    /// Rewrites an information matrix of an object-frame twist for the twist `[v; l phi]` at the cloud's centre, `l`
    /// its RMS radius. All its eigenvalues are then in 1/m^2: information per squared motion of a typical point.
    pub(crate) fn at_centre(&self, information: &Matrix6<f64>) -> Matrix6<f64> {
        let n = self.count.max(1.0);
        let centre = Vector3::from(self.sum) / n;
        let variance = self.squares / n - centre.norm_squared();
        let radius = if variance > 1e-12 { variance.sqrt() } else { 0.1 };
        // rho = v + centre x phi.
        let mut b = Matrix6::identity();
        b.fixed_view_mut::<3, 3>(0, 3).copy_from(&(centre.cross_matrix() / radius));
        for k in 3..6 {
            b[(k, k)] = 1.0 / radius;
        }
        b.transpose() * information * b
    }
}
