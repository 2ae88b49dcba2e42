//! The residual of a relative-pose measurement and its derivatives under right perturbation.
//!
//! With `r = log(Z^-1 T_i^-1 T_j)` and `T <- T exp(delta)`:
//! `dr/d delta_j = J_r^-1(r)`, and, since `exp(-d) X = X exp(-Ad(X^-1) d)`, `dr/d delta_i = -J_r^-1(r) Ad(T_j^-1 T_i)`
//! (Barfoot, *State Estimation for Robotics*, 2nd ed., section 8.1.5).

use nalgebra::{Isometry3, Matrix6, Vector6};
use se3_lie::se3;

use super::graph::RelativePose;

/// `log(Z^-1 T_from^-1 T_to)`.
#[inline]
fn residual(edge: &RelativePose, from: &Isometry3<f64>, to: &Isometry3<f64>) -> Vector6<f64> {
    se3::log(&edge.from_from_to.inv_mul(&from.inv_mul(to)))
}

/// `r^T information r`.
#[inline]
pub(super) fn squared_error(edge: &RelativePose, from: &Isometry3<f64>, to: &Isometry3<f64>) -> f64 {
    let r = residual(edge, from, to);
    r.dot(&(edge.information * r))
}

/// Everything an edge adds to the normal equations, for loss weight 1.
pub(super) struct Linearisation {
    /// `r^T information r`.
    pub(super) squared: f64,
    /// Own block of `from`.
    pub(super) h_from: Matrix6<f64>,
    /// Own block of `to`.
    pub(super) h_to: Matrix6<f64>,
    /// `J_from^T information J_to`.
    pub(super) h_cross: Matrix6<f64>,
    pub(super) g_from: Vector6<f64>,
    pub(super) g_to: Vector6<f64>,
}

pub(super) fn linearise(edge: &RelativePose, from: &Isometry3<f64>, to: &Isometry3<f64>) -> Linearisation {
    let r = residual(edge, from, to);
    let j_to = se3::right_jacobian_inverse(&r);
    // J_from = -J_to A: every block of `from` follows from those of `to`.
    let a = se3::adjoint(&to.inv_mul(from));
    let information_r = edge.information * r;
    let h_to = j_to.tr_mul(&(edge.information * j_to));
    let h_cross = -a.tr_mul(&h_to);
    let g_to = j_to.tr_mul(&information_r);
    Linearisation {
        squared: r.dot(&information_r),
        h_from: -(h_cross * a),
        h_to,
        h_cross,
        g_from: -a.tr_mul(&g_to),
        g_to,
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;

    fn twist(rng: &mut Pcg64Mcg, scale: f64) -> Vector6<f64> {
        Vector6::from_fn(|_, _| rng.random_range(-scale..scale))
    }

    #[test]
    fn blocks_are_those_of_jacobians_by_central_differences() {
        let mut rng = Pcg64Mcg::seed_from_u64(1);
        for _ in 0..20 {
            // Poses kilometres out: the blocks must not care.
            let offset = Isometry3::translation(3000.0, -2000.0, 50.0);
            let from = offset * se3::exp(&twist(&mut rng, 1.5));
            let to = from * se3::exp(&twist(&mut rng, 1.0));
            let noise = se3::exp(&twist(&mut rng, 0.5));
            let root = Matrix6::from_fn(|_, _| rng.random_range(-1.0..1.0));
            let edge = RelativePose::new(0, 1, from.inverse() * to * noise, root.transpose() * root);
            let h = 1e-5;
            let column = |k: usize, first: bool| {
                let at = |sign: f64| {
                    let mut step = Vector6::zeros();
                    step[k] = sign * h;
                    let step = se3::exp(&step);
                    if first {
                        residual(&edge, &(from * step), &to)
                    } else {
                        residual(&edge, &from, &(to * step))
                    }
                };
                (at(1.0) - at(-1.0)) / (2.0 * h)
            };
            let jacobian = |first: bool| {
                let mut j = Matrix6::zeros();
                (0..6).for_each(|k| j.set_column(k, &column(k, first)));
                j
            };
            let (ji, jj) = (jacobian(true), jacobian(false));
            let r = residual(&edge, &from, &to);
            let l = linearise(&edge, &from, &to);
            let w = edge.information;
            for (got, expected) in [
                (l.h_from, ji.transpose() * w * ji),
                (l.h_to, jj.transpose() * w * jj),
                (l.h_cross, ji.transpose() * w * jj),
            ] {
                assert!((got - expected).amax() < 1e-6 * (1.0 + expected.amax()), "{got}{expected}");
            }
            for (got, expected) in [(l.g_from, ji.transpose() * w * r), (l.g_to, jj.transpose() * w * r)] {
                assert!((got - expected).amax() < 1e-6 * (1.0 + expected.amax()), "{got}{expected}");
            }
            assert!((l.squared - r.dot(&(w * r))).abs() < 1e-12 * (1.0 + l.squared));
        }
    }
}
