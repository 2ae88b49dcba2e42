//! Gradient-histogram descriptors of scale-space keypoints.
//!
//! Lowe, *Distinctive image features from scale-invariant keypoints*, IJCV 2004, section 6: 4x4 cells of 8 orientations
//! over 12 sigma, normalised, clipped; then RootSIFT (Arandjelovic and Zisserman, CVPR 2012). The region is resampled
//! to 16x16 pixels at 0.75 sigma, so that all spatial weights are tables.

use crate::gray::{is_interior, sample_clamped, sample_interior};
use rgbd_io::Image;
use std::f32::consts::{PI, TAU};

/// Bytes of a descriptor.
pub(crate) const LEN: usize = 128;
/// Euclidean length of a descriptor in its units; values are clipped at 255.
pub(crate) const NORM: f32 = 512.0;

const SAMPLES: usize = 16;
const RING: usize = SAMPLES + 2;
/// Distance of samples in units of the keypoint's sigma.
const SPACING: f32 = 0.75;
const CELLS: usize = 4;
const BINS: usize = 8;
const ORIENTATION_BINS: usize = 36;

/// Tables and patch shared by all keypoints of an image.
pub(crate) struct Describer {
    patch: [f32; RING * RING],
    /// Per sample along one axis: first cell (of a grid with a border of one), the weights of it and the next.
    cell: [(usize, f32, f32); SAMPLES],
    /// Gaussian over the region and over the orientation window, along one axis.
    region: [f32; SAMPLES],
    window: [f32; SAMPLES],
}

impl Describer {
    pub(crate) fn new() -> Self {
        let offset = |i: usize| i as f32 + 0.5 - SAMPLES as f32 / 2.0;
        let gaussian = |sigma: f32| core::array::from_fn(|i| (-0.5 * (offset(i) / sigma).powi(2)).exp());
        let cell = core::array::from_fn(|i| {
            // Cell centres are at 0.5, 1.5 ... of 4; +1 for the border.
            let at = (i as f32 + 0.5) / (SAMPLES / CELLS) as f32 + 0.5;
            (at as usize, 1.0 - at.fract(), at.fract())
        });
        // Lowe's widths: half the region; and 1.5 sigma of the keypoint.
        Self { patch: [0.0; RING * RING], cell, region: gaussian(8.0), window: gaussian(1.5 / SPACING) }
    }

    /// Cuts the patch around `(x, y)` of the blurred image, `sigma` in its pixels, rotated by `angle`.
    fn cut(&mut self, image: &Image<f32>, x: f32, y: f32, sigma: f32, angle: f32) {
        let (sin, cos) = (angle.sin() * sigma * SPACING, angle.cos() * sigma * SPACING);
        let half = (RING as f32 - 1.0) / 2.0;
        let reach = (sin.abs() + cos.abs()) * half;
        let interior = is_interior(image, [x, y], [reach, reach]);
        for (i, row) in self.patch.chunks_exact_mut(RING).enumerate() {
            let v = i as f32 - half;
            let (x0, y0) = (x - sin * v, y + cos * v);
            for (j, value) in row.iter_mut().enumerate() {
                let u = j as f32 - half;
                let (x, y) = (x0 + cos * u, y0 + sin * u);
                *value = if interior { sample_interior(image, x, y) } else { sample_clamped(image, x, y) };
            }
        }
    }

    fn gradient(&self, i: usize, j: usize) -> (f32, f32) {
        let at = (i + 1) * RING + j + 1;
        (self.patch[at + 1] - self.patch[at - 1], self.patch[at + RING] - self.patch[at - RING])
    }

    /// Directions of the strongest gradients (Lowe, section 5), radians; several where peaks are alike.
    pub(crate) fn orientations(
        &mut self,
        image: &Image<f32>,
        x: f32,
        y: f32,
        sigma: f32,
        out: &mut Vec<f32>,
    ) {
        self.cut(image, x, y, sigma, 0.0);
        let mut bins = [0.0_f32; ORIENTATION_BINS];
        for i in 0..SAMPLES {
            for j in 0..SAMPLES {
                let (dx, dy) = self.gradient(i, j);
                let at = fast_atan2(dy, dx).rem_euclid(TAU) * (ORIENTATION_BINS as f32 / TAU);
                bins[at as usize % ORIENTATION_BINS] += dx.hypot(dy) * self.window[i] * self.window[j];
            }
        }
        let around = |b: &[f32; ORIENTATION_BINS], k: usize, d: usize| {
            b[(k + ORIENTATION_BINS + d - 2) % ORIENTATION_BINS]
        };
        let smooth: [f32; ORIENTATION_BINS] = core::array::from_fn(|k| {
            (around(&bins, k, 0)
                + around(&bins, k, 4)
                + 4.0 * (around(&bins, k, 1) + around(&bins, k, 3))
                + 6.0 * bins[k])
                / 16.0
        });
        let top = smooth.iter().fold(0.0_f32, |m, &v| m.max(v));
        out.clear();
        for k in 0..ORIENTATION_BINS {
            let (before, here, after) = (around(&smooth, k, 1), smooth[k], around(&smooth, k, 3));
            if here > before && here >= after && here >= 0.8 * top && here > 0.0 {
                let shift = 0.5 * (before - after) / (before - 2.0 * here + after);
                out.push((k as f32 + 0.5 + shift) * (TAU / ORIENTATION_BINS as f32));
            }
        }
    }

