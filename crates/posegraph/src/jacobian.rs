//! Residuals, their Jacobians and the robust kernel. Everything the solver differentiates is here and is tested
//! against central differences below.
//!
//! With `T <- exp(delta) T` and `delta = [rho; phi]`, an object-frame point `X = T p` moves by `rho + phi x X`, so
//! `dX/ddelta = [I | -[X]x]`. Three consequences carry the solver:
//! - a feature residual `X_i - X_j` has Jacobians `[I | -[X_i]x]` and `-[I | -[X_j]x]`, up to the residual's order
//!   both at the point that the two measurements have in common ([`MatchSums`]);
//! - a scalar residual that changes with `X` along `d` (plane normal, SDF gradient) has the row `[d; X x d]`;
//! - rows built in a camera frame become object-frame rows by one adjoint per edge ([`lift`]).

#[cfg(test)]
use nalgebra::Vector3;
use nalgebra::{Isometry3, Matrix3, Matrix6, Vector6};

/// `[I | -[X]x]`, the derivative of the object-frame point `x` with respect to its node's twist.
#[cfg(test)]
pub(crate) fn point_jacobian(x: &Vector3<f64>) -> nalgebra::Matrix3x6<f64> {
    let mut j = nalgebra::Matrix3x6::zeros();
    j.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
    j.fixed_view_mut::<3, 3>(0, 3).copy_from(&-x.cross_matrix());
    j
}

/// `[d; x x d]`: derivative of a scalar that changes with the point `x` along `d`.
#[inline(always)]
pub(crate) fn direction_row(d: [f64; 3], x: [f64; 3]) -> [f64; 6] {
    [d[0], d[1], d[2], x[1] * d[2] - x[2] * d[1], x[2] * d[0] - x[0] * d[2], x[0] * d[1] - x[1] * d[0]]
}

/// Point-to-plane residual `n . (q - p)` and the row of its *target* node, all in one common frame; the source
/// node's row is the negative. `q`, `n`: point and normal of the target, `p`: transformed source point. The reference
/// for the single-precision sums of the dense term.
#[cfg(test)]
pub(crate) fn plane_residual(n: [f64; 3], q: [f64; 3], p: [f64; 3]) -> (f64, [f64; 6]) {
    let r = n[0] * (q[0] - p[0]) + n[1] * (q[1] - p[1]) + n[2] * (q[2] - p[2]);
    (r, direction_row(n, p))
}

/// `A` with `[R n; X x R n] = A [n; p x n]` for `X = R p + t`: takes rows from a camera to the object frame.
pub(crate) fn lift(obj_from_cam: &Isometry3<f64>) -> Matrix6<f64> {
    let rotation = *obj_from_cam.rotation.to_rotation_matrix().matrix();
    let mut a = Matrix6::zeros();
    a.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
    a.fixed_view_mut::<3, 3>(3, 0).copy_from(&(obj_from_cam.translation.vector.cross_matrix() * rotation));
    a.fixed_view_mut::<3, 3>(3, 3).copy_from(&rotation);
    a
}

/// Huber's loss of a residual of magnitude `e >= 0`: `(rho(e), rho'(e) / e)`.
#[inline(always)]
pub(crate) fn huber(e: f64, delta: f64) -> (f64, f64) {
    if e <= delta { (0.5 * e * e, 1.0) } else { (delta * (e - 0.5 * delta), delta / e) }
}

/// Weighted sums over scalar residuals with 6-vector rows: lower triangle of `J^T W J`, `J^T W r`.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct RowSums {
    pub(crate) h: [f64; 21],
    pub(crate) g: [f64; 6],
}

impl RowSums {
    /// Adds one residual `r` with row `j` and weight `w`.
    #[inline(always)]
    pub(crate) fn add(&mut self, j: &[f64; 6], w: f64, r: f64) {
        let mut k = 0;
        for a in 0..6 {
            let wa = w * j[a];
            for b in 0..=a {
                self.h[k] += wa * j[b];
                k += 1;
            }
            self.g[a] += wa * r;
        }
    }

