//! Sums over matched points of a feature edge in single precision, eight at a time, about a centre near the points.
//!
//! A match compares two measurements of one point, each known well across its ray, by the image, and badly along it, by
//! the depth: with `rho` the distance from its camera and `d` the direction of the ray, its covariance is
//! `S = across I + (along - across) d d^T`, `across = (angle rho)^2`, `along = (a + b rho^2)^2`. The difference `r` of the
//! two then counts by `W = (S_i + S_j)^-1`, and `p = x - S_i W r` is where the point most likely is.

use crate::jacobian::MatchSums;
use crate::lanes::{Lane, Placement, cross, difference, dot, huber};
use crate::options::SolveOptions;
use crate::simd::Vector;
use crate::stats::{self, Tally};
use crate::transform::Rigid;

/// Blocks that are summed in single precision.
const CHUNK: usize = 8;
/// Square of the least distance from a camera and least variance, square metres: what is divided by.
const NEAREST: f32 = 1e-6;
const FINEST: f32 = 1e-12;

/// Eight matches: component by component, relative to the centres of both clouds. Unused lanes have weight zero.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Block {
    p: [Lane; 3],
    q: [Lane; 3],
    weight: Lane,
}

impl Block {
    /// Stores a match: each point with its centre.
    pub(crate) fn set_lane(
        &mut self,
        l: usize,
        p: ([f32; 3], [f32; 3]),
        q: ([f32; 3], [f32; 3]),
        weight: f32,
    ) {
        for k in 0..3 {
            self.p[k][l] = p.0[k] - p.1[k];
            self.q[k][l] = q.0[k] - q.1[k];
        }
        self.weight[l] = weight;
    }

    /// One side's point of a match, with its centre.
    pub(crate) fn point(&self, l: usize, first: bool, centre: [f32; 3]) -> [f32; 3] {
        let lanes = if first { &self.p } else { &self.q };
        std::array::from_fn(|k| lanes[k][l] + centre[k])
    }
}

/// What a camera knows of a point.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RayNoise {
    /// Standard deviation across the ray over the distance.
    pub(crate) angle: f32,
    /// Standard deviation along the ray `a + b rho^2`, metres.
    pub(crate) depth: [f32; 2],
}

impl RayNoise {
    pub(crate) fn new(options: &SolveOptions) -> Self {
        Self {
            angle: options.feature_angle as f32,
            depth: [options.depth_sigma_constant as f32, options.depth_sigma_quadratic as f32],
        }
    }
}

/// The two sides of an edge: motions of the points about their centres, and where the cameras are, all relative to one
/// point of the object frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pair {
    pub(crate) motions: [Rigid<f32>; 2],
    pub(crate) cameras: [[f32; 3]; 2],
    pub(crate) noise: RayNoise,
    /// Huber threshold and saturation, standard deviations.
    pub(crate) robust: [f32; 2],
}

/// [`Pair`] for eight matches at a time.
struct Sides<V> {
    motions: [Placement<V>; 2],
    cameras: [[V; 3]; 2],
    angle: V,
    depth: [V; 2],
    robust: [V; 2],
}

/// Huber's loss up to `saturation`, then on to a bound as `1 / e` falls: the loss times the weight, and the weight of the
/// residual in the normal equations; `e >= 0`.
#[inline(always)]
fn saturating<V: Vector>(e: V, weight: V, [delta, saturation]: [V; 2]) -> (V, V) {
    let (rho, w) = huber(e.min(saturation), weight, delta);
    let (one, fall) = (V::splat(1.0), saturation / e.max(saturation));
    let slope = w * e.min(saturation);
    (rho + slope * saturation * (one - fall), w * fall * fall * fall)
}

impl<V: Vector> Sides<V> {
    #[inline(always)]
    fn new(pair: &Pair) -> Self {
        let [a, b] = &pair.motions;
        let [i, j] = pair.cameras;
        let camera = |c: [f32; 3]| [V::splat(c[0]), V::splat(c[1]), V::splat(c[2])];
        let [constant, quadratic] = pair.noise.depth;
        Self {
            motions: [Placement::new(a), Placement::new(b)],
            cameras: [camera(i), camera(j)],
            angle: V::splat(pair.noise.angle),
            depth: [V::splat(constant), V::splat(quadratic)],
            robust: [V::splat(pair.robust[0]), V::splat(pair.robust[1])],
        }
    }

