//! Real spherical harmonics of bands 0 to 2: a view direction that can tint a colour but not hide a pose error.

use crate::real::Real;

/// Number of coefficients.
pub(crate) const COUNT: usize = 9;

/// The nine polynomials at the unit vector `d`, and their derivatives by its components.
#[inline(always)]
pub(crate) fn harmonics<R: Real>([x, y, z]: [R; 3]) -> ([R; COUNT], [[R; 3]; COUNT]) {
    let c = R::of;
    let o = R::ZERO;
    let (k1, k2, k20, k22) =
        (c(0.488_602_511_902_92), c(1.092_548_430_592_08), c(0.315_391_565_252_52), c(0.546_274_215_296_04));
    let three = c(3.0);
    let two = c(2.0);
    (
        [
            c(0.282_094_791_773_878),
            -(k1 * y),
            k1 * z,
            -(k1 * x),
            k2 * x * y,
            -(k2 * y * z),
            k20 * (three * z * z - R::ONE),
            -(k2 * x * z),
            k22 * (x * x - y * y),
        ],
        [
            [o, o, o],
            [o, -k1, o],
            [o, o, k1],
            [-k1, o, o],
            [k2 * y, k2 * x, o],
            [o, -(k2 * z), -(k2 * y)],
            [o, o, two * three * k20 * z],
            [-(k2 * z), o, -(k2 * x)],
            [two * k22 * x, -(two * k22 * y), o],
        ],
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_match_differences() {
        let d = [0.3, -0.5, 0.81];
        let (_, slope) = harmonics::<f64>(d);
        for a in 0..3 {
            let (mut lo, mut hi) = (d, d);
            lo[a] -= 1e-6;
            hi[a] += 1e-6;
            let (l, u) = (harmonics(lo).0, harmonics(hi).0);
            for k in 0..COUNT {
                assert!(((u[k] - l[k]) / 2e-6 - slope[k][a]).abs() < 1e-8);
            }
        }
    }

    #[test]
    fn bands_are_orthonormal_on_the_sphere() {
        // Fibonacci points: sums over the sphere to a part in a thousand.
        let n = 20_000;
        let mut gram = [[0.0; COUNT]; COUNT];
        for i in 0..n {
            let z = 1.0 - (2 * i + 1) as f64 / n as f64;
            let (s, c) = (i as f64 * 2.399_963_229_728_653).sin_cos();
            let r = (1.0 - z * z).sqrt();
            let h = harmonics([r * c, r * s, z]).0;
            for a in 0..COUNT {
                for b in 0..COUNT {
                    gram[a][b] += h[a] * h[b] * 4.0 * std::f64::consts::PI / n as f64;
                }
            }
        }
        for a in 0..COUNT {
            for b in 0..COUNT {
                assert!((gram[a][b] - f64::from(u8::from(a == b))).abs() < 1e-2);
            }
        }
    }
}
