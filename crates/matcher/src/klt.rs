//! Following points from one image to the next: pyramidal Lucas-Kanade, inverse compositional.
//!
//! Lucas and Kanade 1981; Baker and Matthews, *Lucas-Kanade 20 years on*, IJCV 2004. The template is warped once into
//! the geometry of the target (roll, scale and foreshortening as predicted by the caller), so that the search itself is
//! a pure translation on a regular grid. Gain and bias between the two patches are eliminated in closed form: with the
//! template's Jacobian `J` projected onto the complement of the template `T` and the constant, the update is
//! `(J'WJ)^-1 J'WI / a`, where `a` is the gain and `W` a Gaussian window, which keeps what the warp does not predict from
//! pulling at the rim.

use crate::gray::{Pyramid, is_interior, sample_clamped, sample_interior};
use rgbd_io::Image;

/// How points are followed and which are believed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KltOptions {
    /// The window is `2 half_window + 1` pixels a side on every level.
    pub half_window: usize,
    /// Iterations a level.
    pub max_iterations: usize,
    /// An update smaller than this ends the iterations, pixels of the level.
    pub epsilon: f32,
    /// Smallest eigenvalue of the mean structure tensor of a followable patch, (gray levels per pixel)^2.
    pub min_eigenvalue: f32,
    /// Forward-backward: largest distance between a point and its return, pixels.
    pub max_forward_backward: f32,
    /// Forward-backward: smallest zero-mean normalised cross-correlation of the two patches.
    pub min_ncc: f32,
}

impl Default for KltOptions {
    fn default() -> Self {
        Self {
            half_window: 5,
            max_iterations: 12,
            epsilon: 0.02,
            min_eigenvalue: 0.25,
            max_forward_backward: 1.0,
            min_ncc: 0.75,
        }
    }
}

/// Where a point went.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Track {
    /// Position in the target frame, pixels.
    pub position: [f32; 2],
    /// Zero-mean normalised cross-correlation of the (warped) template and the patch at `position`, -1 to 1.
    pub ncc: f32,
    /// How well the template's texture ties the position down in its worst direction: the smaller eigenvalue of the
    /// mean structure tensor on the finest level, (gray levels per pixel)^2. An appearance that changes by `e` gray
    /// levels moves the position by about `e / sqrt(texture)` pixels.
    pub texture: f32,
}

/// The identity as a 2x2 row-major warp.
const IDENTITY: [f32; 4] = [1.0, 0.0, 0.0, 1.0];

/// Follows `points` of `from` to `to`.
///
/// `guesses[i]` is where point `i` is expected (the point itself if nothing is known); a missing guess is the point.
/// `warps[i]`, row-major 2x2, maps offsets from the point in `from` to offsets in `to`; a missing warp is the identity.
/// `None` for points that leave the image, have no texture, diverge, or come with a NaN or a singular warp.
pub fn track(
    from: &Pyramid,
    to: &Pyramid,
    points: &[[f32; 2]],
    guesses: &[[f32; 2]],
    warps: Option<&[[f32; 4]]>,
    options: &KltOptions,
) -> Vec<Option<Track>> {
    let mut window = Window::new(options);
    let each = |(i, &point): (usize, &[f32; 2])| {
        let guess = guesses.get(i).copied().unwrap_or(point);
        let warp = warps.and_then(|w| w.get(i)).copied().unwrap_or(IDENTITY);
        window.follow([from, to], usize::MAX, point, guess, inverse(warp)?, options)
    };
    points.iter().enumerate().map(each).collect()
}