    /// Direction of the ray to `x` from the camera of a side, the variance across it, and what the variance along it has
    /// more.
    #[inline(always)]
    fn ray(&self, side: usize, x: [V; 3]) -> ([V; 3], V, V) {
        let u = difference(x, self.cameras[side]);
        let square = dot(u, u).max(V::splat(NEAREST));
        let scale = V::splat(1.0) / square.sqrt();
        let deviation = self.depth[0] + self.depth[1] * square;
        let finest = V::splat(FINEST);
        let across = (self.angle * self.angle * square).max(finest);
        ([u[0] * scale, u[1] * scale, u[2] * scale], across, (deviation * deviation).max(finest) - across)
    }
}

/// Eight matches at the poses of their sides.
struct Placed<V> {
    x: [V; 3],
    r: [V; 3],
    d: [[V; 3]; 2],
    /// Variance across the ray of `x`, and what there is more along it.
    first: [V; 2],
    /// `W = (I - k11 d1 d1^T - k12 (d1 d2^T + d2 d1^T) - k22 d2 d2^T) / across` (the inverse of a matrix of rank two and a
    /// multiple of the identity): `1 / across` and `k11, k12, k22` over `across`.
    w: [V; 4],
    /// `W r`.
    v: [V; 3],
    /// `(r^T W r)^1/2`.
    e: V,
}

impl Block {
    #[inline(always)]
    fn place<V: Vector>(&self, sides: &Sides<V>) -> Placed<V> {
        let (x, y) = (sides.motions[0].point(V::load3(&self.p)), sides.motions[1].point(V::load3(&self.q)));
        let r = difference(x, y);
        let (d1, across_i, a) = sides.ray(0, x);
        let (d2, across_j, b) = sides.ray(1, y);
        let (s, c) = (across_i + across_j, dot(d1, d2));
        let ab = a * b;
        let inverse = V::splat(1.0) / (s * ((s + a) * (s + b) - c * c * ab));
        let (k11, k22) = (a * (s + b) * inverse, b * (s + a) * inverse);
        let k12 = (V::splat(0.0) - c * ab) * inverse;
        let (along_1, along_2, across) = (dot(d1, r), dot(d2, r), V::splat(1.0) / s);
        let (m1, m2) = (k11 * along_1 + k12 * along_2, k12 * along_1 + k22 * along_2);
        let mut v = r;
        for k in 0..3 {
            v[k] = across * r[k] - d1[k] * m1 - d2[k] * m2;
        }
        let e = dot(r, v).max(V::splat(0.0)).sqrt();
        Placed { x, r, d: [d1, d2], first: [across_i, a], w: [across, k11, k12, k22], v, e }
    }
}

impl<V: Vector> Placed<V> {
    /// Where the point most likely is.
    #[inline(always)]
    fn point(&self) -> [V; 3] {
        let [across, more] = self.first;
        let more = more * dot(self.d[0], self.v);
        let mut p = self.x;
        for k in 0..3 {
            p[k] = self.x[k] - across * self.v[k] - more * self.d[0][k];
        }
        p
    }

    /// `W`, row by row.
    #[inline(always)]
    fn information(&self) -> [[V; 3]; 3] {
        let ([d1, d2], [across, k11, k12, k22]) = (&self.d, self.w);
        let mut w = [self.r; 3];
        for a in 0..3 {
            let (m1, m2) = (k11 * d1[a] + k12 * d2[a], k12 * d1[a] + k22 * d2[a]);
            for b in 0..3 {
                let diagonal = if a == b { across } else { V::splat(0.0) };
                w[a][b] = diagonal - m1 * d1[b] - m2 * d2[b];
            }
        }
        w
    }
}

/// Sum of the weighted losses.
#[inline(always)]
pub(crate) fn cost<V: Vector>(blocks: &[Block], pair: &Pair) -> f64 {
    let sides = Sides::<V>::new(pair);
    let mut cost = 0.0;
    for chunk in blocks.chunks(CHUNK) {
        let mut sum = V::splat(0.0);
        for block in chunk {
            let e = block.place(&sides).e;
            sum = sum + saturating(e, V::load(&block.weight), sides.robust).0;
        }
        cost += sum.total();
    }
    cost
}

/// Lanes of [`MatchSums`].
struct Sums<V> {
    w: [V; 6],
    wp: [V; 9],
    pwp: [V; 6],
    g: [V; 6],
}

impl<V: Vector> Sums<V> {
    #[inline(always)]
    fn zero() -> Self {
        let zero = V::splat(0.0);
        Self { w: [zero; 6], wp: [zero; 9], pwp: [zero; 6], g: [zero; 6] }
    }

