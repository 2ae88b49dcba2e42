//! Rigid transforms as plain arrays, for loops over points.

use std::ops::{Add, Mul};

use nalgebra::Isometry3;

/// Rotation matrix (row-major) and translation, in `f64` for residuals or `f32` for searches.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rigid<T = f64> {
    pub(crate) r: [T; 9],
    pub(crate) t: [T; 3],
}

impl Rigid<f64> {
    pub(crate) fn new(pose: &Isometry3<f64>) -> Self {
        let m = pose.rotation.to_rotation_matrix();
        let m = m.matrix();
        let t = &pose.translation.vector;
        Self { r: std::array::from_fn(|k| m[(k / 3, k % 3)]), t: [t.x, t.y, t.z] }
    }
}

impl Rigid<f32> {
    pub(crate) fn new(pose: &Isometry3<f64>) -> Self {
        let exact = Rigid::<f64>::new(pose);
        Self { r: exact.r.map(|x| x as f32), t: exact.t.map(|x| x as f32) }
    }
}

impl<T: Copy + Add<Output = T> + Mul<Output = T> + From<f32>> Rigid<T> {
    /// `R p + t`.
    #[inline(always)]
    pub(crate) fn point(&self, p: [f32; 3]) -> [T; 3] {
        let d = self.direction(p);
        [d[0] + self.t[0], d[1] + self.t[1], d[2] + self.t[2]]
    }

    /// `R d`.
    #[inline(always)]
    pub(crate) fn direction(&self, d: [f32; 3]) -> [T; 3] {
        let [x, y, z] = d.map(T::from);
        let r = &self.r;
        [r[0] * x + r[1] * y + r[2] * z, r[3] * x + r[4] * y + r[5] * z, r[6] * x + r[7] * y + r[8] * z]
    }
}

#[inline(always)]
pub(crate) fn widen(p: [f32; 3]) -> [f64; 3] {
    p.map(f64::from)
}

#[inline(always)]
pub(crate) fn narrow(p: [f64; 3]) -> [f32; 3] {
    p.map(|x| x as f32)
}

pub(crate) fn is_finite(p: &[f32; 3]) -> bool {
    p.iter().all(|x| x.is_finite())
}
