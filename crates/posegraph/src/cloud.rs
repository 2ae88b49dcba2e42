//! A view prepared for the dense term: look-up of the best pixel for a point, and the evenly spread sample of pixels
//! that is matched with other views.

use crate::graph::DenseView;
use crate::lanes::{LANES, Lane};
use crate::options::{Gates, SolveOptions};
use crate::transform::Rigid;

/// A source pixel of the dense term.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Sample {
    pub(crate) point: [f32; 3],
    pub(crate) normal: [f32; 3],
    /// Variance of its depth, square metres.
    pub(crate) variance: f32,
}

/// A view with what association needs precomputed.
#[derive(Debug)]
pub(crate) struct Cloud<'a> {
    view: &'a DenseView,
    fx: f32,
    fy: f32,
    cx: f32,
    cy: f32,
    width: i32,
    height: i32,
    /// Metres per pixel of offset and metre of depth that a ray at least keeps from a point.
    reach: f32,
    pub(crate) samples: Vec<Sample>,
    /// Mean of the samples, camera frame.
    pub(crate) centre: [f32; 3],
    /// Largest distance of a sample from the centre, metres.
    pub(crate) radius: f32,
    /// Size of a pixel at the depth of the centre, metres.
    pub(crate) pixel_size: f32,
}

impl<'a> Cloud<'a> {
    pub(crate) fn new(view: &'a DenseView, options: &SolveOptions) -> Self {
        let samples = spread(view, options);
        let (centre, radius) = sphere(&samples);
        // The ray of a pixel `k` pixels from the projection of a point at depth z passes it at a distance of at
        // least `k z / f` times the cosine of the ray's angle, which is smallest in a corner of the image.
        let x = view.cx.abs().max((view.width as f64 - view.cx).abs()) / view.fx;
        let y = view.cy.abs().max((view.height as f64 - view.cy).abs()) / view.fy;
        let focal = view.fx.max(view.fy);
        // An image with more pixels than an index can hold is treated as empty.
        let fits = i32::try_from(view.points.len()).is_ok();
        let size = |n: usize| if fits { n as i32 } else { 0 };
        Self {
            view,
            fx: view.fx as f32,
            fy: view.fy as f32,
            cx: view.cx as f32,
            cy: view.cy as f32,
            width: size(view.width),
            height: size(view.height),
            reach: (1.0 / ((1.0 + x * x + y * y).sqrt() * focal)) as f32,
            samples,
            pixel_size: centre[2] / focal as f32,
            centre,
            radius,
        }
    }

    /// Index of the pixel that minimises `distance / max_distance + (1 - n . n')` in a window around the
    /// projection of `p` (this camera's frame), among those that pass both gates.
    ///
    /// Goes outward from the projection and leaves out all pixels whose rays pass too far away to score better: near
    /// convergence that leaves the nearest four, whatever the radius.
    pub(crate) fn nearest_compatible(&self, p: [f32; 3], n: [f32; 3], gates: &Gates) -> Option<usize> {
        self.best_near(self.project(p)?, p, n, gates)
    }

