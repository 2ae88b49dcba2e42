//! Elementary functions that compilers can vectorise: the standard ones are calls.

use nalgebra::Isometry3;

/// `exp(x)` for `x <= 0`, to a relative error below 1e-5; 0 far below.
#[inline]
pub(crate) fn exp_negative(x: f32) -> f32 {
    // 2^k 2^f with k an integer and |f| <= 1/2: adding the constant rounds to it.
    const ROUND: f32 = 12_582_912.0;
    let t = (x * std::f32::consts::LOG2_E).max(-120.0);
    let rounded = t + ROUND;
    let f = (t - (rounded - ROUND)) * std::f32::consts::LN_2;
    let power = f32::from_bits(rounded.to_bits().wrapping_shl(23).wrapping_add(1.0f32.to_bits()));
    power * (1.0 + f * (1.0 + f * (0.5 + f * (1.0 / 6.0 + f * (1.0 / 24.0 + f / 120.0)))))
}

/// `ln(x)` for normal positive `x`, to an error below 2e-6.
#[inline]
pub(crate) fn ln_positive(x: f32) -> f32 {
    // x = 2^k m with m between the square roots of 1/2 and 2.
    const SQRT_HALF: u32 = 0x3f35_04f3;
    let k = x.to_bits().wrapping_sub(SQRT_HALF) as i32 >> 23;
    let m = f32::from_bits(x.to_bits().wrapping_sub((k << 23) as u32));
    let s = (m - 1.0) / (m + 1.0);
    let s2 = s * s;
    // 2 artanh(s)
    let series = 2.0 * s * (1.0 + s2 * (1.0 / 3.0 + s2 * (0.2 + s2 * (1.0 / 7.0 + s2 / 9.0))));
    k as f32 * std::f32::consts::LN_2 + series
}

/// The largest integer that isn't larger; a truncation and a comparison where `floor` is a call.
#[inline]
pub(crate) fn floor(v: f32) -> i32 {
    let t = v as i32;
    t.saturating_sub(i32::from(t as f32 > v))
}

/// A rigid motion as a matrix, which moves a point with a third of the arithmetic of a quaternion.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rigid {
    /// Rotation, then translation.
    pub(crate) rows: [[f32; 4]; 3],
}

impl Rigid {
    pub(crate) fn new(motion: &Isometry3<f32>) -> Self {
        let m = motion.to_homogeneous();
        Self { rows: std::array::from_fn(|r| std::array::from_fn(|c| m[(r, c)])) }
    }

    #[inline]
    pub(crate) fn apply(&self, p: [f32; 3]) -> [f32; 3] {
        self.rows.map(|r| r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + r[3])
    }

    /// The motion of a direction.
    #[inline]
    pub(crate) fn rotate(&self, d: [f32; 3]) -> [f32; 3] {
        self.rows.map(|r| r[0] * d[0] + r[1] * d[1] + r[2] * d[2])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn elementary_functions_agree_with_the_standard_ones() {
        for k in 0..20_000 {
            let x = -0.004 * k as f32;
            let (a, b) = (exp_negative(x), x.exp());
            assert!((a - b).abs() <= 1e-5 * b + 1e-30, "exp {x}: {a} {b}");
            let x = (1.0 + k as f32 * 0.37) * 1e-4;
            let (a, b) = (ln_positive(x), x.ln());
            assert!((a - b).abs() < 2e-6 + 2e-7 * b.abs(), "ln {x}: {a} {b}");
        }
        for v in [-2.0, -1.5, -0.0, 0.0, 0.99, 7.0, -1e12, 1e12, f32::NAN] {
            let expected = v.floor() as i32;
            assert!((i64::from(floor(v)) - i64::from(expected)).abs() <= i64::from(v == -1e12), "{v}");
        }
    }

    #[test]
    fn a_matrix_moves_like_the_motion_that_it_was_made_from() {
        let motion = Isometry3::new([0.1, -0.2, 0.3].into(), [0.4, 0.5, -0.6].into());
        let p = [0.7, 0.8, 0.9];
        let expected = motion * nalgebra::Point3::from(p);
        let (moved, turned) = (Rigid::new(&motion).apply(p), Rigid::new(&motion).rotate(p));
        let direction = motion * nalgebra::Vector3::from(p);
        for k in 0..3 {
            assert!((moved[k] - expected[k]).abs() < 1e-6 && (turned[k] - direction[k]).abs() < 1e-6);
        }
    }
}