    /// Appends the descriptor to `out`; a patch without any gradient appends nothing and is `false`.
    pub(crate) fn describe(
        &mut self,
        image: &Image<f32>,
        [x, y]: [f32; 2],
        sigma: f32,
        angle: f32,
        out: &mut Vec<u8>,
    ) -> bool {
        const SIDE: usize = CELLS + 2;
        self.cut(image, x, y, sigma, angle);
        let mut grid = [0.0_f32; SIDE * SIDE * BINS];
        for i in 0..SAMPLES {
            let (row, row_w0, row_w1) = self.cell[i];
            for j in 0..SAMPLES {
                let (column, w0, w1) = self.cell[j];
                let (dx, dy) = self.gradient(i, j);
                let strength = (dx * dx + dy * dy).sqrt() * self.region[i] * self.region[j];
                let at = (fast_atan2(dy, dx) + PI) * (BINS as f32 / TAU);
                let bin = at as usize;
                let part = at - bin as f32;
                let (b0, b1) = (bin % BINS, (bin + 1) % BINS);
                let (s0, s1) = (strength * (1.0 - part), strength * part);
                for (r, wr) in [(row, row_w0), (row + 1, row_w1)] {
                    for (c, wc) in [(column, w0), (column + 1, w1)] {
                        let cell = &mut grid[(r * SIDE + c) * BINS..][..BINS];
                        cell[b0] += wr * wc * s0;
                        cell[b1] += wr * wc * s1;
                    }
                }
            }
        }
        let mut values = [0.0_f32; LEN];
        for r in 0..CELLS {
            let inner = ((r + 1) * SIDE + 1) * BINS;
            values[r * CELLS * BINS..][..CELLS * BINS].copy_from_slice(&grid[inner..inner + CELLS * BINS]);
        }
        quantise(&mut values, out)
    }
}

/// L2 norm, clip at 0.2, square root of the L1-normalised values, bytes.
fn quantise(values: &mut [f32; LEN], out: &mut Vec<u8>) -> bool {
    let norm = values.iter().map(|v| v * v).sum::<f32>().sqrt();
    if !(norm > 1e-6 && norm.is_finite()) {
        return false;
    }
    values.iter_mut().for_each(|v| *v = (*v / norm).min(0.2));
    let sum: f32 = values.iter().sum();
    out.extend(values.iter().map(|v| ((v / sum).sqrt() * NORM + 0.5) as u8));
    true
}

/// Angle of `(x, y)` in (-pi, pi], to 2e-4 radians; 0 for the zero vector.
#[inline]
fn fast_atan2(y: f32, x: f32) -> f32 {
    let (ax, ay) = (x.abs(), y.abs());
    let t = ax.min(ay) / (ax.max(ay) + f32::MIN_POSITIVE);
    let s = t * t;
    // Odd minimax polynomial of the arctangent on [0, 1] (Abramowitz and Stegun 4.4.49 has its form).
    let mut angle =
        t * (0.999_866 + s * (-0.330_299_5 + s * (0.180_141 + s * (-0.085_133 + s * 0.020_835_1))));
    if ay > ax {
        angle = 0.5 * PI - angle;
    }
    if x < 0.0 {
        angle = PI - angle;
    }
    if y < 0.0 { -angle } else { angle }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fast_arctangent_is_one() {
        for k in 0..720 {
            let angle = (k as f32 * 0.5 - 179.75).to_radians();
            for r in [1e-6_f32, 1.0, 300.0] {
                assert!((fast_atan2(r * angle.sin(), r * angle.cos()) - angle).abs() < 2e-4, "at {angle}");
            }
        }
        assert_eq!(fast_atan2(0.0, 0.0), 0.0);
    }

    #[test]
    fn a_descriptor_turns_with_its_angle() {
        let wave = |x: f32, y: f32| 100.0 + 40.0 * (0.31 * x).sin() + 30.0 * (0.23 * y + 0.1 * x).cos();
        let (s, c) = 0.5_f32.sin_cos();
        let upright = Image::from_fn(81, 81, |x, y| wave(x as f32 - 40.0, y as f32 - 40.0));
        let turned = Image::from_fn(81, 81, |x, y| {
            let (u, v) = (x as f32 - 40.0, y as f32 - 40.0);
            wave(c * u + s * v, -s * u + c * v)
        });
        let mut describer = Describer::new();
        let (mut a, mut b) = (Vec::new(), Vec::new());
        assert!(describer.describe(&upright, [40.0, 40.0], 3.0, 0.0, &mut a));
        assert!(describer.describe(&turned, [40.0, 40.0], 3.0, 0.5, &mut b));
        let distance: f32 =
            a.iter().zip(&b).map(|(a, b)| (f32::from(*a) - f32::from(*b)).powi(2)).sum::<f32>().sqrt();
        assert!(distance < 0.1 * NORM, "distance {distance}");

        let (mut first, mut second) = (Vec::new(), Vec::new());
        describer.orientations(&upright, 40.0, 40.0, 3.0, &mut first);
        describer.orientations(&turned, 40.0, 40.0, 3.0, &mut second);
        let found = second.iter().any(|b| ((b - first[0] - 0.5 + PI).rem_euclid(TAU) - PI).abs() < 0.1);
        assert!(found, "{first:?} {second:?}");
    }

    #[test]
    fn a_plain_patch_has_no_descriptor() {
        let mut out = Vec::new();
        assert!(!Describer::new().describe(&Image::filled(30, 30, 9.0), [15.0, 15.0], 2.0, 0.0, &mut out));
        assert!(out.is_empty());
    }
}