    /// The same for a point that has been projected.
    #[inline(always)]
    pub(crate) fn best_near(
        &self,
        Position { u, v, dx, dy }: Position,
        p: [f32; 3],
        n: [f32; 3],
        gates: &Gates,
    ) -> Option<usize> {
        // No pixel is farther than this.
        let farthest = u.max(self.width - 1 - u).max(v).max(self.height - 1 - v).max(0);
        let radius = gates.radius.min(farthest as usize) as i32;
        if u + radius < 0 || v + radius < 0 || u - radius >= self.width || v - radius >= self.height {
            return None;
        }
        let mut search = Search { p, n, gates, best: Search::NONE };
        let inside = |u: i32, v: i32| u >= 0 && v >= 0 && u < self.width && v < self.height;
        let scale = p[2] * self.reach;
        // The four pixels around the projection first: almost always the others are too far to score better.
        let (left, top) = (u - i32::from(dx < 0.0), v - i32::from(dy < 0.0));
        if radius > 0 && inside(left, top) && inside(left + 1, top + 1) {
            self.visit_row::<2>(&mut search, top, left);
            self.visit_row::<2>(&mut search, top + 1, left);
            if (1.0 + dx.abs().min(dy.abs())) * scale > search.limit() {
                return search.found();
            }
        } else {
            if inside(u, v) {
                self.visit(&mut search, v, u, u);
            }
            if radius == 0 {
                return search.found();
            }
        }
        let first_far_ring = if inside(u - 1, v - 1) && inside(u + 1, v + 1) {
            for row in [v - 1, v, v + 1] {
                self.visit_row::<3>(&mut search, row, u - 1);
            }
            2
        } else {
            1
        };
        for ring in first_far_ring..=radius {
            let k = ring as f32;
            if (k - dx.abs().max(dy.abs())) * scale > search.limit() {
                break;
            }
            let (from, to) = ((u - ring).max(0), (u + ring).min(self.width - 1));
            for (row, offset) in [(v - ring, k + dy), (v + ring, k - dy)] {
                if row >= 0 && row < self.height && offset * scale <= search.limit() {
                    self.visit(&mut search, row, from, to);
                }
            }
            for (column, offset) in [(u - ring, k + dx), (u + ring, k - dx)] {
                if column >= 0 && column < self.width && offset * scale <= search.limit() {
                    for row in (v - ring + 1).max(0)..(v + ring).min(self.height) {
                        self.visit(&mut search, row, column, column);
                    }
                }
            }
        }
        search.found()
    }

    /// Point and normal of a pixel.
    pub(crate) fn pixel(&self, index: usize) -> Option<(&[f32; 3], &[f32; 3])> {
        self.view.points.get(index).zip(self.view.normals.get(index))
    }

    /// Whether a match that an earlier search found would pass these gates too.
    pub(crate) fn is_compatible(&self, pixel: usize, p: [f32; 3], n: [f32; 3], gates: &Gates) -> bool {
        let Some(Position { u, v, .. }) = self.project(p) else { return false };
        let search = Search { p, n, gates, best: Search::NONE };
        let (column, row) = (pixel as i32 % self.width.max(1), pixel as i32 / self.width.max(1));
        let offset = (column - u).unsigned_abs().max((row - v).unsigned_abs());
        let passes = self.pixel(pixel).is_some_and(|(q, m)| search.key(q, m, 0) != Search::NONE);
        passes && offset as usize <= gates.radius
    }

    /// Where a point projects to; `None` behind the camera.
    #[inline(always)]
    fn project(&self, p: [f32; 3]) -> Option<Position> {
        if p[2].is_nan() || p[2] <= 0.0 {
            return None;
        }
        let inverse_depth = 1.0 / p[2];
        let (x, y) = (self.fx * p[0] * inverse_depth + self.cx, self.fy * p[1] * inverse_depth + self.cy);
        let (u, v) = (nearest_pixel(x), nearest_pixel(y));
        Some(Position { u, v, dx: x - u as f32, dy: y - v as f32 })
    }

    /// [`Self::project`] of eight samples after a rigid motion.
    #[inline(always)]
    pub(crate) fn project_all(&self, transform: &Rigid<f32>, samples: &[Sample; LANES]) -> Projections {
        let (r, t) = (&transform.r, &transform.t);
        let mut all = Projections::default();
        let lanes = |of: &dyn Fn(&Sample) -> f32| -> Lane { std::array::from_fn(|l| of(&samples[l])) };
        let (p, n) = ([0, 1, 2].map(|k| lanes(&|s| s.point[k])), [0, 1, 2].map(|k| lanes(&|s| s.normal[k])));
        for k in 0..3 {
            let [a, b, c] = [r[3 * k], r[3 * k + 1], r[3 * k + 2]];
            for l in 0..LANES {
                all.point[k][l] = a * p[0][l] + b * p[1][l] + c * p[2][l] + t[k];
                all.normal[k][l] = a * n[0][l] + b * n[1][l] + c * n[2][l];
            }
        }
        for l in 0..LANES {
            let inverse_depth = 1.0 / all.point[2][l];
            let x = self.fx * all.point[0][l] * inverse_depth + self.cx;
            let y = self.fy * all.point[1][l] * inverse_depth + self.cy;
            all.u[l] = nearest_pixel(x);
            all.v[l] = nearest_pixel(y);
            all.dx[l] = x - all.u[l] as f32;
            all.dy[l] = y - all.v[l] as f32;
        }
        all
    }

