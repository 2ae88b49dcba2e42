//! SDF term: signed distance of a frame's points to a frozen model (eq. `L_s`).

use nalgebra::{Isometry3, Matrix6, Vector6};

use crate::graph::{SdfModel, SdfTerm};
use crate::jacobian::{RowSums, direction_row, huber};
use crate::normal::{NormalEquations, Own};
use crate::observability::{Observability, noise_information};
use crate::options::SolveOptions;
use crate::stats::{Extent, Residuals};
use crate::transform::{Rigid, is_finite, narrow, widen};

/// Variance of a model's gradient in one tangential direction, radians squared: a model that was learnt from noisy
/// depth is off by some degrees.
const GRADIENT_VARIANCE: f64 = 0.004;

impl SdfTerm<'_> {
    /// Information about the node's pose that the term holds at `obj_from_cam`, as a [`PosePrior`](crate::PosePrior) has
    /// it: of `[rho; phi]`, units 1/m^2 and 1/rad^2. Zero where the model is unknown, and along motions of which noise in
    /// its gradients could as well give all the information: a can's turn.
    ///
    /// A model that was trained on this very frame repeats what it was told: its residuals, which are its errors, are no
    /// measurement of the pose, and frames that follow them drift together. The pose at which the training left the frame
    /// is one, and this is how much it weighs.
    ///
    /// How far the whole surface lies off along its normals is an unknown of its own that is eliminated: free space pushes
    /// a field inwards a little everywhere, and frames that follow it shrink the object, each a step towards its middle.
    pub fn information(&self, obj_from_cam: &Isometry3<f64>, options: &SolveOptions) -> Matrix6<f64> {
        let mut unary = SdfUnary::new(self, options);
        let (h, _, _) = unary.sums(obj_from_cam);
        let extent = Extent::of(unary.points.iter().copied()).moved(obj_from_cam);
        // An offset doesn't explain what noise in the gradients adds.
        let own = Own {
            information: (h - unary.of_offset()) * unary.scale,
            doubt: Matrix6::zeros(),
            noise: gradient_noise(&(h * unary.scale)),
        };
        let seen = Observability::new(self.node, &own, &extent);
        seen.map_or_else(Matrix6::zeros, |seen| seen.beyond_noise())
    }
}

/// Information that noise in gradients gives to motions along the surface, in a term whose Hessian is `h`.
fn gradient_noise(h: &Matrix6<f64>) -> f64 {
    noise_information(h[(0, 0)] + h[(1, 1)] + h[(2, 2)], GRADIENT_VARIANCE)
}

/// The usable points of one SDF term and the model's answers at the last pose asked.
pub(crate) struct SdfUnary<'a> {
    pub(crate) node: usize,
    model: &'a dyn SdfModel,
    points: Vec<[f32; 3]>,
    object: Vec<[f32; 3]>,
    sdf: Vec<f32>,
    gradient: Vec<[f32; 3]>,
    /// Loss of each point at the linearisation; NaN = not part of the current set.
    reference: Vec<f64>,
    evaluated_at: Option<Isometry3<f64>>,
    weight: f64,
    cap: f64,
    scale: f64,
    delta: f64,
}

impl<'a> SdfUnary<'a> {
    pub(crate) fn new(term: &SdfTerm<'a>, options: &SolveOptions) -> Self {
        let points: Vec<[f32; 3]> = term.points.iter().copied().filter(is_finite).collect();
        let n = points.len();
        Self {
            node: term.node,
            model: term.model,
            object: vec![[0.0; 3]; n],
            sdf: vec![f32::NAN; n],
            gradient: vec![[f32::NAN; 3]; n],
            reference: vec![f64::NAN; n],
            points,
            evaluated_at: None,
            weight: options.sdf_weight / (options.sdf_sigma * options.sdf_sigma),
            cap: options.sdf_cap,
            scale: 0.0,
            delta: options.sdf_huber,
        }
    }

    /// Asks the model, unless the pose is the one asked last (a step that was tried and then accepted).
    fn evaluate(&mut self, pose: &Isometry3<f64>) {
        if self.evaluated_at.as_ref() == Some(pose) {
            return;
        }
        let rigid = Rigid::<f64>::new(pose);
        for (x, &p) in self.object.iter_mut().zip(&self.points) {
            *x = narrow(rigid.point(p));
        }
        self.sdf.fill(f32::NAN);
        self.gradient.fill([f32::NAN; 3]);
        self.model.sdf_and_gradient(&self.object, &mut self.sdf, &mut self.gradient);
        self.evaluated_at = Some(*pose);
    }

    /// Cost over the current set. A point that leaves the model's domain keeps the loss it had, so that no step is
    /// accepted because it loses points.
    pub(crate) fn cost(&mut self, poses: &[Isometry3<f64>]) -> f64 {
        self.evaluate(&poses[self.node]);
        let mut sum = 0.0;
        for (&s, &reference) in self.sdf.iter().zip(&self.reference) {
            if reference.is_finite() {
                sum += if s.is_finite() { huber(f64::from(s).abs(), self.delta).0 } else { reference };
            }
        }
        self.scale * sum
    }

    pub(crate) fn linearise(&mut self, poses: &[Isometry3<f64>], normal: &mut NormalEquations) -> f64 {
        let (h, g, cost) = self.sums(&poses[self.node]);
        let h = h * self.scale;
        normal.add(self.node, &h, &(g * self.scale));
        normal.add_noise(self.node, gradient_noise(&h));
        self.scale * cost
    }

    /// Hessian, gradient and cost at a pose, all without the scale, which is set for them.
    fn sums(&mut self, pose: &Isometry3<f64>) -> (Matrix6<f64>, Vector6<f64>, f64) {
        self.evaluate(pose);
        let mut sums = RowSums::default();
        let (mut cost, mut count) = (0.0, 0usize);
        for (k, reference) in self.reference.iter_mut().enumerate() {
            *reference = f64::NAN;
            let (s, g) = (self.sdf[k], self.gradient[k]);
            if s.is_finite() && is_finite(&g) {
                let (rho, w) = huber(f64::from(s).abs(), self.delta);
                sums.add(&direction_row(widen(g), widen(self.object[k])), w, f64::from(s));
                *reference = rho;
                cost += rho;
                count += 1;
            }
        }
        self.scale = if count == 0 { 0.0 } else { self.weight * (self.cap / count as f64).min(1.0) };
        let (h, g) = sums.finish();
        (h, g, cost)
    }

    /// The part of the last Hessian that one distance added to all residuals could explain, without the scale.
    fn of_offset(&self) -> Matrix6<f64> {
        let (mut sums, mut weight) = (RowSums::default(), 0.0);
        for ((s, g), x) in self.sdf.iter().zip(&self.gradient).zip(&self.object) {
            if s.is_finite() && is_finite(g) {
                let (_, w) = huber(f64::from(*s).abs(), self.delta);
                sums.add(&direction_row(widen(*g), widen(*x)), w, 1.0);
                weight += w;
            }
        }
        let (_, row) = sums.finish();
        if weight > 0.0 { row * row.transpose() / weight } else { Matrix6::zeros() }
    }

    pub(crate) fn residuals(&mut self, poses: &[Isometry3<f64>], all: &mut Residuals) -> usize {
        self.evaluate(&poses[self.node]);
        self.sdf.iter().filter(|s| s.is_finite() && all.add(f64::from(**s), self.delta, 1.0)).count()
    }

    /// The points, in the camera's frame.
    pub(crate) fn points(&self) -> &[[f32; 3]] {
        &self.points
    }
}