/// [`track`], then back with the inverse warp: points that do not return to within
/// [`KltOptions::max_forward_backward`], or look different ([`KltOptions::min_ncc`]), are `None`.
///
/// Kalal et al., *Forward-backward error*, ICPR 2010. The way back starts with the offset of the guess reversed, not at
/// the point that it is meant to find.
pub fn track_forward_backward(
    from: &Pyramid,
    to: &Pyramid,
    points: &[[f32; 2]],
    guesses: &[[f32; 2]],
    warps: Option<&[[f32; 4]]>,
    options: &KltOptions,
) -> Vec<Option<Track>> {
    let mut window = Window::new(options);
    let mut each = |i: usize, point: [f32; 2]| {
        let guess = guesses.get(i).copied().unwrap_or(point);
        let warp = warps.and_then(|w| w.get(i)).copied().unwrap_or(IDENTITY);
        let there = window.follow([from, to], usize::MAX, point, guess, inverse(warp)?, options)?;
        if there.ncc < options.min_ncc {
            return None;
        }
        let start = [there.position[0] - (guess[0] - point[0]), there.position[1] - (guess[1] - point[1])];
        // The way back is as far from its start as the guess was from the answer: if that is near, two levels reach it.
        let correction = (there.position[0] - guess[0]).hypot(there.position[1] - guess[1]);
        let levels = if correction <= window.half as f32 { 2 } else { usize::MAX };
        let back = window.follow([to, from], levels, there.position, start, warp, options)?;
        let error = (back.position[0] - point[0]).hypot(back.position[1] - point[1]);
        (error <= options.max_forward_backward).then_some(there)
    };
    points.iter().enumerate().map(|(i, &p)| each(i, p)).collect()
}

/// Inverse of a row-major 2x2 matrix, unless it squeezes or stretches areas beyond use.
fn inverse(m: [f32; 4]) -> Option<[f32; 4]> {
    let det = m[0] * m[3] - m[1] * m[2];
    (det.abs() > 0.02 && det.abs() < 50.0).then(|| [m[3] / det, -m[1] / det, -m[2] / det, m[0] / det])
}

/// The patches of one point on one level, reused from point to point. Rows are padded to a multiple of four and
/// the whole to a multiple of eight; padding is zero in everything the target patch is multiplied with.
struct Window {
    half: usize,
    stride: usize,
    /// Warped template with one more pixel around, for its derivatives.
    ring: Vec<f32>,
    /// Weights of the current level, sum 1: `gaussian` on the finest, `flat` on the coarse ones, which need reach more
    /// than precision.
    weights: Vec<f32>,
    gaussian: Vec<f32>,
    flat: Vec<f32>,
    /// Template less its weighted mean, then times the weights.
    template: Vec<f32>,
    /// Jacobian less its parts along the constant and along the template, then times the weights.
    jx: Vec<f32>,
    jy: Vec<f32>,
    patch: Vec<f32>,
}

/// What is precomputed from the template: its energy, the inverse of the 2x2 normal matrix and its smaller eigenvalue.
struct Normal {
    energy: f32,
    inverse: [f32; 3],
    texture: f32,
}

impl Window {
    fn new(options: &KltOptions) -> Self {
        let half = options.half_window.clamp(2, 20);
        let side = 2 * half + 1;
        let stride = side.next_multiple_of(4);
        let length = (stride * side).next_multiple_of(8);
        let zeros = vec![0.0_f32; length];
        let window = |tap: &dyn Fn(usize) -> f32| {
            let sum: f32 = (0..side).map(tap).sum();
            let at = |i: usize| {
                let (x, y) = (i % stride, i / stride);
                if x < side && y < side { tap(x) * tap(y) / (sum * sum) } else { 0.0 }
            };
            (0..length).map(at).collect::<Vec<f32>>()
        };
        let gaussian = window(&|i| (-0.5 * ((i as f32 - half as f32) / (0.6 * half as f32)).powi(2)).exp());
        let flat = window(&|_| 1.0);
        Self {
            half,
            stride,
            ring: vec![0.0; (side + 2) * (side + 2)],
            weights: zeros.clone(),
            gaussian,
            flat,
            template: zeros.clone(),
            jx: zeros.clone(),
            jy: zeros.clone(),
            patch: zeros,
        }
    }