    /// Compares the best so far with `N` pixels of a row, all inside.
    #[inline(always)]
    fn visit_row<const N: usize>(&self, search: &mut Search<'_>, row: i32, from: i32) {
        let start = (row * self.width + from) as usize;
        let points = self.view.points.get(start..).and_then(|s| s.first_chunk::<N>());
        let normals = self.view.normals.get(start..).and_then(|s| s.first_chunk::<N>());
        if let (Some(points), Some(normals)) = (points, normals) {
            let mut best = search.best;
            for k in 0..N {
                best = best.min(search.key(&points[k], &normals[k], start + k));
            }
            search.best = best;
        }
    }

    /// Compares the best so far with the pixels of a row from one column to another, both inside.
    #[inline(always)]
    fn visit(&self, search: &mut Search<'_>, row: i32, from: i32, to: i32) {
        let start = (row * self.width + from) as usize;
        let range = start..start + (to + 1 - from).max(0) as usize;
        let points = self.view.points.get(range.clone()).unwrap_or_default();
        let normals = self.view.normals.get(range).unwrap_or_default();
        for (k, (point, normal)) in points.iter().zip(normals).enumerate() {
            search.best = search.best.min(search.key(point, normal, start + k));
        }
    }
}

/// Nearest pixel (column, row) of a projection, and the projection relative to it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Position {
    u: i32,
    v: i32,
    dx: f32,
    dy: f32,
}

/// Eight samples in the target's camera frame and where they project to.
#[derive(Debug, Default)]
pub(crate) struct Projections {
    point: [Lane; 3],
    normal: [Lane; 3],
    u: [i32; LANES],
    v: [i32; LANES],
    dx: Lane,
    dy: Lane,
}

impl Projections {
    /// Point and normal of one sample.
    #[inline(always)]
    pub(crate) fn lane(&self, l: usize) -> ([f32; 3], [f32; 3]) {
        ([0, 1, 2].map(|k| self.point[k][l]), [0, 1, 2].map(|k| self.normal[k][l]))
    }

    /// Where it projects to; `None` behind the camera.
    #[inline(always)]
    pub(crate) fn position(&self, l: usize) -> Option<Position> {
        let in_front = self.point[2][l] > 0.0;
        in_front.then_some(Position { u: self.u[l], v: self.v[l], dx: self.dx[l], dy: self.dy[l] })
    }
}

/// Rounds to the nearest integer; what is beyond a million (or NaN) ends far outside of every image.
#[inline(always)]
fn nearest_pixel(x: f32) -> i32 {
    // Adding 1.5 * 2^23 leaves the integer in the low bits: `round` and checked casts are slow on the baseline
    // instruction set. Comparisons this way round catch NaN.
    let x = if x > -1e6 { x } else { -1e6 };
    let x = if x < 1e6 { x } else { 1e6 };
    (x + 12_582_912.0).to_bits() as i32 - 0x4B40_0000
}

/// State of one search.
struct Search<'g> {
    p: [f32; 3],
    n: [f32; 3],
    gates: &'g Gates,
    /// Score (as bits: those of positive floats sort like integers) above the pixel's index, so that the best is a
    /// minimum of integers: which pixel wins is not predictable, and a wrong guess costs more than its score.
    best: u64,
}