    /// Adds `[I | -[p]x]^T W [I | -[p]x]` and `[v; p x v]`, times the weight.
    #[inline(always)]
    fn add(&mut self, placed: &Placed<V>, weight: V) {
        let (p, w, v) = (placed.point(), placed.information(), placed.v);
        let turn = cross(p, v);
        let mut rows = w;
        for a in 0..3 {
            self.g[a] = self.g[a] + weight * v[a];
            self.g[3 + a] = self.g[3 + a] + weight * turn[a];
            rows[a] = cross(p, [weight * w[a][0], weight * w[a][1], weight * w[a][2]]);
        }
        let mut triangle = 0;
        for a in 0..3 {
            let column = cross(p, [rows[0][a], rows[1][a], rows[2][a]]);
            for b in 0..3 {
                self.wp[3 * a + b] = self.wp[3 * a + b] + rows[a][b];
            }
            for b in 0..=a {
                self.w[triangle] = self.w[triangle] + weight * w[a][b];
                self.pwp[triangle] = self.pwp[triangle] + column[b];
                triangle += 1;
            }
        }
    }

    #[inline(always)]
    fn add_to(&self, sums: &mut MatchSums) {
        for k in 0..6 {
            sums.w[k] += self.w[k].total();
            sums.pwp[k] += self.pwp[k].total();
            sums.g[k] += self.g[k].total();
        }
        for k in 0..9 {
            sums.wp[k] += self.wp[k].total();
        }
    }
}

/// Blocks of the normal equations, and the sum of the weighted losses.
#[inline(always)]
pub(crate) fn sums<V: Vector>(blocks: &[Block], pair: &Pair) -> (MatchSums, f64) {
    let sides = Sides::<V>::new(pair);
    let mut all = MatchSums::default();
    let mut cost = 0.0;
    for chunk in blocks.chunks(CHUNK) {
        let mut sums = Sums::<V>::zero();
        let mut sum = V::splat(0.0);
        for block in chunk {
            let placed = block.place(&sides);
            let (rho, w) = saturating(placed.e, V::load(&block.weight), sides.robust);
            sum = sum + rho;
            sums.add(&placed, w);
        }
        cost += sum.total();
        sums.add_to(&mut all);
    }
    (all, cost)
}

