//! The work on one point of the Lucas-Kanade tracker ([`klt`](crate::klt)): patches and their products.

use rgbd_io::Image;

use crate::gray::{Pyramid, sample_clamped};
use crate::klt::{KltOptions, Track};
use crate::simd::{LANES, Lane, Vector};

/// A point to follow from one image to another.
pub(crate) struct Chase<'a> {
    pub(crate) from: &'a Pyramid,
    pub(crate) to: &'a Pyramid,
    /// Levels of the pyramids to use, from the finest one on.
    pub(crate) max_levels: usize,
    pub(crate) point: [f32; 2],
    pub(crate) guess: [f32; 2],
    /// Maps offsets in the target to offsets in the image that the point comes from; row-major.
    pub(crate) from_target: [f32; 4],
    pub(crate) options: &'a KltOptions,
}

/// The patches of one point on one level, reused from point to point, in blocks of eight pixels. Rows are padded to a
/// multiple of four; padding is zero in everything the target patch is multiplied with.
pub(crate) struct Window {
    pub(crate) half: usize,
    stride: usize,
    /// Warped template with one more pixel around, for its derivatives; rows without padding.
    ring: Vec<Lane>,
    ring_offsets: [Vec<Lane>; 2],
    /// Weights of the current level, sum 1: `gaussian` on the finest, `flat` on the coarse ones, which need reach more
    /// than precision.
    weights: Vec<Lane>,
    gaussian: Vec<Lane>,
    flat: Vec<Lane>,
    /// Template less its weighted mean, then times the weights.
    template: Vec<Lane>,
    /// Jacobian less its parts along the constant and along the template, then times the weights.
    jx: Vec<Lane>,
    jy: Vec<Lane>,
    patch: Vec<Lane>,
    patch_offsets: [Vec<Lane>; 2],
}

/// What is precomputed from the template: its energy, the inverse of the 2x2 normal matrix and its smaller eigenvalue.
struct Normal {
    energy: f32,
    inverse: [f32; 3],
    texture: f32,
}

/// `rows` rows of `stride` values in blocks; those of the last block that are left are zero.
fn in_blocks(rows: usize, stride: usize, value: impl Fn(usize, usize) -> f32) -> Vec<Lane> {
    let mut blocks = vec![[0.0; LANES]; (rows * stride).div_ceil(LANES)];
    let values = blocks.as_flattened_mut().iter_mut().take(rows * stride);
    values.enumerate().for_each(|(i, v)| *v = value(i % stride, i / stride));
    blocks
}

impl Window {
    pub(crate) fn new(options: &KltOptions) -> Self {
        let half = options.half_window.clamp(2, 20);
        let side = 2 * half + 1;
        let stride = side.next_multiple_of(4);
        let window = |tap: &dyn Fn(usize) -> f32| {
            let sum: f32 = (0..side).map(tap).sum();
            in_blocks(side, stride, |x, y| if x < side { tap(x) * tap(y) / (sum * sum) } else { 0.0 })
        };
        let gaussian = window(&|i| (-0.5 * ((i as f32 - half as f32) / (0.6 * half as f32)).powi(2)).exp());
        let flat = window(&|_| 1.0);
        let zeros = vec![[0.0; LANES]; flat.len()];
        let ring = |value: &dyn Fn(usize, usize) -> f32| in_blocks(side + 2, side + 2, value);
        let from_centre = |i: usize| i as f32 - (half as f32 + 1.0);
        Self {
            half,
            stride,
            ring: ring(&|_, _| 0.0),
            ring_offsets: [ring(&|x, _| from_centre(x)), ring(&|_, y| from_centre(y))],
            weights: zeros.clone(),
            gaussian,
            flat,
            template: zeros.clone(),
            jx: zeros.clone(),
            jy: zeros.clone(),
            patch: zeros,
            patch_offsets: [
                in_blocks(side, stride, |x, _| x as f32),
                in_blocks(side, stride, |_, y| y as f32),
            ],
        }
    }