    /// The sums as matrix and vector.
    pub(crate) fn finish(&self) -> (Matrix6<f64>, Vector6<f64>) {
        let mut h = Matrix6::zeros();
        let mut k = 0;
        for a in 0..6 {
            for b in 0..=a {
                h[(a, b)] = self.h[k];
                h[(b, a)] = self.h[k];
                k += 1;
            }
        }
        (h, Vector6::from(self.g))
    }
}

/// Blocks of a feature edge: sums over its matches of `[I | -[p]x]^T W [I | -[p]x]` and of `[I | -[p]x]^T W r`.
///
/// `p` is where the point of the match most likely is (see [`rays`](crate::rays)). With it the gradient is the exact one:
/// moving node i moves `x`, but turns its covariance `S_i`, too, and the two together are `p x W r`. The Hessian is
/// Gauss-Newton's up to the residual's order, in its favour: a motion of both nodes together costs nothing, as in the
/// objective itself.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct MatchSums {
    /// `W`, lower triangle.
    pub(crate) w: [f64; 6],
    /// `-W [p]x`, row by row.
    pub(crate) wp: [f64; 9],
    /// `-[p]x W [p]x`, lower triangle.
    pub(crate) pwp: [f64; 6],
    pub(crate) g: [f64; 6],
}

impl MatchSums {
    /// `H` and the gradient `g` of node i; the blocks are `H_ii = H_jj = -H_ij = H`, and the gradient of node j is `-g`.
    pub(crate) fn finish(&self) -> (Matrix6<f64>, Vector6<f64>) {
        let symmetric = |t: &[f64; 6]| Matrix3::new(t[0], t[1], t[3], t[1], t[2], t[4], t[3], t[4], t[5]);
        let wp = Matrix3::from_row_slice(&self.wp);
        let mut h = Matrix6::zeros();
        h.fixed_view_mut::<3, 3>(0, 0).copy_from(&symmetric(&self.w));
        h.fixed_view_mut::<3, 3>(0, 3).copy_from(&wp);
        h.fixed_view_mut::<3, 3>(3, 0).copy_from(&wp.transpose());
        h.fixed_view_mut::<3, 3>(3, 3).copy_from(&symmetric(&self.pwp));
        (h, Vector6::from(self.g))
    }
}

/// A match in double precision, written out from its definition: the reference for the sums of the feature term.
#[cfg(test)]
pub(crate) struct ExactMatch {
    pub(crate) r: Vector3<f64>,
    pub(crate) information: Matrix3<f64>,
    /// Where the point most likely is.
    pub(crate) point: Vector3<f64>,
}

#[cfg(test)]
impl ExactMatch {
    /// The points `p` and `q` of the cameras at `ti` and `tj`; `noise` is the angle and the two parts of the depth's.
    pub(crate) fn new(
        (ti, tj): (&Isometry3<f64>, &Isometry3<f64>),
        (p, q): (Vector3<f64>, Vector3<f64>),
        [angle, constant, quadratic]: [f64; 3],
    ) -> Self {
        let covariance = |t: &Isometry3<f64>, p: Vector3<f64>| {
            let ray = t.rotation * p.normalize();
            let across = (angle * p.norm()).powi(2);
            let along = (constant + quadratic * p.norm_squared()).powi(2);
            Matrix3::identity() * across + ray * ray.transpose() * (along - across)
        };
        let x = (ti * nalgebra::Point3::from(p)).coords;
        let r = x - (tj * nalgebra::Point3::from(q)).coords;
        let first = covariance(ti, p);
        let information = (first + covariance(tj, q)).try_inverse().unwrap_or_default();
        Self { r, information, point: x - first * information * r }
    }

    pub(crate) fn deviations(&self) -> f64 {
        self.r.dot(&(self.information * self.r)).sqrt()
    }