/// How well the matches agree, in standard deviations.
#[inline(always)]
pub(crate) fn tally<V: Vector>(blocks: &[Block], pair: &Pair) -> Tally {
    let sides = Sides::<V>::new(pair);
    let mut tally = Tally::default();
    for chunk in blocks.chunks(CHUNK) {
        let mut sums = stats::Sums::<V>::default();
        for block in chunk {
            let (e, weight) = (block.place(&sides).e, V::load(&block.weight));
            let (_, w) = saturating(e, weight, sides.robust);
            sums.add_robust(e, weight, w, sides.robust[0]);
        }
        sums.add_to(&mut tally);
    }
    tally
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Matrix6, Vector3, Vector6};
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::jacobian::ExactMatch;
    use crate::lanes::LANES;
    use crate::simd::{self, Portable};
    use crate::stats::Residuals;

    const NOISE: [f64; 3] = [0.000_5, 0.001, 0.002];
    const ROBUST: [f64; 2] = [2.5, 4.0];

    /// [`super::saturating`] in double precision.
    fn robust(e: f64) -> (f64, f64) {
        let [delta, saturation] = ROBUST;
        if e <= saturation {
            return crate::jacobian::huber(e, delta);
        }
        let (rho, _) = crate::jacobian::huber(saturation, delta);
        (rho + delta * saturation * (1.0 - saturation / e), delta * saturation.powi(2) / e.powi(3))
    }

    #[test]
    fn the_weight_is_the_slope_of_a_loss_without_steps_and_with_a_bound() {
        let limits = ROBUST.map(|x| Portable::splat(x as f32));
        for e in [0.0, 1.0, 2.49, 2.51, 3.99, 4.01, 10.0, 1e4] {
            let (rho, w) = robust(e);
            let h = 1e-6;
            let slope = (robust(e + h).0 - robust((e - h).abs()).0) / (2.0 * h);
            assert!((slope - w * e).abs() < 1e-5, "{e}: {slope} {}", w * e);
            let lanes = saturating(Portable::splat(e as f32), Portable::splat(1.0), limits);
            let lanes = [lanes.0, lanes.1].map(|v| f64::from(v.lane()[0]));
            assert!((lanes[0] - rho).abs() < 1e-5 * (1.0 + rho) && (lanes[1] - w).abs() < 1e-5, "{e}");
        }
        let [delta, saturation] = ROBUST;
        assert!(robust(1e9).0 <= delta * (2.0 * saturation - 0.5 * delta) + 1e-9);
    }

    /// A point half a metre in front of two cameras, seen by both with some error.
    fn seen(rng: &mut Pcg64Mcg) -> ([f32; 3], [f32; 3], f32) {
        let p = [0.0, 0.0, 0.5].map(|c| c + rng.random_range(-0.1f32..0.1));
        let q = p.map(|c| c + rng.random_range(-0.002f32..0.002));
        (p, q, rng.random_range(0.1f32..2.0))
    }

    #[test]
    fn lanes_equal_double_precision_match_by_match() {
        let mut rng = Pcg64Mcg::seed_from_u64(9);
        let ti = Isometry3::new(Vector3::zeros(), Vector3::new(0.1, 0.4, -0.2));
        let tj = Isometry3::new(Vector3::new(0.02, 0.01, 0.0), Vector3::new(0.1, 0.44, -0.2));
        let pair = Pair {
            motions: [&ti, &tj].map(Rigid::<f32>::new),
            cameras: [ti, tj].map(|t| t.translation.vector.cast::<f32>().into()),
            noise: RayNoise { angle: NOISE[0] as f32, depth: [NOISE[1] as f32, NOISE[2] as f32] },
            robust: ROBUST.map(|x| x as f32),
        };
        for count in [0, 1, 8, 9, 64, 65, 203] {
            let (mut weights, mut squares, mut inliers) = (0.0, 0.0, 0.0);
            let mut blocks = vec![Block::default(); usize::div_ceil(count, LANES)];
            let (mut h, mut g, mut cost_64) = (Matrix6::zeros(), Vector6::zeros(), 0.0);
            for k in 0..count {
                let (p, q, weight) = seen(&mut rng);
                blocks[k / LANES].set_lane(k % LANES, (p, [0.0; 3]), (q, [0.0; 3]), weight);
                let points = [p, q].map(|p| Vector3::from(p).cast());
                let exact = ExactMatch::new((&ti, &tj), points.into(), NOISE);
                let (weight, e) = (f64::from(weight), exact.deviations());
                let (rho, w) = robust(e);
                let (block, gradient) = exact.blocks(weight * w);
                (h, g, cost_64) = (h + block, g + gradient, cost_64 + weight * rho);
                weights += weight * w;
                squares += weight * w * e * e;
                inliers += f64::from(u8::from(e <= ROBUST[0]));
            }
            let (got, got_cost) = sums::<Portable>(&blocks, &pair);
            let (got_h, got_g) = got.finish();
            assert!((got_h - h).amax() <= 1e-5 * h.amax(), "{count}: {got_h}{h}");
            assert!((got_g - g).amax() <= 1e-4 * (1e-3 + g.amax()), "{count}: {got_g}{g}");
            assert_eq!(simd::feature_sums(&blocks, &pair), (got, got_cost), "the same bits");
            assert!((got_cost - cost_64).abs() <= 1e-4 * cost_64);
            let costs = [cost::<Portable>, simd::feature_cost].map(|c| c(&blocks, &pair));
            assert_eq!(costs, [got_cost; 2], "the same sums, bit for bit");
            let tallies = [tally::<Portable>, simd::feature_tally].map(|t| t(&blocks, &pair));
            assert_eq!(tallies[0], tallies[1]);
            let mut counted = Residuals::default();
            assert_eq!(counted.add_edge(&tallies[0]) as f64, inliers);
            let rms = if weights > 0.0 { (squares / weights).sqrt() } else { 0.0 };
            assert!((counted.rms() - rms).abs() <= 1e-4 * rms);
        }
    }

    #[test]
    fn a_match_at_the_camera_itself_and_an_absurd_noise_stay_finite() {
        let still = Rigid::<f32>::new(&Isometry3::identity());
        let mut block = Block::default();
        block.set_lane(0, ([0.0; 3], [0.0; 3]), ([0.0, 0.0, 0.1], [0.0; 3]), 1.0);
        for (angle, depth) in [(1e-30, [1e-30, 0.0]), (0.000_5, [0.001, 0.002]), (1.0, [1e-30, 0.0])] {
            let noise = RayNoise { angle, depth };
            let pair = Pair { motions: [still; 2], cameras: [[0.0; 3]; 2], noise, robust: [2.5, 15.0] };
            let (sums, cost) = sums::<Portable>(&[block], &pair);
            assert!(cost.is_finite() && sums.finish().0.iter().all(|v| v.is_finite()), "{noise:?}");
        }
    }
}
