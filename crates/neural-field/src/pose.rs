//! Bounded pose corrections: six numbers per frame behind a tanh, as left perturbations about the volume's centre.

use crate::real::Real;
use crate::tile::RayPose;
use nalgebra::{Isometry3, Matrix3, Translation3, Vector3, Vector6};
use se3_lie::se3;

/// The trainable corrections of one round: `T' = exp(tanh(theta) * bounds) T`, in units of the volume's edge about
/// its centre.
///
/// The first frame is the anchor, but it moves like the others while the field is trained: if it were held, all other
/// frames with the field they agree on would have to move towards it, which is slow. Afterwards the whole
/// arrangement is moved back so that the first frame is where it was.
#[derive(Clone, Debug)]
pub(crate) struct PoseCorrections {
    /// `obj_from_cam` in metres, as given.
    initial: Vec<Isometry3<f64>>,
    center: Translation3<f64>,
    edge: f64,
    pub(crate) bounds: Vector6<f64>,
    pub(crate) theta: Vec<Vector6<f64>>,
    moments: Vec<[Vector6<f64>; 2]>,
}

impl PoseCorrections {
    pub(crate) fn new(
        initial: &[Isometry3<f64>],
        center: [f64; 3],
        edge: f64,
        max_translation: f64,
        max_rotation: f64,
    ) -> Self {
        let (t, r) = (max_translation / edge, max_rotation);
        Self {
            initial: initial.to_vec(),
            center: Translation3::from(Vector3::from(center)),
            edge,
            bounds: Vector6::new(t, t, t, r, r, r),
            theta: vec![Vector6::zeros(); initial.len()],
            moments: vec![[Vector6::zeros(); 2]; initial.len()],
        }
    }

    fn xi(&self, frame: usize) -> Vector6<f64> {
        self.theta[frame].map(f64::tanh).component_mul(&self.bounds)
    }

    /// The corrected pose in edges about the centre.
    fn scaled(&self, frame: usize) -> Isometry3<f64> {
        let mut pose = self.center.inverse() * self.initial[frame];
        pose.translation.vector /= self.edge;
        se3::exp(&self.xi(frame)) * pose
    }

    /// What the training step reads.
    pub(crate) fn ray_poses<R: Real>(&self) -> Vec<RayPose<R>> {
        (0..self.initial.len())
            .map(|f| {
                let pose = self.scaled(f);
                let r: Matrix3<f64> = *pose.rotation.to_rotation_matrix().matrix();
                let t = pose.translation.vector;
                RayPose {
                    rotation: std::array::from_fn(|i| std::array::from_fn(|j| R::of(r[(i, j)]))),
                    translation: std::array::from_fn(|i| R::of(t[i])),
                }
            })
            .collect()
    }

    /// The corrected pose in the frame in which the field was trained, metres.
    fn trained(&self, frame: usize) -> Isometry3<f64> {
        let mut pose = self.scaled(frame);
        pose.translation.vector *= self.edge;
        self.center * pose
    }

    /// The motion that takes the object frame to the frame in which the field was trained: what the first frame's
    /// own correction amounts to.
    pub(crate) fn field_from_obj(&self) -> Isometry3<f64> {
        match self.theta.first() {
            Some(t) if *t != Vector6::zeros() => self.trained(0) * self.initial[0].inverse(),
            _ => Isometry3::identity(),
        }
    }

    /// Corrected `obj_from_cam` in metres; the first is bit-identical to the one given, and so are all
    /// when none was moved.
    pub(crate) fn poses(&self) -> Vec<Isometry3<f64>> {
        if self.theta.iter().all(|t| *t == Vector6::zeros()) {
            return self.initial.clone();
        }
        let obj_from_field = self.field_from_obj().inverse();
        (0..self.initial.len())
            .map(|f| if f == 0 { self.initial[0] } else { obj_from_field * self.trained(f) })
            .collect()
    }

    /// Gradient by `theta` from the gradient by a left perturbation of the corrected pose.
    pub(crate) fn theta_gradient(&self, frame: usize, twist: &Vector6<f64>) -> Vector6<f64> {
        let by_xi = se3::left_jacobian(&self.xi(frame)).transpose() * twist;
        let slope = self.theta[frame].map(|t| 1.0 - t.tanh().powi(2)).component_mul(&self.bounds);
        by_xi.component_mul(&slope)
    }

    /// One Adam update of every frame; `iteration` counts from 1.
    pub(crate) fn step(&mut self, twists: &[Vector6<f64>], rate: f64, iteration: usize) {
        let (b1, b2) = (0.9f64, 0.999f64);
        let (c1, c2) = (1.0 - b1.powf(iteration as f64), 1.0 - b2.powf(iteration as f64));
        for f in 0..self.theta.len() {
            let g = self.theta_gradient(f, &twists[f]);
            if !g.iter().all(|v| v.is_finite()) {
                continue;
            }
            let [m, v] = &mut self.moments[f];
            *m = *m * b1 + g * (1.0 - b1);
            *v = *v * b2 + g.component_mul(&g) * (1.0 - b2);
            let step = m.zip_map(v, |m, v| rate * (m / c1) / ((v / c2).sqrt() + 1e-15));
            self.theta[f] -= step;
        }
    }
}