impl Search<'_> {
    const NONE: u64 = u64::MAX;

    /// Score and index of a pixel (point `q`, normal `m`), or `NONE` if a gate stops it. Invalid pixels never pass: a
    /// zero or NaN normal fails the angle gate, a NaN point the distance gate.
    #[inline(always)]
    fn key(&self, q: &[f32; 3], m: &[f32; 3], index: usize) -> u64 {
        let (p, n) = (&self.p, &self.n);
        let d = [q[0] - p[0], q[1] - p[1], q[2] - p[2]];
        let distance = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
        let cosine = n[0] * m[0] + n[1] * m[1] + n[2] * m[2];
        let turn = if cosine < 1.0 { 1.0 - cosine } else { 0.0 };
        let score = distance + self.gates.max_distance * turn;
        let passes = (distance <= self.gates.max_distance) & (cosine >= self.gates.min_cosine) & (q[2] > 0.0);
        let key = (u64::from(score.to_bits()) << 32) | index as u64;
        key | u64::from(passes).wrapping_sub(1)
    }

    /// Distance beyond which a candidate cannot score better than the best so far.
    #[inline(always)]
    fn limit(&self) -> f32 {
        // `NONE` reads as NaN.
        let score = f32::from_bits((self.best >> 32) as u32);
        if score < self.gates.max_distance { score } else { self.gates.max_distance }
    }

    #[inline(always)]
    fn found(&self) -> Option<usize> {
        (self.best != Self::NONE).then_some((self.best & 0xFFFF_FFFF) as usize)
    }
}

/// At most `max_dense_per_edge` of the valid pixels, evenly spread over them.
fn spread(view: &DenseView, options: &SolveOptions) -> Vec<Sample> {
    let pixels = view.points.len().min(u32::MAX as usize);
    let mut valid = vec![0u32; pixels];
    let mut count = 0;
    for (k, (p, n)) in view.points.iter().zip(&view.normals).take(pixels).enumerate() {
        if p[2] > 0.0 {
            let has_normal = n[0] * n[0] + n[1] * n[1] + n[2] * n[2] > 0.25;
            // Zero unless something is NaN or infinite.
            let zero = (p[0] + p[1] + p[2] + n[0] + n[1] + n[2]) * 0.0;
            valid[count] = k as u32;
            count += usize::from(has_normal & (zero == 0.0));
        }
    }
    let samples = count.min(options.max_dense_per_edge);
    let sample = |k: usize| {
        // Centre of the k-th of equal stretches.
        let pixel = valid[(2 * k + 1) * count / (2 * samples)] as usize;
        let (point, normal) = (view.points[pixel], view.normals[pixel]);
        Sample { point, normal, variance: options.depth_variance(f64::from(point[2])) as f32 }
    };
    (0..samples).map(sample).collect()
}