    fn follow(
        &mut self,
        [from, to]: [&Pyramid; 2],
        max_levels: usize,
        point: [f32; 2],
        guess: [f32; 2],
        from_target: [f32; 4],
        options: &KltOptions,
    ) -> Option<Track> {
        let p = [point[0] - from.origin()[0], point[1] - from.origin()[1]];
        let mut q = [guess[0] - to.origin()[0], guess[1] - to.origin()[1]];
        let finite = p.iter().chain(&q).chain(&from_target).all(|v| v.is_finite());
        let levels = from.levels().len().min(to.levels().len()).min(max_levels);
        if !finite || levels == 0 || !inside(&from.levels()[0], p) {
            return None;
        }
        let mut found_at = None;
        for level in (0..levels).rev() {
            let (image_a, image_b) = (&from.levels()[level], &to.levels()[level]);
            let scale = 1.0 / (1_u32 << level.min(31)) as f32;
            // The finer levels correct what a coarse one leaves.
            let epsilon = if level == 0 { options.epsilon } else { options.epsilon.max(0.1) };
            let start = [q[0] * scale, q[1] * scale];
            self.weights.copy_from_slice(if level == 0 { &self.gaussian } else { &self.flat });
            let normal =
                self.set_template(image_a, [p[0] * scale, p[1] * scale], from_target, options.min_eigenvalue);
            let found = normal.and_then(|n| {
                let (end, ncc) = self.search(image_b, start, &n, epsilon, options.max_iterations)?;
                Some((end, ncc, n.texture))
            });
            match found {
                Some((end, ncc, texture)) => {
                    q = [end[0] / scale, end[1] / scale];
                    found_at = Some((ncc, texture));
                }
                // A coarse level without texture or convergence just doesn't help.
                None if level > 0 => {}
                None => return None,
            }
        }
        let (ncc, texture) = found_at?;
        let position = [q[0] + to.origin()[0], q[1] + to.origin()[1]];
        inside(&to.levels()[0], q).then_some(Track { position, ncc, texture })
    }

    /// Cuts the template at `p` in the geometry of the target; `None` without enough texture.
    fn set_template(
        &mut self,
        image: &Image<f32>,
        p: [f32; 2],
        warp: [f32; 4],
        min_eigenvalue: f32,
    ) -> Option<Normal> {
        if image.is_empty() {
            return None;
        }
        let side = 2 * self.half + 1;
        let (ring_side, ring_half) = (side + 2, self.half as f32 + 1.0);
        let reach =
            [(warp[0].abs() + warp[1].abs()) * ring_half, (warp[2].abs() + warp[3].abs()) * ring_half];
        let interior = is_interior(image, p, reach);
        for (i, row) in self.ring.chunks_exact_mut(ring_side).enumerate() {
            let v = i as f32 - ring_half;
            let (x, y) = (p[0] + warp[1] * v, p[1] + warp[3] * v);
            for (j, value) in row.iter_mut().enumerate() {
                let u = j as f32 - ring_half;
                let (x, y) = (x + warp[0] * u, y + warp[2] * u);
                *value = if interior { sample_interior(image, x, y) } else { sample_clamped(image, x, y) };
            }
        }
        for i in 0..side {
            let above = &self.ring[i * ring_side + 1..][..side];
            let here = &self.ring[(i + 1) * ring_side..][..ring_side];
            let below = &self.ring[(i + 2) * ring_side + 1..][..side];
            let span = i * self.stride..i * self.stride + side;
            let (t, jx, jy) =
                (&mut self.template[span.clone()], &mut self.jx[span.clone()], &mut self.jy[span]);
            for j in 0..side {
                t[j] = here[j + 1];
                jx[j] = 0.5 * (here[j + 2] - here[j]);
                jy[j] = 0.5 * (below[j] - above[j]);
            }
        }
        self.normalise(min_eigenvalue)
    }

