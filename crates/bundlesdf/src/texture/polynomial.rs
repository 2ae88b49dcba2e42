//! Smooth functions of a direction, and the robust least squares that they are fitted with.

use nalgebra::Vector3;

/// Spherical polynomials of degree 1 to 3.
pub(super) const TERMS: usize = 15;
/// Expected size of the terms of each degree (standard deviation of log brightness). Irradiance falls off with the
/// degree like 1, 2/3, 1/4, 0; the last is what the logarithm adds.
const PRIOR: [f64; 3] = [0.4, 0.25, 0.08];
/// Residuals beyond this many standard deviations lose their say (Cauchy's weights).
const CAUCHY: f64 = 2.0;

/// Coefficients of a function of a direction.
pub(super) type Terms = [f64; TERMS];

/// Real spherical harmonics of degree 1 to 3, scaled to a mean square of one, at a unit vector.
pub(super) fn basis(n: &Vector3<f64>) -> Terms {
    let (x, y, z) = (n.x, n.y, n.z);
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let root = |v: f64| v.sqrt();
    [
        root(3.0) * x,
        root(3.0) * y,
        root(3.0) * z,
        root(15.0) * x * y,
        root(15.0) * y * z,
        root(15.0) * x * z,
        root(5.0) / 2.0 * (3.0 * zz - 1.0),
        root(15.0) / 2.0 * (xx - yy),
        root(35.0 / 8.0) * y * (3.0 * xx - yy),
        root(105.0) * x * y * z,
        root(21.0 / 8.0) * y * (5.0 * zz - 1.0),
        root(7.0) / 2.0 * z * (5.0 * zz - 3.0),
        root(21.0 / 8.0) * x * (5.0 * zz - 1.0),
        root(105.0) / 2.0 * z * (xx - yy),
        root(35.0 / 8.0) * x * (xx - 3.0 * yy),
    ]
}

/// Weight of "no light" on each term.
pub(super) fn prior(term: usize) -> f64 {
    let degree = match term {
        0..3 => 0,
        3..8 => 1,
        _ => 2,
    };
    PRIOR[degree].powi(-2)
}

pub(super) fn dot(a: &Terms, b: &Terms) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Weight of a residual in standard deviations.
pub(super) fn cauchy(t: f64) -> f64 {
    1.0 / (1.0 + (t / CAUCHY).powi(2))
}

/// Standard deviation by the median of the absolute values; 0 of nothing.
pub(super) fn deviation(mut errors: Vec<f64>) -> f64 {
    errors.iter_mut().for_each(|e| *e = e.abs());
    let middle = errors.len() / 2;
    if errors.is_empty() {
        return 0.0;
    }
    1.4826 * *errors.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Directions spread evenly over the sphere (Fibonacci's lattice).
    pub(in super::super) fn directions(count: usize) -> impl Iterator<Item = Vector3<f64>> {
        (0..count).map(move |i| {
            let (y, turn) = (1.0 - 2.0 * (i as f64 + 0.5) / count as f64, i as f64 * 2.399_963_229_728_653);
            let r = (1.0 - y * y).sqrt();
            Vector3::new(r * turn.cos(), y, r * turn.sin())
        })
    }

    #[test]
    fn the_polynomials_are_orthonormal_and_without_mean() {
        const COUNT: usize = 20_000;
        let mut sums = [[0.0; TERMS]; TERMS];
        let mut means = [0.0; TERMS];
        for terms in directions(COUNT).map(|n| basis(&n)) {
            for i in 0..TERMS {
                means[i] += terms[i] / COUNT as f64;
                (0..TERMS).for_each(|j| sums[i][j] += terms[i] * terms[j] / COUNT as f64);
            }
        }
        for (i, row) in sums.iter().enumerate() {
            assert!(means[i].abs() < 1e-3, "{i}: {}", means[i]);
            for (j, sum) in row.iter().enumerate() {
                let expected = if i == j { 1.0 } else { 0.0 };
                assert!((sum - expected).abs() < 2e-3, "{i} {j}: {sum}");
            }
        }
    }

    #[test]
    fn deviation_is_that_of_most() {
        // Quartiles of a standard normal distribution, and outliers.
        let mut errors = vec![-0.6745, 0.6745, 0.1, -0.1, 2.0, -2.0, 0.6745];
        assert!((deviation(errors.clone()) - 1.0).abs() < 1e-3);
        errors.push(1e9);
        assert!(deviation(errors) < 3.5);
        assert_eq!(deviation(vec![]), 0.0);
    }
}