    /// Blocks `H` and `g` at a weight.
    pub(crate) fn blocks(&self, weight: f64) -> (Matrix6<f64>, Vector6<f64>) {
        let j = point_jacobian(&self.point);
        (j.transpose() * self.information * j * weight, j.transpose() * self.information * self.r * weight)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;
    use se3_lie::se3;

    use super::*;

    fn vector(rng: &mut Pcg64Mcg, scale: f64) -> Vector3<f64> {
        Vector3::from_fn(|_, _| rng.random_range(-scale..scale))
    }

    fn pose(rng: &mut Pcg64Mcg) -> Isometry3<f64> {
        let (t, r) = (vector(rng, 0.5), vector(rng, 2.0));
        se3::exp(&Vector6::new(t.x, t.y, t.z, r.x, r.y, r.z))
    }

    /// Central differences of `f` under left perturbation of `pose`.
    fn numeric(pose: &Isometry3<f64>, f: impl Fn(&Isometry3<f64>) -> DVector<f64>) -> DMatrix<f64> {
        let h = 1e-5;
        let columns: Vec<DVector<f64>> = (0..6)
            .map(|k| {
                let mut step = Vector6::zeros();
                step[k] = h;
                (f(&(se3::exp(&step) * pose)) - f(&(se3::exp(&-step) * pose))) / (2.0 * h)
            })
            .collect();
        DMatrix::from_columns(&columns)
    }

    #[track_caller]
    fn assert_close(analytic: &DMatrix<f64>, numeric: &DMatrix<f64>) {
        let error = (analytic - numeric).amax() / numeric.amax().max(1e-3);
        assert!(error < 1e-6, "relative error {error}\n{analytic}{numeric}");
    }

    fn dynamic(m: &nalgebra::Matrix3x6<f64>) -> DMatrix<f64> {
        DMatrix::from_fn(3, 6, |r, c| m[(r, c)])
    }

    #[test]
    fn feature_jacobians_match_differences_on_both_sides() {
        let mut rng = Pcg64Mcg::seed_from_u64(1);
        for _ in 0..20 {
            let (ti, tj, pi, pj) =
                (pose(&mut rng), pose(&mut rng), vector(&mut rng, 1.0), vector(&mut rng, 1.0));
            let residual = |ti: &Isometry3<f64>, tj: &Isometry3<f64>| {
                let r = ti.transform_point(&pi.into()) - tj.transform_point(&pj.into());
                DVector::from_column_slice(r.as_slice())
            };
            let xi = ti.transform_point(&pi.into()).coords;
            let xj = tj.transform_point(&pj.into()).coords;
            assert_close(&dynamic(&point_jacobian(&xi)), &numeric(&ti, |t| residual(t, &tj)));
            assert_close(&dynamic(&-point_jacobian(&xj)), &numeric(&tj, |t| residual(&ti, t)));
        }
    }

    #[test]
    fn plane_rows_match_differences_in_both_frames() {
        let mut rng = Pcg64Mcg::seed_from_u64(2);
        for _ in 0..20 {
            let (ts, tt) = (pose(&mut rng), pose(&mut rng));
            let (p, q) = (vector(&mut rng, 1.0), vector(&mut rng, 1.0));
            let n = vector(&mut rng, 1.0).normalize();
            let residual = |ts: &Isometry3<f64>, tt: &Isometry3<f64>| {
                let moved = tt.inverse() * ts * nalgebra::Point3::from(p);
                DVector::from_element(1, n.dot(&(q - moved.coords)))
            };
            let moved = (tt.inverse() * ts * nalgebra::Point3::from(p)).coords;
            let (r, row) = plane_residual(n.into(), q.into(), moved.into());
            assert!((r - residual(&ts, &tt)[0]).abs() < 1e-12);
            let target = (lift(&tt) * Vector6::from(row)).transpose();
            let target = DMatrix::from_fn(1, 6, |_, c| target[c]);
            assert_close(&target, &numeric(&tt, |t| residual(&ts, t)));
            assert_close(&-target, &numeric(&ts, |t| residual(t, &tt)));
        }
    }

    /// Signed distance and gradient of a sphere.
    fn sphere(x: &Vector3<f64>) -> (f64, Vector3<f64>) {
        (x.norm() - 0.1, x.normalize())
    }

    /// Signed distance and gradient of a box of half sizes 0.1, 0.2, 0.3 (outside its faces, edges and corners).
    fn cuboid(x: &Vector3<f64>) -> (f64, Vector3<f64>) {
        let q = x.abs() - Vector3::new(0.1, 0.2, 0.3);
        let outside = q.map(|c| c.max(0.0));
        if outside.norm() > 0.0 {
            (outside.norm(), outside.normalize().component_mul(&x.map(f64::signum)))
        } else {
            let axis = q.imax();
            let mut g = Vector3::zeros();
            g[axis] = x[axis].signum();
            (q[axis], g)
        }
    }

    #[test]
    fn sdf_rows_match_differences_on_sphere_and_box() {
        let mut rng = Pcg64Mcg::seed_from_u64(3);
        for _ in 0..20 {
            let (t, p) = (pose(&mut rng), vector(&mut rng, 0.6));
            for model in [sphere, cuboid] {
                let x = t.transform_point(&p.into()).coords;
                let row = direction_row(model(&x).1.into(), x.into());
                let row = DMatrix::from_row_slice(1, 6, &row);
                let residual = |t: &Isometry3<f64>| {
                    DVector::from_element(1, model(&t.transform_point(&p.into()).coords).0)
                };
                assert_close(&row, &numeric(&t, residual));
            }
        }
    }

    #[test]
    fn prior_jacobian_matches_differences() {
        let mut rng = Pcg64Mcg::seed_from_u64(4);
        for _ in 0..20 {
            let (t, prior) = (pose(&mut rng), pose(&mut rng));
            let residual =
                |t: &Isometry3<f64>| DVector::from_column_slice(se3::log(&(t * prior.inverse())).as_slice());
            let r = se3::log(&(t * prior.inverse()));
            if r.fixed_rows::<3>(3).norm() > 2.8 {
                continue; // the logarithm is not smooth at half a turn
            }
            let jacobian = se3::left_jacobian_inverse(&r);
            assert_close(&DMatrix::from_fn(6, 6, |a, b| jacobian[(a, b)]), &numeric(&t, residual));
        }
    }

    #[test]
    fn the_gradient_of_a_match_includes_the_turn_of_its_covariances() {
        let mut rng = Pcg64Mcg::seed_from_u64(5);
        let noise = [0.01, 0.03, 0.05];
        for _ in 0..20 {
            let (ti, tj) = (pose(&mut rng), pose(&mut rng));
            let (p, q) = (vector(&mut rng, 1.0), vector(&mut rng, 1.0));
            let cost = |ti: &Isometry3<f64>, tj: &Isometry3<f64>| {
                let e = ExactMatch::new((ti, tj), (p, q), noise).deviations();
                DVector::from_element(1, 0.5 * e * e)
            };
            let (_, g) = ExactMatch::new((&ti, &tj), (p, q), noise).blocks(1.0);
            let row = |g: Vector6<f64>| DMatrix::from_fn(1, 6, |_, c| g[c]);
            assert_close(&row(g), &numeric(&ti, |t| cost(t, &tj)));
            assert_close(&row(-g), &numeric(&tj, |t| cost(&ti, t)));
        }
    }

    #[test]
    fn row_sums_equal_outer_products() {
        let mut rng = Pcg64Mcg::seed_from_u64(6);
        let mut sums = RowSums::default();
        let (mut h, mut g) = (Matrix6::zeros(), Vector6::zeros());
        for _ in 0..30 {
            let j = Vector6::from_fn(|_, _| rng.random_range(-1.0..1.0));
            let (w, r) = (rng.random_range(0.1..2.0), rng.random_range(-1.0..1.0));
            sums.add(&j.into(), w, r);
            h += j * j.transpose() * w;
            g += j * (w * r);
        }
        let (got_h, got_g) = sums.finish();
        assert!((got_h - h).amax() < 1e-12 && (got_g - g).amax() < 1e-12);
    }

    #[test]
    fn huber_is_continuous_and_its_weight_is_its_slope() {
        let delta = 0.005;
        for e in [0.0, 0.001, 0.00499, 0.00501, 0.02, 1.0] {
            let (rho, w) = huber(e, delta);
            let h = 1e-7;
            let slope = (huber(e + h, delta).0 - huber((e - h).abs(), delta).0) / (2.0 * h);
            assert!((slope - w * e).abs() < 1e-7, "{e}: {slope} {}", w * e);
            assert!(rho <= 0.5 * e * e + 1e-15);
        }
        assert_eq!(huber(0.0, delta), (0.0, 1.0));
    }
}
