//! Light that stays with the object: where the camera goes around it, or along the axis of a turntable.
//!
//! Views can't tell it from the object's own colour. What can is that things are mostly painted in patches: where two
//! points near each other differ little, and in brightness alone, the difference follows the direction of the surface. In
//! logarithms `brightness of i - brightness of j = shading(normal of i) - shading(normal of j)` for pairs of neighbours,
//! robustly, since borders of patches are outliers to it (as in Retinex: Land and McCann, JOSA 1971; Horn, "Determining
//! lightness from an image", CGIP 1974; here the shape is known).

use std::collections::HashMap;

use nalgebra::{SMatrix, SVector, Vector3};

use super::{
    polynomial::{TERMS, Terms, basis, cauchy, deviation, dot, prior},
    sample::SurfacePoint,
};

/// Reach of a pair, as a share of the object's diagonal; nearer than a third of it normals hardly differ.
const REACH: f32 = 0.08;
/// Least cosine between the normals of a pair: across a sharp edge there is another patch more often than not.
const SAME_SIDE: f64 = 0.6;
/// Most difference of log red and blue to green within a patch.
const SAME_PAINT: f64 = 0.1;
/// One of so many pairs is taken.
const THINNING: usize = 11;
/// So many pairs err together.
const CORRELATED: f64 = 200.0;
const ROUNDS: usize = 15;
const LEAST_SIGMA: f64 = 0.02;

/// The shading that the surface's own brightness suggests; `colors` are logarithms of red, green and blue where they are
/// known.
pub(super) fn estimate(points: &[SurfacePoint], colors: &[Option<[f64; 3]>]) -> Terms {
    let pairs = pairs(points, colors);
    let mut terms = [0.0; TERMS];
    for _ in 0..ROUNDS {
        let error = |(d, b): &(f64, Terms)| d - dot(&terms, b);
        let sigma = deviation(pairs.iter().map(error).collect()).max(LEAST_SIGMA);
        let (mut h, mut g) = (SMatrix::<f64, TERMS, TERMS>::zeros(), SVector::<f64, TERMS>::zeros());
        for pair in &pairs {
            let weight = cauchy(error(pair) / sigma) / (sigma * sigma * CORRELATED);
            let row = SVector::from(pair.1);
            h.syger(weight, &row, &row, 1.0);
            g += row * (weight * pair.0);
        }
        h.fill_upper_triangle_with_lower_triangle();
        (0..TERMS).for_each(|i| h[(i, i)] += prior(i));
        let Some(factor) = h.cholesky() else { return [0.0; TERMS] };
        terms = factor.solve(&g).into();
    }
    terms
}

/// Differences of log brightness and of the polynomials.
fn pairs(points: &[SurfacePoint], colors: &[Option<[f64; 3]>]) -> Vec<(f64, Terms)> {
    let bound = |pick: fn(f32, f32) -> f32, start: f32| -> [f32; 3] {
        points.iter().fold([start; 3], |b, p| std::array::from_fn(|k| pick(b[k], p.position[k])))
    };
    let (low, high) = (bound(f32::min, f32::INFINITY), bound(f32::max, f32::NEG_INFINITY));
    let reach = REACH * (0..3).map(|k| (high[k] - low[k]).powi(2)).sum::<f32>().sqrt();
    let cell = |p: &SurfacePoint| p.position.map(|v| (v / reach).floor() as i32);
    let mut cells: HashMap<[i32; 3], Vec<usize>> = HashMap::new();
    for (i, p) in points.iter().enumerate().filter(|(i, _)| colors[*i].is_some()) {
        cells.entry(cell(p)).or_default().push(i);
    }
    let bases: Vec<Terms> = points.iter().map(|p| basis(&Vector3::from(p.normal.map(f64::from)))).collect();
    let mut pairs = Vec::new();
    for (i, p) in points.iter().enumerate() {
        let Some(own) = colors[i] else { continue };
        let [x, y, z] = cell(p);
        let around =
            (-1..=1).flat_map(|a| (-1..=1).flat_map(move |b| (-1..=1).map(move |c| [x + a, y + b, z + c])));
        let near = around.filter_map(|c| cells.get(&c)).flatten().copied();
        for j in near.filter(|&j| j > i && (7 * i + 13 * j) % THINNING == 0) {
            let (q, Some(other)) = (&points[j], colors[j]) else { continue };
            let distance = (0..3).map(|k| (p.position[k] - q.position[k]).powi(2)).sum::<f32>().sqrt();
            let cosine: f64 = (0..3).map(|k| f64::from(p.normal[k] * q.normal[k])).sum();
            let step: [f64; 3] = std::array::from_fn(|k| own[k] - other[k]);
            let painted = (step[0] - step[1]).abs() < SAME_PAINT && (step[2] - step[1]).abs() < SAME_PAINT;
            if (reach / 3.0..reach).contains(&distance) && cosine > SAME_SIDE && painted {
                let difference = std::array::from_fn(|k| bases[i][k] - bases[j][k]);
                pairs.push((step.iter().sum::<f64>() / 3.0, difference));
            }
        }
    }
    pairs
}

#[cfg(test)]
mod tests {
    use super::super::polynomial::tests::directions;
    use super::*;

    const RADIUS: f32 = 0.1;

    /// A ball under a lamp that turns with it, with patches of `paint` (log brightness) and log red beside it.
    fn ball(paint: impl Fn(&Vector3<f64>) -> [f64; 2]) -> (Vec<SurfacePoint>, Vec<Option<[f64; 3]>>) {
        let shaded = |n: Vector3<f64>| {
            let [own, red] = paint(&n);
            let log = 4.5 + own + dot(&basis(&n), &truth());
            let normal: [f32; 3] = n.cast::<f32>().into();
            (SurfacePoint { position: normal.map(|v| RADIUS * v), normal }, Some([log + red, log, log]))
        };
        directions(4000).map(shaded).unzip()
    }

    fn truth() -> Terms {
        let mut terms = [0.0; TERMS];
        (terms[0], terms[1], terms[2], terms[6]) = (0.15, -0.25, 0.1, 0.06);
        terms
    }

    fn error(found: &Terms) -> f64 {
        found.iter().zip(truth()).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
    }

    #[test]
    fn the_shading_of_a_ball_of_one_colour_is_found() {
        let (points, colors) = ball(|_| [0.0, 0.0]);
        let found = estimate(&points, &colors);
        assert!(error(&found) < 0.02, "{found:?}");
    }

    /// Stripes of other colours and of other brightness are no shading.
    #[test]
    fn borders_of_paint_are_outliers() {
        let stripe = |n: &Vector3<f64>| ((n.x + 0.4 * n.y) * 2.5 + 7.0).floor() as i64;
        let (points, colors) = ball(|n| match stripe(n).rem_euclid(3) {
            0 => [0.0, 0.0],
            1 => [-0.5, 0.0],
            _ => [0.3, 0.6],
        });
        let found = estimate(&points, &colors);
        assert!(error(&found) < 0.08, "{found:?}");
    }

    #[test]
    fn nothing_known_is_no_light() {
        let (points, colors) = ball(|_| [0.0, 0.0]);
        assert_eq!(estimate(&points, &vec![None; colors.len()]), [0.0; TERMS]);
    }
}