/// Mean of the samples and the largest distance from it.
fn sphere(samples: &[Sample]) -> ([f32; 3], f32) {
    let mut sum = [0.0f64; 3];
    for sample in samples {
        (0..3).for_each(|k| sum[k] += f64::from(sample.point[k]));
    }
    let centre = sum.map(|s| (s / samples.len().max(1) as f64) as f32);
    let squared = samples.iter().map(|s| (0..3).map(|k| (s.point[k] - centre[k]).powi(2)).sum::<f32>());
    (centre, squared.fold(0.0, f32::max).sqrt())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;

    /// A rough surface with holes, NaN and wrong normals.
    fn view(rng: &mut Pcg64Mcg, width: usize, height: usize) -> DenseView {
        let (focal, cx, cy) = (60.0, width as f64 / 2.0, height as f64 / 2.0);
        let (mut points, mut normals) = (Vec::new(), Vec::new());
        for k in 0..width * height {
            let z = 0.5 + rng.random_range(-0.004..0.004) + 0.001 * (k % width) as f64;
            let (u, v) = ((k % width) as f64 - cx, (k / width) as f64 - cy);
            let point = [(u * z / focal) as f32, (v * z / focal) as f32, z as f32];
            let mut tilt = || rng.random_range(-0.5f32..0.5);
            let (a, b) = (tilt(), tilt());
            let length = (1.0 + a * a + b * b).sqrt();
            let normal = [a / length, b / length, -1.0 / length];
            let kind = rng.random_range(0..10);
            points.push(if kind == 0 {
                [f32::NAN; 3]
            } else if kind == 1 {
                [0.0; 3]
            } else {
                point
            });
            normals.push(if kind == 2 { [0.0; 3] } else { normal });
        }
        DenseView { width, height, fx: focal, fy: focal, cx, cy, points, normals }
    }

    /// Best score in the window, pixel by pixel.
    fn exhaustive(view: &DenseView, p: [f32; 3], n: [f32; 3], gates: &Gates) -> Option<f32> {
        let project =
            |c: f32, f: f64, centre: f64| (f as f32 * c * (1.0 / p[2]) + centre as f32).round_ties_even();
        let (u, v) = (project(p[0], view.fx, view.cx), project(p[1], view.fy, view.cy));
        let mut best: Option<f32> = None;
        for (k, (q, m)) in view.points.iter().zip(&view.normals).enumerate() {
            let offset = ((k % view.width) as f32 - u).abs().max(((k / view.width) as f32 - v).abs());
            let distance = (0..3).map(|c| (q[c] - p[c]) * (q[c] - p[c])).sum::<f32>().sqrt();
            let cosine = (0..3).map(|c| n[c] * m[c]).sum::<f32>();
            let passes = distance <= gates.max_distance && cosine >= gates.min_cosine && q[2] > 0.0;
            if passes && offset as usize <= gates.radius {
                let score = distance + gates.max_distance * (1.0 - cosine).max(0.0);
                best = Some(best.map_or(score, |b| b.min(score)));
            }
        }
        best
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]

        #[test]
        fn search_finds_the_best_of_the_window(
            seed in any::<u64>(),
            (width, height) in (1usize..14, 1usize..14),
            radius in 0usize..5,
            max_distance in 0.003f32..0.05,
        ) {
            let mut rng = Pcg64Mcg::seed_from_u64(seed);
            let view = view(&mut rng, width, height);
            let cloud = Cloud::new(&view, &SolveOptions::default());
            let gates = Gates { radius, max_distance, min_cosine: 0.8, last: true };
            for _ in 0..60 {
                let p = [rng.random_range(-0.08..0.08), rng.random_range(-0.08..0.08), rng.random_range(0.48..0.53)];
                let n = [rng.random_range(-0.3f32..0.3), 0.0, -0.95];
                let found = cloud.nearest_compatible(p, n, &gates);
                let search = Search { p, n, gates: &gates, best: Search::NONE };
                let score = found.map(|k| search.key(&view.points[k], &view.normals[k], k) >> 32);
                let expected = exhaustive(&view, p, n, &gates);
                prop_assert_eq!(found.is_some(), expected.is_some());
                if let (Some(score), Some(expected), Some(pixel)) = (score, expected, found) {
                    let score = f32::from_bits(score as u32);
                    prop_assert!((score - expected).abs() <= 1e-6 * expected, "{} {}", score, expected);
                    prop_assert!(cloud.is_compatible(pixel, p, n, &gates));
                }
            }
        }
    }

    #[test]
    fn points_that_do_not_project_find_nothing() {
        let view = view(&mut Pcg64Mcg::seed_from_u64(1), 9, 9);
        let cloud = Cloud::new(&view, &SolveOptions::default());
        let gates = Gates { radius: usize::MAX, max_distance: 10.0, min_cosine: 0.1, last: true };
        let n = [0.0, 0.0, -1.0];
        for p in [[0.0, 0.0, -0.5], [0.0, 0.0, 0.0], [0.0, 0.0, f32::NAN], [f32::NAN, 0.0, 0.5]] {
            assert_eq!(cloud.nearest_compatible(p, n, &gates), None, "{p:?}");
        }
        for p in [[f32::MAX, 0.0, 1e-30], [f32::INFINITY, f32::NEG_INFINITY, 0.5], [1e9, 1e9, 0.5]] {
            assert_eq!(cloud.nearest_compatible(p, n, &gates), None, "{p:?}");
        }
        assert!(cloud.nearest_compatible([0.0, 0.0, 0.5], n, &gates).is_some());
    }
}