    /// Removes the constant from template and Jacobian and the template from the Jacobian, and weights them.
    fn normalise(&mut self, min_eigenvalue: f32) -> Option<Normal> {
        let Self { weights, template, jx, jy, .. } = self;
        for image in [&mut *template, &mut *jx, &mut *jy] {
            let mean = dot(image, weights);
            image.iter_mut().for_each(|v| *v -= mean);
        }
        // From here on `template` carries the weights: products with it are weighted ones.
        let mut energy = [0.0_f32; 8];
        for (t, w) in template.chunks_exact_mut(8).zip(weights.chunks_exact(8)) {
            for k in 0..8 {
                let weighted = t[k] * w[k];
                energy[k] += weighted * t[k];
                t[k] = weighted;
            }
        }
        let energy: f32 = energy.iter().sum();
        if energy.is_nan() || energy <= 1e-3 {
            return None;
        }
        let (along_x, along_y) = (dot(jx, template) / energy, dot(jy, template) / energy);
        let mut sums = [[0.0_f32; 8]; 3];
        let jacobian = jx.chunks_exact_mut(8).zip(jy.chunks_exact_mut(8));
        for ((x, y), (t, w)) in jacobian.zip(template.chunks_exact(8).zip(weights.chunks_exact(8))) {
            for k in 0..8 {
                let (wx, wy) = (w[k] * x[k] - along_x * t[k], w[k] * y[k] - along_y * t[k]);
                sums[0][k] += wx * x[k];
                sums[1][k] += wx * y[k];
                sums[2][k] += wy * y[k];
                (x[k], y[k]) = (wx, wy);
            }
        }
        let [a, b, c] = sums.map(|s| s.iter().sum::<f32>());
        let smallest = 0.5 * (a + c - ((a - c) * (a - c) + 4.0 * b * b).sqrt());
        let det = a * c - b * b;
        (smallest >= min_eigenvalue.max(1e-6) && det > 0.0).then(|| Normal {
            energy,
            inverse: [c / det, -b / det, a / det],
            texture: smallest,
        })
    }

    /// Moves from `start` to the best match on one level; `None` if it runs away, loses correlation, or gets worse.
    fn search(
        &mut self,
        image: &Image<f32>,
        start: [f32; 2],
        normal: &Normal,
        epsilon: f32,
        max_iterations: usize,
    ) -> Option<([f32; 2], f32)> {
        let mut q = start;
        let reach = 2.0 * self.half as f32;
        let (mut first_ncc, mut is_current) = (None, false);
        for _ in 0..max_iterations.max(1) {
            self.cut(image, q)?;
            if first_ncc.is_none() {
                first_ncc = Some(self.ncc(normal.energy));
            }
            let [gain, gx, gy] = dot3(&self.patch, [&self.template, &self.jx, &self.jy]);
            let gain = gain / normal.energy;
            // A patch that correlates negatively is no view of the template: look around with gain 1 instead.
            let gain = if gain > 0.1 { gain } else { 1.0 };
            let (gx, gy) = (gx / gain, gy / gain);
            let [a, b, c] = normal.inverse;
            let step = [(a * gx + b * gy).clamp(-reach, reach), (b * gx + c * gy).clamp(-reach, reach)];
            q = [q[0] - step[0], q[1] - step[1]];
            let moved = (q[0] - start[0]).powi(2) + (q[1] - start[1]).powi(2);
            if moved.is_nan() || moved > reach * reach {
                return None;
            }
            // After so small a step the patch at hand is as good as the one at the end.
            if step[0] * step[0] + step[1] * step[1] < epsilon * epsilon {
                is_current = true;
                break;
            }
        }
        if !is_current {
            self.cut(image, q)?;
        }
        let ncc = self.ncc(normal.energy);
        (ncc.is_finite() && ncc >= first_ncc.unwrap_or(-1.0) - 1e-3).then_some((q, ncc))
    }

