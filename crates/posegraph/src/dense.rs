//! Dense term: point-to-plane distances under re-projective association (eq. `L_p`).

use nalgebra::Isometry3;

use crate::graph::DenseView;
use crate::jacobian::{RowSums, huber, lift, plane_residual};
use crate::normal::NormalEquations;
use crate::options::{Gates, SolveOptions};
use crate::stats::{Extent, Residuals};
use crate::transform::{Rigid, is_finite, widen};

/// A source pixel of the dense term.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sample {
    point: [f32; 3],
    normal: [f32; 3],
    /// Variance of its depth, square metres.
    variance: f32,
}

/// At most `max_dense_per_edge` valid pixels, evenly spread over all valid pixels of the view.
pub(crate) fn sample_pixels(view: &DenseView, options: &SolveOptions) -> Vec<Sample> {
    let valid = |(k, (p, n)): (usize, (&[f32; 3], &[f32; 3]))| {
        let has_normal = || is_finite(n) && (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]) > 0.25;
        (p[2] > 0.0 && has_normal() && is_finite(p)).then_some(k)
    };
    let all: Vec<usize> = view.points.iter().zip(&view.normals).enumerate().filter_map(valid).collect();
    let count = all.len().min(options.max_dense_per_edge);
    let sample = |k: usize| {
        // Centre of the k-th of `count` equal stretches.
        let pixel = all[(2 * k + 1) * all.len() / (2 * count)];
        let point = view.points[pixel];
        let variance = options.depth_variance(f64::from(point[2])) as f32;
        Sample { point, normal: view.normals[pixel], variance }
    };
    (0..count).map(sample).collect()
}

#[derive(Debug, Clone, Copy)]
struct Match {
    source: [f32; 3],
    target: [f32; 3],
    normal: [f32; 3],
    /// 1 / variance of the two depths.
    weight: f32,
}

/// One dense edge and its current association.
#[derive(Debug)]
pub(crate) struct DenseTerm<'a> {
    pub(crate) edge: usize,
    pub(crate) source: usize,
    pub(crate) target: usize,
    target_view: Target<'a>,
    matches: Vec<Match>,
    scale: f64,
    delta: f64,
}

impl<'a> DenseTerm<'a> {
    pub(crate) fn new(
        edge: usize,
        (source, target): (usize, usize),
        (source_view, target_view): (&'a DenseView, &'a DenseView),
        options: &SolveOptions,
    ) -> Self {
        let matches = Vec::with_capacity(options.max_dense_per_edge.min(source_view.points.len()));
        let delta = options.dense_huber;
        Self { edge, source, target, target_view: Target::new(target_view), matches, scale: 0.0, delta }
    }

    /// Re-associates the sampled source pixels at the given poses.
    pub(crate) fn associate(
        &mut self,
        poses: &[Isometry3<f64>],
        samples: &[Sample],
        gates: &Gates,
        options: &SolveOptions,
    ) {
        self.matches.clear();
        let target_from_source = poses[self.target].inv_mul(&poses[self.source]);
        if target_from_source.rotation.angle() > options.max_pair_rotation {
            return;
        }
        let transform = Rigid::<f32>::new(&target_from_source);
        for sample in samples {
            let n = transform.direction(sample.normal);
            let Some(best) = self.target_view.nearest_compatible(transform.point(sample.point), n, gates)
            else {
                continue;
            };
            let target = self.target_view.view.points[best];
            let weight = 1.0 / (sample.variance + options.depth_variance(f64::from(target[2])) as f32);
            if weight.is_finite() {
                let normal = bisector(self.target_view.view.normals[best], n);
                self.matches.push(Match { source: sample.point, target, normal, weight });
            }
        }
        let cap = options.dense_cap / (self.matches.len() as f64);
        self.scale = options.dense_weight * cap.min(1.0);
    }

    /// Calls `f(residual, row of the target in the target's camera frame, weight)` for every match.
    #[inline(always)]
    fn for_each(&self, poses: &[Isometry3<f64>], mut f: impl FnMut(f64, &[f64; 6], f64)) {
        let transform = Rigid::<f64>::new(&poses[self.target].inv_mul(&poses[self.source]));
        for m in &self.matches {
            let (r, row) = plane_residual(widen(m.normal), widen(m.target), transform.point(m.source));
            f(r, &row, f64::from(m.weight));
        }
    }

    pub(crate) fn cost(&self, poses: &[Isometry3<f64>]) -> f64 {
        let mut sum = 0.0;
        self.for_each(poses, |r, _, weight| sum += weight * huber(r.abs(), self.delta).0);
        self.scale * sum
    }

    pub(crate) fn linearise(&self, poses: &[Isometry3<f64>], normal: &mut NormalEquations) -> f64 {
        let mut sums = RowSums::default();
        let mut cost = 0.0;
        self.for_each(poses, |r, row, weight| {
            let (rho, w) = huber(r.abs(), self.delta);
            cost += weight * rho;
            sums.add(row, self.scale * weight * w, r);
        });
        let (h, g) = sums.finish();
        let lift = lift(&poses[self.target]);
        let (h, g) = (lift * h * lift.transpose(), lift * g);
        normal.add(self.target, &h, &g);
        normal.add(self.source, &h, &-g);
        normal.add_cross(self.target, self.source, &-h);
        self.scale * cost
    }

