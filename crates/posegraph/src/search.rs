//! Re-projective association: the best pixel of a view for a point and its normal.

use crate::cloud::{Cloud, Samples};
use crate::lanes::{LANES, Lane, Placement, difference, dot};
use crate::options::Gates;
use crate::simd::Vector;
use crate::view::Pixel;

/// 1.5 * 2^23: adding it leaves no room for a fraction.
const TO_INTEGER: f32 = 12_582_912.0;
/// No pixel is as far as this from the principal point.
const FAR: f32 = 1e6;
/// Pixels that a float can count.
const COUNTABLE: usize = 1 << 23;

/// What eight samples found, in the target's camera frame.
pub(crate) struct Found<V> {
    /// Normals of the samples.
    pub(crate) n: [V; 3],
    /// Points and normals of the best pixels.
    pub(crate) q: [V; 3],
    pub(crate) m: [V; 3],
    /// Infinite where nothing passes the gates.
    pub(crate) score: V,
}

impl Cloud<'_> {
    /// For each of eight samples the pixel that minimises `distance / max_distance + (1 - n . n')` among those that pass
    /// both gates, in a window around its projection: the pixels less than the radius away in both directions.
    ///
    /// Compares the four pixels around all projections first, then all sixteen: near convergence the rays of all others
    /// pass too far away to score better. Only the rest is searched one by one.
    #[inline(always)]
    pub(crate) fn find<V: Vector>(
        &self,
        motion: &Placement<V>,
        samples: &Samples,
        gates: &Gates,
    ) -> Found<Lane> {
        let (zero, one, width) = (V::splat(0.0), V::splat(1.0), V::splat(self.width as f32));
        let p = motion.point(V::load3(&samples.point));
        let n = motion.direction(V::load3(&samples.normal));
        let ([left, top], reserve) = self.project_all(p);
        let at = top * width + left;
        let scale = p[2] * V::splat(self.reach);
        let gate = (V::splat(gates.max_distance), V::splat(gates.min_cosine));
        let mut found = Found { n, q: [zero; 3], m: [zero; 3], score: V::splat(f32::INFINITY) };

        let four = self.if_inside([left, top], 1, V::if_less(zero, p[2], self.countable(), zero));
        for offset in [zero, one, width, width + one] {
            self.compare_at(&mut found, p, V::if_less(zero, four, at + offset, zero), gate);
        }
        let limit = found.score.min(gate.0);
        let mut settled =
            if gates.radius == 1 { four } else { V::if_less(limit, (one + reserve) * scale, four, zero) };
        let mut sixteen = zero;
        if gates.radius > 1 && has_zero(settled.lane()) {
            sixteen = self.if_inside([left, top], 2, four);
            let two = one + one;
            for row in [zero - width, zero, width, width * two] {
                self.compare_at(&mut found, p, V::if_less(zero, sixteen, at + row - one, zero), gate);
                self.compare_at(&mut found, p, V::if_less(zero, sixteen, at + row + two, zero), gate);
            }
            for offset in [zero - width, one - width, width * two, width * two + one] {
                self.compare_at(&mut found, p, V::if_less(zero, sixteen, at + offset, zero), gate);
            }
            let (limit, far) = (found.score.min(gate.0), (one + one + reserve) * scale);
            let done = if gates.radius == 2 { sixteen } else { V::if_less(limit, far, sixteen, zero) };
            settled = settled.max(done);
        }
        let mut found = Found {
            n: [found.n[0].lane(), found.n[1].lane(), found.n[2].lane()],
            q: [found.q[0].lane(), found.q[1].lane(), found.q[2].lane()],
            m: [found.m[0].lane(), found.m[1].lane(), found.m[2].lane()],
            score: found.score.lane(),
        };
        let settled = settled.lane();
        if has_zero(settled) {
            let p = [p[0].lane(), p[1].lane(), p[2].lane()];
            self.find_alone(&mut found, &p, gates, (&settled, &sixteen.lane()));
        }
        found
    }

    /// One if all indices of pixels are integers in single precision, otherwise zero.
    #[inline(always)]
    fn countable<V: Vector>(&self) -> V {
        V::splat(f32::from(u8::from(self.view.pixels.len() < COUNTABLE)))
    }

    /// `then` where the window of this radius lies in the image, otherwise zero.
    #[inline(always)]
    fn if_inside<V: Vector>(&self, [left, top]: [V; 2], radius: i32, then: V) -> V {
        let (first, zero) = (V::splat((radius - 1) as f32), V::splat(0.0));
        let last = |size: i32| V::splat((size - 1 - radius) as f32);
        let (right, bottom) = (last(self.width), last(self.height));
        let then = V::if_at_most(first, left, V::if_at_most(left, right, then, zero), zero);
        V::if_at_most(first, top, V::if_at_most(top, bottom, then, zero), zero)
    }

    /// Compares the best so far with the pixels of these indices; index zero stands for none.
    #[inline(always)]
    fn compare_at<V: Vector>(&self, found: &mut Found<V>, p: [V; 3], at: V, gate: (V, V)) {
        let [q, m] = V::gather(&self.view.pixels, at);
        found.compare(p, q, m, gate);
    }

    /// The pixel (column, row) to the top left of each projection, and how far the projection is from the border of its
    /// four pixels at least, in pixels.
    #[inline(always)]
    fn project_all<V: Vector>(&self, p: [V; 3]) -> ([V; 2], V) {
        let (zero, one) = (V::splat(0.0), V::splat(1.0));
        let inverse_depth = one / p[2];
        let x = V::splat(self.fx) * p[0] * inverse_depth + V::splat(self.cx);
        let y = V::splat(self.fy) * p[1] * inverse_depth + V::splat(self.cy);
        let (u, v) = (nearest_pixels(x), nearest_pixels(y));
        let (dx, dy) = (x - u, y - v);
        let corner = [V::if_less(dx, zero, u - one, u), V::if_less(dy, zero, v - one, v)];
        (corner, dx.abs().min(dy.abs()))
    }

    /// Where a point projects to; `None` behind the camera.
    fn project(&self, p: [f32; 3]) -> Option<Position> {
        if p[2].is_nan() || p[2] <= 0.0 {
            return None;
        }
        let inverse_depth = 1.0 / p[2];
        let (x, y) = (self.fx * p[0] * inverse_depth + self.cx, self.fy * p[1] * inverse_depth + self.cy);
        let in_reach = x.abs() < FAR && y.abs() < FAR;
        in_reach.then(|| Position { left: x.floor() as i32, top: y.floor() as i32, x, y })
    }

    /// The rest of the search for the lanes that are not settled; where `has_sixteen`, beyond the nearest sixteen pixels.
    fn find_alone(
        &self,
        found: &mut Found<Lane>,
        p: &[Lane; 3],
        gates: &Gates,
        (settled, has_sixteen): (&Lane, &Lane),
    ) {
        let of = |lanes: &[Lane; 3], l: usize| [lanes[0][l], lanes[1][l], lanes[2][l]];
        for l in (0..LANES).filter(|&l| settled[l] == 0.0) {
            let first_ring = if has_sixteen[l] > 0.0 { 3 } else { 1 };
            if first_ring == 1 {
                found.score[l] = f32::INFINITY;
            }
            let (p, n) = (of(p, l), of(&found.n, l));
            let mut search = Search { p, n, gates, best: Search::start(found.score[l]) };
            if let Some(at) = self.project(p) {
                self.search_rings(&mut search, at, first_ring);
            }
            if let Some(pixel) = search.found()
                && let Some(Pixel { point, normal }) = self.view.pixels.get(pixel)
            {
                found.score[l] = search.limit();
                for k in 0..3 {
                    found.q[k][l] = point[k];
                    found.m[k][l] = normal[k];
                }
            }
        }
    }

    /// Goes outward ring by ring, each the border of a window, and leaves out all pixels whose rays pass too far away
    /// to score better.
    fn search_rings(&self, search: &mut Search<'_>, Position { left, top, x, y }: Position, first_ring: i32) {
        let (fx, fy) = (x - left as f32, y - top as f32);
        let reserve = fx.min(1.0 - fx).min(fy).min(1.0 - fy);
        // No pixel is farther than this.
        let farthest = (left + 1).max(self.width - left).max(top + 1).max(self.height - top).max(0);
        let radius = search.gates.radius.min(farthest as usize) as i32;
        let scale = search.p[2] * self.reach;
        for ring in first_ring..=radius {
            let k = ring as f32 - 1.0;
            if ring > 1 && (k + reserve) * scale > search.limit() {
                break;
            }
            let (from, to) = ((left - ring + 1).max(0), (left + ring).min(self.width - 1));
            for (row, offset) in [(top - ring + 1, k + fy), (top + ring, k + 1.0 - fy)] {
                if row >= 0 && row < self.height && (ring == 1 || offset * scale <= search.limit()) {
                    self.visit(search, row, from, to);
                }
            }
            for (column, offset) in [(left - ring + 1, k + fx), (left + ring, k + 1.0 - fx)] {
                if column >= 0 && column < self.width && offset * scale <= search.limit() {
                    for row in (top - ring + 2).max(0)..(top + ring).min(self.height) {
                        self.visit(search, row, column, column);
                    }
                }
            }
        }
    }

    /// Compares the best so far with the pixels of a row from one column to another, both inside.
    #[inline(always)]
    fn visit(&self, search: &mut Search<'_>, row: i32, from: i32, to: i32) {
        let start = (row * self.width + from) as usize;
        let range = start..start + (to + 1 - from).max(0) as usize;
        for (k, pixel) in self.view.pixels.get(range).unwrap_or_default().iter().enumerate() {
            search.best = search.best.min(search.key(&pixel.point, &pixel.normal, start + k));
        }
    }
}