    /// The target patch at `q`; `None` if its centre is more than a window outside the image.
    fn cut(&mut self, image: &Image<f32>, q: [f32; 2]) -> Option<()> {
        let (width, height) = image.size();
        let half = self.half as f32;
        let (left, top) = (q[0] - half, q[1] - half);
        let near = left > -3.0 * half
            && top > -3.0 * half
            && left < width as f32 + half
            && top < height as f32 + half;
        if image.is_empty() || !near {
            return None;
        }
        let side = 2 * self.half + 1;
        // Through i32, for which there is an instruction; exact where it is used, to the right of 0.
        let (x0, y0) = (left as i32, top as i32);
        if left >= 0.0 && top >= 0.0 && x0 as usize + self.stride < width && y0 as usize + side < height {
            let (fx, fy) = (left - x0 as f32, top - y0 as f32);
            let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
            let mut at = y0 as usize * width + x0 as usize;
            for row in self.patch.chunks_exact_mut(self.stride) {
                let n = row.len();
                let upper = &image.pixels()[at..at + n + 1];
                let lower = &image.pixels()[at + width..at + width + n + 1];
                blend(row, upper, lower, weights);
                at += width;
            }
        } else {
            for (i, row) in self.patch.chunks_exact_mut(self.stride).enumerate() {
                let (visible, padding) = row.split_at_mut(side);
                for (j, value) in visible.iter_mut().enumerate() {
                    *value = sample_clamped(image, left + j as f32, top + i as f32);
                }
                padding.fill(0.0);
            }
        }
        Some(())
    }

    fn ncc(&self, energy: f32) -> f32 {
        let mean = dot(&self.patch, &self.weights);
        let mut sums = [0.0_f32; 8];
        for (v, w) in self.patch.chunks_exact(8).zip(self.weights.chunks_exact(8)) {
            for k in 0..8 {
                sums[k] += (v[k] - mean) * (v[k] - mean) * w[k];
            }
        }
        let variance: f32 = sums.iter().sum();
        if variance > 0.0 { dot(&self.patch, &self.template) / (variance * energy).sqrt() } else { 0.0 }
    }
}

/// Bilinear blend of two image rows, one pixel longer than `out`.
#[inline]
fn blend(out: &mut [f32], upper: &[f32], lower: &[f32], w: [f32; 4]) {
    let n = out.len();
    let (u0, u1) = (&upper[..n], &upper[1..n + 1]);
    let (l0, l1) = (&lower[..n], &lower[1..n + 1]);
    for j in 0..n {
        out[j] = w[0] * u0[j] + w[1] * u1[j] + w[2] * l0[j] + w[3] * l1[j];
    }
}

fn inside(image: &Image<f32>, p: [f32; 2]) -> bool {
    let (width, height) = image.size();
    p[0] >= 0.0 && p[1] >= 0.0 && p[0] <= width as f32 - 1.0 && p[1] <= height as f32 - 1.0
}

/// Dot product in eight lanes (lengths are multiples of eight).
#[inline]
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0_f32; 8];
    for (x, y) in a.chunks_exact(8).zip(b.chunks_exact(8)) {
        for k in 0..8 {
            sums[k] += x[k] * y[k];
        }
    }
    sums.iter().sum()
}

/// Three dot products with `a` in one pass.
#[inline]
fn dot3(a: &[f32], b: [&[f32]; 3]) -> [f32; 3] {
    let mut sums = [[0.0_f32; 8]; 3];
    let others = b[0].chunks_exact(8).zip(b[1].chunks_exact(8)).zip(b[2].chunks_exact(8));
    for (x, ((p, q), r)) in a.chunks_exact(8).zip(others) {
        for k in 0..8 {
            sums[0][k] += x[k] * p[k];
        }
        for k in 0..8 {
            sums[1][k] += x[k] * q[k];
        }
        for k in 0..8 {
            sums[2][k] += x[k] * r[k];
        }
    }
    sums.map(|s| s.iter().sum())
}
