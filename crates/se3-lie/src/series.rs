//! The scalar coefficients of the closed-form Jacobians, as functions of the squared angle.
//!
//! Each is a quotient that cancels near zero; below [`BLEND`] the Taylor series is used, with enough terms to
//! be exact to f64 rounding there.

use nalgebra::{RealField, convert};

/// Squared angle below which the series are used (1 rad²).
const BLEND: f64 = 1.0;

/// Horner evaluation of `Σ c[k] x^k`.
fn polynomial<T: RealField + Copy>(x: T, c: &[f64]) -> T {
    c.iter().rev().fold(T::zero(), |sum, &ck| sum * x + convert(ck))
}

fn is_small<T: RealField + Copy>(theta2: T) -> bool {
    theta2 < convert(BLEND)
}

/// `sin(θ/2)/θ`, the factor between a rotation vector and the vector part of its quaternion.
pub(crate) fn half_sinc<T: RealField + Copy>(theta2: T) -> T {
    // sin(h)/(2h) with h = θ/2.
    const C: [f64; 8] = [
        0.5,
        -0.5 / 6.0,
        0.5 / 120.0,
        -0.5 / 5_040.0,
        0.5 / 362_880.0,
        -0.5 / 39_916_800.0,
        0.5 / 6_227_020_800.0,
        -0.5 / 1_307_674_368_000.0,
    ];
    if is_small(theta2) {
        return polynomial(theta2 * convert(0.25), &C);
    }
    let theta = theta2.sqrt();
    (theta * convert(0.5)).sin() / theta
}

/// `(1 - cos θ)/θ²`, written as `2 (sin(θ/2)/θ)²` which does not cancel.
pub(crate) fn one_minus_cos<T: RealField + Copy>(theta2: T) -> T {
    let s = half_sinc(theta2);
    s * s * convert(2.0)
}

/// `(θ - sin θ)/θ³ = Σ (-1)^k θ^2k / (2k+3)!`
pub(crate) fn theta_minus_sin<T: RealField + Copy>(theta2: T) -> T {
    const C: [f64; 8] = [
        1.0 / 6.0,
        -1.0 / 120.0,
        1.0 / 5_040.0,
        -1.0 / 362_880.0,
        1.0 / 39_916_800.0,
        -1.0 / 6_227_020_800.0,
        1.0 / 1_307_674_368_000.0,
        -1.0 / 355_687_428_096_000.0,
    ];
    if is_small(theta2) {
        return polynomial(theta2, &C);
    }
    let theta = theta2.sqrt();
    (theta - theta.sin()) / (theta2 * theta)
}

/// `(θ² + 2 cos θ - 2)/(2 θ⁴) = Σ (-1)^k θ^2k / (2k+4)!`
pub(crate) fn barfoot_third<T: RealField + Copy>(theta2: T) -> T {
    const C: [f64; 8] = [
        1.0 / 24.0,
        -1.0 / 720.0,
        1.0 / 40_320.0,
        -1.0 / 3_628_800.0,
        1.0 / 479_001_600.0,
        -1.0 / 87_178_291_200.0,
        1.0 / 20_922_789_888_000.0,
        -1.0 / 6_402_373_705_728_000.0,
    ];
    if is_small(theta2) {
        return polynomial(theta2, &C);
    }
    // θ² - 2(1 - cos θ), over 2θ⁴.
    (T::one() - one_minus_cos(theta2) * convert(2.0)) / (theta2 * convert(2.0))
}

/// `(2θ - 3 sin θ + θ cos θ)/(2 θ⁵) = Σ (-1)^k (k+1) θ^2k / (2k+5)!`
pub(crate) fn barfoot_fourth<T: RealField + Copy>(theta2: T) -> T {
    const C: [f64; 8] = [
        1.0 / 120.0,
        -2.0 / 5_040.0,
        3.0 / 362_880.0,
        -4.0 / 39_916_800.0,
        5.0 / 6_227_020_800.0,
        -6.0 / 1_307_674_368_000.0,
        7.0 / 355_687_428_096_000.0,
        -8.0 / 121_645_100_408_832_000.0,
    ];
    if is_small(theta2) {
        return polynomial(theta2, &C);
    }
    let theta = theta2.sqrt();
    let numerator = theta * convert(2.0) - theta.sin() * convert(3.0) + theta * theta.cos();
    numerator / (theta2 * theta2 * theta * convert(2.0))
}

/// `(1 - (θ/2) cot(θ/2))/θ² = Σ |B(2k+2)| θ^2k / (2k+2)!` with the Bernoulli numbers B.
///
/// Infinite at θ = 2π, where the left Jacobian is singular.
pub(crate) fn inverse_jacobian<T: RealField + Copy>(theta2: T) -> T {
    const C: [f64; 11] = [
        1.0 / 12.0,
        1.0 / 720.0,
        1.0 / 30_240.0,
        1.0 / 1_209_600.0,
        1.0 / 47_900_160.0,
        691.0 / 1_307_674_368_000.0,
        1.0 / 74_724_249_600.0,
        3_617.0 / 10_670_622_842_880_000.0,
        43_867.0 / 5_109_094_217_170_944_000.0,
        174_611.0 / 802_857_662_698_291_200_000.0,
        77_683.0 / 14_101_100_039_391_805_440_000.0,
    ];
    if is_small(theta2) {
        return polynomial(theta2, &C);
    }
    let half = theta2.sqrt() * convert(0.5);
    (T::one() - half * half.cos() / half.sin()) / theta2
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Series and closed form meet at the blend point.
    #[test]
    fn continuous_at_the_blend() {
        let (below, above) = (BLEND * (1.0 - 1e-15), BLEND * (1.0 + 1e-15));
        for f in [
            half_sinc::<f64>,
            one_minus_cos,
            theta_minus_sin,
            barfoot_third,
            barfoot_fourth,
            inverse_jacobian,
        ] {
            let (b, a) = (f(below), f(above));
            assert!((a - b).abs() < 2e-14 * b.abs() + 2e-16, "{b} {a}");
        }
    }

    #[test]
    fn values_at_zero() {
        assert_eq!(half_sinc(0.0), 0.5);
        assert_eq!(one_minus_cos(0.0), 0.5);
        assert_eq!(theta_minus_sin(0.0), 1.0 / 6.0);
        assert_eq!(inverse_jacobian(0.0), 1.0 / 12.0);
    }
}