impl<V: Vector> Found<V> {
    /// Takes the pixels (points `q`, normals `m`) that pass the gates and score better than the best so far; the same
    /// arithmetic as [`Search::key`].
    #[inline(always)]
    fn compare(&mut self, p: [V; 3], q: [V; 3], m: [V; 3], (max_distance, min_cosine): (V, V)) {
        let (zero, none) = (V::splat(0.0), V::splat(f32::INFINITY));
        let d = difference(q, p);
        let distance = dot(d, d).sqrt();
        let cosine = dot(self.n, m);
        let turn = (V::splat(1.0) - cosine).max(zero);
        let score = V::if_at_most(distance, max_distance, distance + max_distance * turn, none);
        let score = V::if_less(zero, q[2], V::if_at_most(min_cosine, cosine, score, none), none);
        for k in 0..3 {
            self.q[k] = V::if_less(score, self.score, q[k], self.q[k]);
            self.m[k] = V::if_less(score, self.score, m[k], self.m[k]);
        }
        self.score = V::if_less(score, self.score, score, self.score);
    }
}

/// A projection, and the pixel (column, row) to its top left.
#[derive(Debug, Clone, Copy)]
struct Position {
    left: i32,
    top: i32,
    x: f32,
    y: f32,
}

/// Rounds to the nearest integer; what is too far away (or NaN) ends outside of every image.
#[inline(always)]
fn nearest_pixels<V: Vector>(x: V) -> V {
    let (low, high) = (V::splat(-FAR), V::splat(FAR));
    let x = V::if_less(low, x, x, low);
    V::if_less(x, high, x, high) + V::splat(TO_INTEGER) - V::splat(TO_INTEGER)
}