    pub(crate) fn residuals(&self, poses: &[Isometry3<f64>], all: &mut Residuals) -> usize {
        let mut inliers = 0;
        self.for_each(poses, |r, _, weight| inliers += usize::from(all.add(r, self.delta, weight)));
        inliers
    }

    /// Adds the object-frame points if `node` takes part.
    pub(crate) fn extent(&self, node: usize, poses: &[Rigid], extent: &mut Extent) {
        if node == self.source || node == self.target {
            self.matches.iter().for_each(|m| extent.add(poses[self.source].point(m.source)));
        }
    }
}

/// Normal of the plane that a match is measured against: unit vector half way between two unit vectors that are less than a right angle apart.
#[inline(always)]
fn bisector(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    let s = [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
    let inverse = 1.0 / (s[0] * s[0] + s[1] * s[1] + s[2] * s[2]).sqrt();
    [s[0] * inverse, s[1] * inverse, s[2] * inverse]
}

/// A target view with what its association needs precomputed.
#[derive(Debug, Clone, Copy)]
struct Target<'a> {
    view: &'a DenseView,
    fx: f32,
    fy: f32,
    cx: f32,
    cy: f32,
    /// Metres per pixel of offset and metre of depth that a ray at least keeps from a point.
    reach: f32,
}

impl<'a> Target<'a> {
    fn new(view: &'a DenseView) -> Self {
        // The ray of a pixel `k` pixels from the projection of a point at depth z passes it at a distance of at
        // least `k z / f` times the cosine of the ray's angle, which is smallest in a corner of the image.
        let x = view.cx.abs().max((view.width as f64 - view.cx).abs()) / view.fx;
        let y = view.cy.abs().max((view.height as f64 - view.cy).abs()) / view.fy;
        let reach = 1.0 / ((1.0 + x * x + y * y).sqrt() * view.fx.max(view.fy));
        let (fx, fy, cx, cy) = (view.fx as f32, view.fy as f32, view.cx as f32, view.cy as f32);
        Self { view, fx, fy, cx, cy, reach: reach as f32 }
    }

    /// Pixel that minimises `distance / max_distance + (1 - n . n')` in a window around the projection of `p` (this
    /// camera's frame), among those that pass both gates. Invalid pixels never pass: a zero or NaN normal fails the
    /// angle gate, and a NaN point the distance gate.
    ///
    /// Goes outward ring by ring and stops when no farther pixel can score better: near convergence that is after
    /// one or two rings, whatever the radius.
    #[inline(always)]
    fn nearest_compatible(&self, p: [f32; 3], n: [f32; 3], gates: &Gates) -> Option<usize> {
        if p[2].is_nan() || p[2] <= 0.0 {
            return None;
        }
        let inverse_depth = 1.0 / p[2];
        let u = nearest_pixel(self.fx * p[0] * inverse_depth + self.cx);
        let v = nearest_pixel(self.fy * p[1] * inverse_depth + self.cy);
        let (width, height) = (self.view.width as i64, self.view.height as i64);
        let radius = gates.radius.min(self.view.width.max(self.view.height)) as i64;
        if u + radius < 0 || v + radius < 0 || u - radius >= width || v - radius >= height {
            return None;
        }
        let mut search = Search {
            target: self,
            p,
            n,
            gates,
            best: None,
            max_squared: gates.max_distance * gates.max_distance,
        };
        for ring in 0..=radius {
            let nearest = (ring as f32 - 0.5).max(0.0) * p[2] * self.reach;
            if nearest * nearest > search.max_squared {
                break;
            }
            for row in (v - ring).max(0)..=(v + ring).min(height - 1) {
                let start = row as usize * self.view.width;
                if (row - v).abs() == ring {
                    for column in (u - ring).max(0)..=(u + ring).min(width - 1) {
                        search.visit(start + column as usize);
                    }
                } else {
                    for column in [u - ring, u + ring] {
                        if column >= 0 && column < width {
                            search.visit(start + column as usize);
                        }
                    }
                }
            }
        }
        search.best
    }
}

/// Rounds to the nearest integer; NaN becomes 0 (no gate lets it pass).
#[inline(always)]
fn nearest_pixel(x: f32) -> i64 {
    // Truncation after a shift to positive values: `round` is a library call on the baseline instruction set.
    (f64::from(x.clamp(-1e6, 1e6)) + 1_000_000.5) as i64 - 1_000_000
}

/// State of one search.
struct Search<'t, 'v> {
    target: &'t Target<'v>,
    p: [f32; 3],
    n: [f32; 3],
    gates: &'t Gates,
    best: Option<usize>,
    /// A candidate farther than this cannot score better than the best so far.
    max_squared: f32,
}

impl Search<'_, '_> {
    #[inline(always)]
    fn visit(&mut self, pixel: usize) {
        let (p, n) = (&self.p, &self.n);
        let q = &self.target.view.points[pixel];
        let d = [q[0] - p[0], q[1] - p[1], q[2] - p[2]];
        let squared = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
        if squared.is_nan() || squared > self.max_squared || q[2] <= 0.0 {
            return;
        }
        let m = &self.target.view.normals[pixel];
        let cosine = n[0] * m[0] + n[1] * m[1] + n[2] * m[2];
        if cosine.is_nan() || cosine < self.gates.min_cosine {
            return;
        }
        let distance = squared.sqrt() + self.gates.max_distance * (1.0 - cosine).max(0.0);
        if self.best.is_none() || distance * distance < self.max_squared {
            self.best = Some(pixel);
            self.max_squared = self.max_squared.min(distance * distance);
        }
    }
}