    #[inline(always)]
    pub(crate) fn follow<V: Vector>(&mut self, chase: &Chase<'_>) -> Option<Track> {
        let &Chase { from, to, max_levels, point, guess, from_target, options } = chase;
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
            let at = [p[0] * scale, p[1] * scale];
            let normal = self.set_template::<V>(image_a, at, from_target, options.min_eigenvalue);
            // No closure: what isn't inlined knows nothing of the processor that this is compiled for.
            let found = match &normal {
                Some(n) => self.search::<V>(image_b, start, n, epsilon, options.max_iterations),
                None => None,
            };
            match (found, normal) {
                (Some((end, ncc)), Some(n)) => {
                    q = [end[0] / scale, end[1] / scale];
                    found_at = Some((ncc, n.texture));
                }
                // A coarse level without texture or convergence just doesn't help.
                _ if level > 0 => {}
                _ => return None,
            }
        }
        let (ncc, texture) = found_at?;
        let position = [q[0] + to.origin()[0], q[1] + to.origin()[1]];
        inside(&to.levels()[0], q).then_some(Track { position, ncc, texture })
    }

    /// Cuts the template at `p` in the geometry of the target; `None` without enough texture.
    #[inline(always)]
    fn set_template<V: Vector>(
        &mut self,
        image: &Image<f32>,
        p: [f32; 2],
        warp: [f32; 4],
        min_eigenvalue: f32,
    ) -> Option<Normal> {
        if image.is_empty() {
            return None;
        }
        let warp = [V::splat(warp[0]), V::splat(warp[1]), V::splat(warp[2]), V::splat(warp[3])];
        let offsets = self.ring_offsets[0].iter().zip(&self.ring_offsets[1]);
        for (values, (across, down)) in self.ring.iter_mut().zip(offsets) {
            let (across, down) = (V::load(across), V::load(down));
            let x = V::splat(p[0]) + warp[1] * down + warp[0] * across;
            let y = V::splat(p[1]) + warp[3] * down + warp[2] * across;
            *values = sample(image, [x, y]);
        }
        let (side, ring) = (2 * self.half + 1, self.ring.as_flattened());
        let four = |at: usize| ring.get(at..).and_then(|r| r.first_chunk::<4>()).copied().unwrap_or_default();
        let [template, jx, jy] = [&mut self.template, &mut self.jx, &mut self.jy];
        for i in 0..side {
            for j in (0..self.stride).step_by(4) {
                let at = i * (side + 2) + j;
                let (above, below) = (four(at + 1), four(at + 2 * (side + 2) + 1));
                let here = [0, 1, 2].map(|dx| four(at + side + 2 + dx));
                let out = i * self.stride + j..i * self.stride + j + 4;
                let (mut dx, mut dy) = ([0.0; 4], [0.0; 4]);
                for k in 0..4 {
                    dx[k] = 0.5 * (here[2][k] - here[0][k]);
                    dy[k] = 0.5 * (below[k] - above[k]);
                }
                template.as_flattened_mut()[out.clone()].copy_from_slice(&here[1]);
                jx.as_flattened_mut()[out.clone()].copy_from_slice(&dx);
                jy.as_flattened_mut()[out].copy_from_slice(&dy);
            }
        }
        self.normalise::<V>(min_eigenvalue)
    }

    /// Removes the constant from template and Jacobian and the template from the Jacobian, and weights them.
    #[inline(always)]
    fn normalise<V: Vector>(&mut self, min_eigenvalue: f32) -> Option<Normal> {
        let Self { weights, template, jx, jy, .. } = self;
        for image in [&mut *template, &mut *jx, &mut *jy] {
            let mean = V::splat(dot::<V, 1>(image, [weights])[0]);
            for v in image {
                *v = (V::load(v) - mean).lane();
            }
        }
        // From here on `template` carries the weights: products with it are weighted ones.
        let mut energy = V::splat(0.0);
        for (t, w) in template.iter_mut().zip(&*weights) {
            let weighted = V::load(t) * V::load(w);
            energy = energy + weighted * V::load(t);
            *t = weighted.lane();
        }
        let energy = total(energy);
        if energy.is_nan() || energy <= 1e-3 {
            return None;
        }
        let along_x = V::splat(dot::<V, 1>(jx, [template])[0] / energy);
        let along_y = V::splat(dot::<V, 1>(jy, [template])[0] / energy);
        let mut sums = [V::splat(0.0); 3];
        for ((jx, jy), (t, w)) in jx.iter_mut().zip(jy).zip(template.iter().zip(&*weights)) {
            let (x, y, t, w) = (V::load(jx), V::load(jy), V::load(t), V::load(w));
            let (wx, wy) = (w * x - along_x * t, w * y - along_y * t);
            sums = [sums[0] + wx * x, sums[1] + wx * y, sums[2] + wy * y];
            (*jx, *jy) = (wx.lane(), wy.lane());
        }
        let [a, b, c] = [total(sums[0]), total(sums[1]), total(sums[2])];
        let smallest = 0.5 * (a + c - ((a - c) * (a - c) + 4.0 * b * b).sqrt());
        let det = a * c - b * b;
        (smallest >= min_eigenvalue.max(1e-6) && det > 0.0).then(|| Normal {
            energy,
            inverse: [c / det, -b / det, a / det],
            texture: smallest,
        })
    }

    /// Moves from `start` to the best match on one level; `None` if it runs away, loses correlation, or gets worse.
    #[inline(always)]
    fn search<V: Vector>(
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
            self.cut::<V>(image, q)?;
            if first_ncc.is_none() {
                first_ncc = Some(self.ncc::<V>(normal.energy));
            }
            let [gain, gx, gy] = dot::<V, 3>(&self.patch, [&self.template, &self.jx, &self.jy]);
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
            self.cut::<V>(image, q)?;
        }
        let ncc = self.ncc::<V>(normal.energy);
        (ncc.is_finite() && ncc >= first_ncc.unwrap_or(-1.0) - 1e-3).then_some((q, ncc))
    }

    /// The target patch at `q`; `None` if its centre is more than a window outside the image.
    #[inline(always)]
    fn cut<V: Vector>(&mut self, image: &Image<f32>, q: [f32; 2]) -> Option<()> {
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
            for row in self.patch.as_flattened_mut().chunks_exact_mut(self.stride) {
                let n = row.len();
                let upper = &image.pixels()[at..at + n + 1];
                let lower = &image.pixels()[at + width..at + width + n + 1];
                blend(row, upper, lower, weights);
                at += width;
            }
        } else {
            let offsets = self.patch_offsets[0].iter().zip(&self.patch_offsets[1]);
            for (values, (across, down)) in self.patch.iter_mut().zip(offsets) {
                *values = sample(image, [V::splat(left) + V::load(across), V::splat(top) + V::load(down)]);
            }
        }
        Some(())
    }

    #[inline(always)]
    fn ncc<V: Vector>(&self, energy: f32) -> f32 {
        let [mean, product] = dot::<V, 2>(&self.patch, [&self.weights, &self.template]);
        let (mean, mut sum) = (V::splat(mean), V::splat(0.0));
        for (v, w) in self.patch.iter().zip(&self.weights) {
            let v = V::load(v) - mean;
            sum = sum + v * v * V::load(w);
        }
        let variance = total(sum);
        if variance > 0.0 { product / (variance * energy).sqrt() } else { 0.0 }
    }
}