#[inline(always)]
fn has_zero(lane: Lane) -> bool {
    lane.iter().fold(false, |any, x| any | (*x == 0.0))
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

    /// Before any pixel, when one with this score is known (infinite = none).
    fn start(score: f32) -> u64 {
        if score < f32::INFINITY { (u64::from(score.to_bits()) << 32) | 0xFFFF_FFFF } else { Self::NONE }
    }

    /// Score and index of a pixel (point `q`, normal `m`), or `NONE` if a gate stops it. Invalid pixels never pass: a
    /// zero or NaN normal fails the angle gate, a NaN point the distance gate.
    #[inline(always)]
    fn key(&self, q: &[f32; 4], m: &[f32; 4], index: usize) -> u64 {
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

    /// A pixel that beats the start.
    #[inline(always)]
    fn found(&self) -> Option<usize> {
        let index = self.best & 0xFFFF_FFFF;
        (index != 0xFFFF_FFFF).then_some(index as usize)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::matches::Matches;
    use crate::options::SolveOptions;
    use crate::simd::{self, Portable};
    use crate::transform::Rigid;
    use crate::view::{DenseView, Pinhole};

    const IDENTITY: Rigid<f32> = Rigid { r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], t: [0.0; 3] };

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
        DenseView::new((width, height), Pinhole { fx: focal, fy: focal, cx, cy }, &points, &normals).unwrap()
    }

    /// Best score in the window, pixel by pixel.
    fn exhaustive(view: &DenseView, p: [f32; 3], n: [f32; 3], gates: &Gates) -> Option<f32> {
        let camera = view.camera;
        let project = |c: f32, f: f64, centre: f64| (f as f32 * c * (1.0 / p[2]) + centre as f32).floor();
        let (u, v) = (project(p[0], camera.fx, camera.cx), project(p[1], camera.fy, camera.cy));
        let mut best: Option<f32> = None;
        for (k, Pixel { point: q, normal: m }) in view.pixels.iter().enumerate() {
            let offset = [(k % view.width) as f32 - u, (k / view.width) as f32 - v];
            let radius = gates.radius as f32;
            let inside = offset.iter().all(|&o| o > -radius && o <= radius);
            let distance = (0..3).map(|c| (q[c] - p[c]) * (q[c] - p[c])).sum::<f32>().sqrt();
            let cosine = (0..3).map(|c| n[c] * m[c]).sum::<f32>();
            let passes = distance <= gates.max_distance && cosine >= gates.min_cosine && q[2] > 0.0;
            if passes && inside {
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
            radius in 1usize..5,
            max_distance in 0.003f32..0.05,
        ) {
            let mut rng = Pcg64Mcg::seed_from_u64(seed);
            let view = view(&mut rng, width, height);
            let cloud = Cloud::new(&view, &SolveOptions::default(), (800, 100));
            let gates = Gates { radius, max_distance, min_cosine: 0.8, feature: [2.5, 15.0], last: true };
            for _ in 0..8 {
                let mut vector = || [0; LANES].map(|_| rng.random_range(-1.0f32..1.0));
                let [x, y, z, slant] = std::array::from_fn(|_| vector());
                let samples = Samples {
                    point: [x.map(|x| 0.08 * x), y.map(|y| 0.08 * y), z.map(|z| 0.505 + 0.025 * z)],
                    normal: [slant.map(|s| 0.3 * s), [0.0; LANES], [-0.95; LANES]],
                    variance: [1e-6; LANES],
                };
                let found = cloud.find(&Placement::<Portable>::new(&IDENTITY), &samples, &gates);
                for l in 0..LANES {
                    let of = |lanes: &[Lane; 3]| lanes.map(|lane| lane[l]);
                    let wide = |lanes: &[Lane; 3]| [lanes[0][l], lanes[1][l], lanes[2][l], 0.0];
                    let (p, n) = (of(&samples.point), of(&samples.normal));
                    let expected = exhaustive(&view, p, n, &gates);
                    prop_assert_eq!(found.score[l] < f32::INFINITY, expected.is_some());
                    if let Some(expected) = expected {
                        let search = Search { p, n, gates: &gates, best: Search::NONE };
                        let score = f32::from_bits((search.key(&wide(&found.q), &wide(&found.m), 0) >> 32) as u32);
                        prop_assert!((score - expected).abs() <= 1e-6 * expected, "{} {}", score, expected);
                    }
                }
                let mut matches = [(); 2].map(|()| Matches::default());
                matches.iter_mut().for_each(|m| m.set_centres([0.0; 3], [0.0; 3], &SolveOptions::default()));
                matches[0].search::<Portable>(&IDENTITY, (&cloud, &cloud), &gates);
                simd::search(&mut matches[1], &IDENTITY, (&cloud, &cloud), &gates);
                let [portable, wide] = matches.each_ref().map(Matches::blocks);
                prop_assert_eq!(portable, wide, "every instruction set: the same bits");
            }
        }
    }

    #[test]
    fn points_that_do_not_project_find_nothing() {
        let view = view(&mut Pcg64Mcg::seed_from_u64(1), 9, 9);
        let gates = Gates {
            radius: usize::MAX,
            max_distance: 10.0,
            min_cosine: 0.1,
            feature: [2.5, 15.0],
            last: true,
        };
        let cloud = Cloud::new(&view, &SolveOptions::default(), (800, 100));
        let find = |p: [f32; 3]| {
            let samples = Samples {
                point: p.map(|c| [c; LANES]),
                normal: [0.0, 0.0, -1.0].map(|c| [c; LANES]),
                variance: [1e-6; LANES],
            };
            let found = cloud.find(&Placement::<Portable>::new(&IDENTITY), &samples, &gates);
            found.score.map(|s| s < f32::INFINITY)
        };
        for p in [[0.0, 0.0, -0.5], [0.0, 0.0, 0.0], [0.0, 0.0, f32::NAN], [f32::NAN, 0.0, 0.5]] {
            assert_eq!(find(p), [false; LANES], "{p:?}");
        }
        for p in [[f32::MAX, 0.0, 1e-30], [f32::INFINITY, f32::NEG_INFINITY, 0.5], [1e9, 1e9, 0.5]] {
            assert_eq!(find(p), [false; LANES], "{p:?}");
        }
        assert_eq!(find([0.0, 0.0, 0.5]), [true; LANES]);
    }
}
