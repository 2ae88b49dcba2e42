//! Rigid transforms as plain `f32` arrays, for loops over points.

use nalgebra::Isometry3;

/// Rotation matrix (rows) and translation.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rigid {
    rows: [[f32; 3]; 3],
    shift: [f32; 3],
}

impl Rigid {
    pub(crate) fn new(pose: &Isometry3<f64>) -> Self {
        let m = pose.rotation.to_rotation_matrix();
        let m = m.matrix();
        let t = &pose.translation.vector;
        let row = |r: usize| [m[(r, 0)] as f32, m[(r, 1)] as f32, m[(r, 2)] as f32];
        Self { rows: [row(0), row(1), row(2)], shift: [t.x as f32, t.y as f32, t.z as f32] }
    }

    /// `R p + t`.
    #[inline(always)]
    pub(crate) fn point(&self, p: [f32; 3]) -> [f32; 3] {
        add(self.direction(p), self.shift)
    }

    /// `R d`.
    #[inline(always)]
    pub(crate) fn direction(&self, d: [f32; 3]) -> [f32; 3] {
        [dot(self.rows[0], d), dot(self.rows[1], d), dot(self.rows[2], d)]
    }

    /// `Rᵀ d`.
    #[inline(always)]
    pub(crate) fn direction_back(&self, d: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|k| self.rows[0][k] * d[0] + self.rows[1][k] * d[1] + self.rows[2][k] * d[2])
    }
}

#[inline(always)]
pub(crate) fn add(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

#[inline(always)]
pub(crate) fn sub(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
pub(crate) fn scale(a: [f32; 3], s: f32) -> [f32; 3] {
    [a[0] * s, a[1] * s, a[2] * s]
}

#[inline(always)]
pub(crate) fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
pub(crate) fn cross(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// The unit vector along `a`; `None` for a zero vector or NaN.
#[inline]
pub(crate) fn unit(a: [f32; 3]) -> Option<[f32; 3]> {
    let n = dot(a, a).sqrt();
    (n > 1e-20 && n.is_finite()).then(|| scale(a, 1.0 / n))
}