/// [`sample_clamped`] at eight points, the same bits.
#[inline(always)]
fn sample<V: Vector>(image: &Image<f32>, [x, y]: [V; 2]) -> Lane {
    let (width, height) = image.size();
    if width < 2 || height < 2 {
        let (x, y) = (x.lane(), y.lane());
        return std::array::from_fn(|k| sample_clamped(image, x[k], y[k]));
    }
    let (zero, one) = (V::splat(0.0), V::splat(1.0));
    let x = x.max(zero).min(V::splat((width - 1) as f32));
    let y = y.max(zero).min(V::splat((height - 1) as f32));
    // In the last column the pixel to the right is the one that counts.
    let x0 = x.truncated().min(V::splat((width - 2) as f32));
    let y0 = y.truncated().min(V::splat((height - 2) as f32));
    let (fx, fy) = (x - x0, y - y0);
    let [a, b, c, d] = V::squares(image.pixels(), [x0, y0], width);
    let top = V::if_less(fx, one, a + fx * (b - a), b);
    let bottom = V::if_less(fx, one, c + fx * (d - c), d);
    V::if_less(fy, one, top + fy * (bottom - top), bottom).lane()
}

/// Bilinear blend of two image rows, one pixel longer than `out`.
#[inline(always)]
fn blend(out: &mut [f32], upper: &[f32], lower: &[f32], w: [f32; 4]) {
    let n = out.len();
    let (u0, u1) = (&upper[..n], &upper[1..n + 1]);
    let (l0, l1) = (&lower[..n], &lower[1..n + 1]);
    for j in 0..n {
        out[j] = w[0] * u0[j] + w[1] * u1[j] + w[2] * l0[j] + w[3] * l1[j];
    }
}

#[inline(always)]
fn inside(image: &Image<f32>, p: [f32; 2]) -> bool {
    let (width, height) = image.size();
    p[0] >= 0.0 && p[1] >= 0.0 && p[0] <= width as f32 - 1.0 && p[1] <= height as f32 - 1.0
}

#[inline(always)]
fn total<V: Vector>(sums: V) -> f32 {
    let mut total = 0.0;
    for x in sums.lane() {
        total += x;
    }
    total
}

/// Dot products with `a` in one pass.
#[inline(always)]
fn dot<V: Vector, const N: usize>(a: &[Lane], b: [&[Lane]; N]) -> [f32; N] {
    let mut sums = [V::splat(0.0); N];
    for (i, x) in a.iter().enumerate() {
        let x = V::load(x);
        for (sum, b) in sums.iter_mut().zip(b) {
            if let Some(y) = b.get(i) {
                *sum = *sum + x * V::load(y);
            }
        }
    }
    let mut totals = [0.0; N];
    for (total, sum) in totals.iter_mut().zip(sums) {
        *total = self::total(sum);
    }
    totals
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::simd::Portable;

    #[test]
    fn eight_samples_are_the_bits_of_each_alone_in_and_around_the_image() {
        let mut rng = Pcg64Mcg::seed_from_u64(5);
        for (width, height) in [(1, 1), (1, 9), (9, 1), (2, 2), (13, 11)] {
            let image = Image::from_fn(width, height, |_, _| rng.random_range(0.0f32..255.0));
            for _ in 0..200 {
                let mut lane = |size: usize| -> Lane {
                    let whole = rng.random_bool(0.3);
                    let at = |x: f32| if whole { x.round() } else { x };
                    std::array::from_fn(|_| at(rng.random_range(-4.0..size as f32 + 4.0)))
                };
                let (x, y) = (lane(width), lane(height));
                let alone: Lane = std::array::from_fn(|k| sample_clamped(&image, x[k], y[k]));
                assert_eq!(sample(&image, [Portable::load(&x), Portable::load(&y)]), alone, "{x:?} {y:?}");
            }
        }
    }
}
