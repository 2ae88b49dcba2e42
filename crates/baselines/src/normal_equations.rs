//! Six-parameter least squares, accumulated row by row.

use nalgebra::{Matrix6, Vector6};

/// `Σ w JᵀJ` and `Σ w Jᵀr` of rows `r + J δ`, with the number of rows and `Σ w r²`.
#[derive(Clone, Debug, Default)]
pub(crate) struct NormalEquations {
    /// Upper triangle, row after row.
    hessian: [f64; 21],
    gradient: [f64; 6],
    pub(crate) count: usize,
    weight: f64,
    squares: f64,
}

impl NormalEquations {
    #[inline]
    pub(crate) fn add(&mut self, jacobian: [f32; 6], residual: f32, weight: f32) {
        let j = jacobian.map(f64::from);
        let (r, w) = (f64::from(residual), f64::from(weight));
        let mut at = 0;
        for a in 0..6 {
            let wj = w * j[a];
            self.gradient[a] += wj * r;
            for b in a..6 {
                self.hessian[at] += wj * j[b];
                at += 1;
            }
        }
        self.count += 1;
        self.weight += w;
        self.squares += w * r * r;
    }

    /// Weighted root mean square of the residuals; 0 without rows.
    pub(crate) fn rms(&self) -> f64 {
        if self.weight > 0.0 { (self.squares / self.weight).sqrt() } else { 0.0 }
    }

    /// The step `δ = [rho; phi]` to the minimum.
    ///
    /// `radius`: size of the object in metres, by which rotations and translations become comparable. Directions that
    /// the rows don't determine (the turn of a bottle about its axis) are damped: they follow
    /// the noise slowly. `None` without rows or for values that are not finite.
    pub(crate) fn solve(&self, radius: f64) -> Option<Vector6<f64>> {
        // A turn is damped more than a shift: a ball that moves has not rolled.
        const DAMPING: f64 = 1e-6;
        const TURN_DAMPING: f64 = 3e-3;
        if self.count < 6 || self.weight <= 0.0 {
            return None;
        }
        let mut at = 0;
        let mut h = Matrix6::zeros();
        for a in 0..6 {
            for b in a..6 {
                h[(a, b)] = self.hessian[at];
                h[(b, a)] = self.hessian[at];
                at += 1;
            }
        }
        for a in 0..3 {
            h[(a, a)] += DAMPING * self.weight;
            h[(a + 3, a + 3)] += TURN_DAMPING * self.weight * radius * radius;
        }
        let step = -h.cholesky()?.solve(&Vector6::from(self.gradient));
        step.iter().all(|v| v.is_finite()).then_some(step)
    }
}
