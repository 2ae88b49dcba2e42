//! The sensor's faults: noise, quantisation, missing depth, exposure.

use crate::noise::{lattice, mix, normal, normal_levels, stream, unit};
use crate::scene::{Camera, Clean};
use rayon::prelude::*;
use rgbd_io::Image;

/// What an RGB-D camera does to a perfect frame.
///
/// The noise of the depth is Gaussian with `sigma = base + quadratic z^2 + grazing / sqrt(z) theta^2 / (pi/2 -
/// theta)^2 + amplitude z / sqrt(albedo cos theta)`, where theta is the angle between the surface's normal and the
/// ray. The terms: growth with the square of the distance in triangulation (Khoshelham and Elberink, Sensors 12(2),
/// 2012, eq. 10); growth at grazing angles (Nguyen, Izadi and Lovell, 3DIMPVT 2012, eq. 3, who give it for theta
/// above 60 degrees); photon noise in time of flight, which falls with the root of the light that returns (Lange and
/// Seitz, IEEE Journal of Quantum Electronics 37(3), 2001).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sensor {
    /// Noise that is there at any distance, metres.
    pub depth_base: f32,
    /// Noise per squared distance, 1/metre.
    pub depth_quadratic: f32,
    /// Coefficient of the grazing-angle term, metres^1.5.
    pub depth_grazing: f32,
    /// Coefficient of the photon-noise term: noise per distance on a white surface seen head on.
    pub depth_amplitude: f32,
    /// Standard deviation per squared distance (1/metre) of noise that is shared by neighbours, as that of matched
    /// blocks is.
    pub correlated: f32,
    /// Pixels over which it is shared.
    pub correlation: f32,
    /// Amplitude and wavelength (metres) of a systematic error that waves with the distance, as that of modulated
    /// light does (Lindner and Kolb, ISVC 2006).
    pub wiggle: [f32; 2],
    /// Standard deviation of the place where a pixel's depth is read, pixels: frays the edges.
    pub lateral: f32,
    /// Depth is rounded to multiples of this, metres; `0` = not at all.
    pub quantum: f32,
    /// Inverse depth is rounded to multiples of this before, 1/metre; `0` = not at all.
    pub disparity_quantum: f32,
    /// Depth beyond this is missing, metres.
    pub max_range: f32,
    /// A depth edge: neighbours whose depths differ by more than this, metres.
    pub edge_step: f32,
    /// Pixels this close to a depth edge are its edge pixels.
    pub edge_radius: usize,
    /// Share of the edge pixels without depth.
    pub edge_dropout: f32,
    /// Share of the remaining edge pixels with a depth between the two sides ("flying pixels").
    pub flying: f32,
    /// Angle from which on depth begins to be missing, radians; at 90 degrees all of it is.
    pub grazing_limit: f32,
    /// Expected share of the image that lies in round holes.
    pub hole_share: f32,
    /// Largest radius of the holes, pixels.
    pub hole_radius: f32,
    /// Where the colour is brighter than this (1 = white) depth is missing: a highlight outshines the pattern.
    pub glare: f32,
    /// Standard deviation of the colour noise, of 255.
    pub color_noise: f32,
    /// Share of the time between two frames in which the shutter is open; `0` = no motion blur.
    pub exposure: f32,
    /// Amplitude of the slow change of brightness (`0.2` = plus and minus 20 %), over 90 frames.
    pub brightness_swing: f32,
}

impl Sensor {
    /// Standard deviation (metres) of the depth noise at depth `z` (metres) on a white surface whose normal forms an
    /// angle of the given cosine with the ray; without the correlated part.
    pub fn depth_sigma(&self, z: f32, cosine: f32) -> f32 {
        self.sigma(z, cosine, 1.0)
    }

    #[inline]
    fn sigma(&self, z: f32, cosine: f32, albedo: f32) -> f32 {
        let mut sigma = self.depth_base + self.depth_quadratic * z * z;
        if self.depth_amplitude > 0.0 {
            // Even black velvet returns a little.
            sigma += self.depth_amplitude * z / (albedo * cosine).clamp(0.02, 1.0).sqrt();
        }
        if cosine < 0.5 && self.depth_grazing > 0.0 {
            let theta = cosine.max(0.0).acos();
            // Past 85 degrees the formula leaves the range it was fitted in.
            let theta = theta.min(85f32.to_radians());
            let slant = theta / (std::f32::consts::FRAC_PI_2 - theta);
            sigma += self.depth_grazing / z.sqrt() * slant * slant;
        }
        sigma
    }

    /// Share of the depth that is missing on a surface of this cosine.
    fn grazing_loss(&self, cosine: f32) -> f32 {
        let theta = cosine.clamp(0.0, 1.0).acos();
        (theta - self.grazing_limit) / (std::f32::consts::FRAC_PI_2 - self.grazing_limit).max(1e-6)
    }

    /// Brightness factor of frame `index`.
    pub(crate) fn gain(&self, index: usize) -> f32 {
        1.0 + self.brightness_swing * (index as f32 * std::f32::consts::TAU / 90.0).sin()
    }

    /// The depth image that the sensor delivers (metres, `0` = missing).
    pub(crate) fn depth(&self, clean: &Clean, camera: &Camera, seed: u64, index: usize) -> Image<f32> {
        let (w, h) = (camera.width, camera.height);
        let [near, far] = self.edge_ranges(clean, w, h);
        let reader = Reader {
            sensor: self,
            clean,
            range: [&near, &far],
            size: [w, h],
            slanted: self.grazing_limit.cos(),
            levels: normal_levels(),
        };
        let field = (self.correlated > 0.0).then(|| Field::new(self.correlation, seed, index));
        let mut out = vec![0.0f32; w * h];
        out.par_chunks_mut(w.max(1)).enumerate().for_each(|(y, row)| {
            let seed = stream(seed, index as u64, y as u64);
            for (x, pixel) in row.iter_mut().enumerate() {
                let shared = field.as_ref().map_or(0.0, |f| f.at(x, y));
                // One counter a pixel: the values don't depend on what happens elsewhere.
                *pixel = reader.read([x, y], shared, mix(seed.wrapping_add(x as u64)));
            }
        });
        self.punch_holes(&mut out, w, h, seed, index);
        Image::from_vec(w, h, out).unwrap_or_default()
    }

    /// Smallest and largest depth within `edge_radius` of every pixel.
    fn edge_ranges(&self, clean: &Clean, w: usize, h: usize) -> [Vec<f32>; 2] {
        let r = self.edge_radius;
        let mut across = [vec![f32::INFINITY; w * h], vec![f32::NEG_INFINITY; w * h]];
        let [near, far] = &mut across;
        near.par_chunks_mut(w.max(1))
            .zip(far.par_chunks_mut(w.max(1)))
            .zip(clean.depth.par_chunks(w.max(1)))
            .for_each(|((near, far), z)| {
                near.copy_from_slice(z);
                far.copy_from_slice(z);
                for step in 1..=r.min(w.saturating_sub(1)) {
                    widen(&mut near[step..], &mut far[step..], &z[..w - step], &z[..w - step]);
                    widen(&mut near[..w - step], &mut far[..w - step], &z[step..], &z[step..]);
                }
            });
        let mut both = across.clone();
        let [near, far] = &mut both;
        near.par_chunks_mut(w.max(1)).zip(far.par_chunks_mut(w.max(1))).enumerate().for_each(
            |(y, (near, far))| {
                for v in y.saturating_sub(r)..(y + r + 1).min(h) {
                    widen(near, far, &across[0][v * w..(v + 1) * w], &across[1][v * w..(v + 1) * w]);
                }
            },
        );
        both
    }

    fn punch_holes(&self, depth: &mut [f32], w: usize, h: usize, seed: u64, index: usize) {
        if self.hole_share <= 0.0 || self.hole_radius <= 0.0 || w == 0 || h == 0 {
            return;
        }
        let seed = stream(seed, index as u64, u64::MAX);
        // Radii are even between 30 % and 100 % of the largest: the mean of their squares is 0.463 of its square.
        let area = std::f32::consts::PI * 0.463 * self.hole_radius * self.hole_radius;
        let count = (self.hole_share * (w * h) as f32 / area).min((w * h) as f32);
        let count = count as u64 + u64::from(unit(mix(seed), 0) < count.fract());
        for hole in 1..=count {
            let random = mix(seed.wrapping_add(hole));
            let (cx, cy) = (unit(random, 0) * w as f32, unit(random, 16) * h as f32);
            let r = self.hole_radius * (0.3 + 0.7 * unit(random, 32));
            let span = |c: f32, limit: usize| {
                (c - r).ceil().max(0.0) as usize..((c + r).floor().max(-1.0) + 1.0).min(limit as f32) as usize
            };
            for y in span(cy, h) {
                for x in span(cx, w) {
                    if (x as f32 - cx).powi(2) + (y as f32 - cy).powi(2) <= r * r {
                        depth[y * w + x] = 0.0;
                    }
                }
            }
        }
    }

    /// The colour image that the sensor delivers.
    pub(crate) fn color(
        &self,
        color: &[[f32; 3]],
        camera: &Camera,
        seed: u64,
        index: usize,
    ) -> Image<[u8; 3]> {
        let w = camera.width;
        let gain = 255.0 * self.gain(index);
        let levels = normal_levels();
        let mut out = vec![[0u8; 3]; color.len()];
        out.par_chunks_mut(w.max(1)).enumerate().for_each(|(y, row)| {
            let seed = stream(seed ^ 0xc0_10, index as u64, y as u64);
            for (x, (pixel, c)) in row.iter_mut().zip(&color[y * w..]).enumerate() {
                let random = mix(seed.wrapping_add(x as u64));
                *pixel = std::array::from_fn(|k| {
                    let noise = self.color_noise * normal(levels, random, 16 * k as u32);
                    (c[k] * gain + noise + 0.5) as u8
                });
            }
        });
        Image::from_vec(w, camera.height, out).unwrap_or_default()
    }
}

/// Takes `low` and `high` into the ranges `near` to `far`.
fn widen(near: &mut [f32], far: &mut [f32], low: &[f32], high: &[f32]) {
    for (a, &b) in near.iter_mut().zip(low) {
        *a = if b < *a { b } else { *a };
    }
    for (a, &b) in far.iter_mut().zip(high) {
        *a = if b > *a { b } else { *a };
    }
}

/// Reads single pixels of one frame's depth.
struct Reader<'a> {
    sensor: &'a Sensor,
    clean: &'a Clean,
    /// Smallest and largest depth around every pixel.
    range: [&'a [f32]; 2],
    size: [usize; 2],
    /// Below this cosine depth begins to be missing.
    slanted: f32,
    levels: &'static [f32; 4096],
}

impl Reader<'_> {
    /// The depth of pixel `at`; `shared` is the unit noise it has in common with its neighbours.
    #[inline]
    fn read(&self, at: [usize; 2], shared: f32, random: u64) -> f32 {
        let (s, [w, h]) = (self.sensor, self.size);
        // A negative value is cast to zero.
        let moved = |v: usize, shift: u32, limit: usize| {
            ((v as f32 + s.lateral * normal(self.levels, random, shift) + 0.5) as usize).min(limit - 1)
        };
        let i = moved(at[1], 12, h) * w + moved(at[0], 24, w);
        let (near, far) = (self.range[0][at[1] * w + at[0]], self.range[1][at[1] * w + at[0]]);
        let (mut z, cosine) = (self.clean.depth[i], self.clean.cosine[i]);
        let on_edge = far - near > s.edge_step;
        if on_edge || cosine < self.slanted {
            let more = mix(random);
            if on_edge && unit(more, 0) < s.edge_dropout {
                return 0.0;
            }
            if cosine < self.slanted && unit(more, 16) < s.grazing_loss(cosine) {
                return 0.0;
            }
            if on_edge && far.is_finite() && unit(more, 32) < s.flying {
                z = near + (far - near) * unit(more, 48);
            }
        }
        let [red, green, blue] = self.clean.color[i];
        let bright = 0.3 * red + 0.6 * green + 0.1 * blue;
        if bright > s.glare {
            return 0.0;
        }
        z += normal(self.levels, random, 0) * s.sigma(z, cosine, bright) + shared * s.correlated * z * z;
        if s.wiggle[0] != 0.0 {
            z += s.wiggle[0] * (std::f32::consts::TAU * z / s.wiggle[1]).sin();
        }
        if s.disparity_quantum > 0.0 && z > 0.0 {
            let steps = (1.0 / (z * s.disparity_quantum) + 0.5) as i32 as f32;
            z = 1.0 / (steps * s.disparity_quantum);
        }
        if s.quantum > 0.0 {
            // Depth is positive and small: a cast rounds it without a call.
            z = (z / s.quantum + 0.5) as i32 as f32 * s.quantum;
        }
        if z.is_finite() && z > 0.0 && z <= s.max_range { z } else { 0.0 }
    }
}

/// Smooth noise of unit variance over the image, new in every frame: normal values on a square grid, blended.
struct Field {
    cell: f32,
    seed: u32,
    levels: &'static [f32; 4096],
}

impl Field {
    fn new(cell: f32, seed: u64, index: usize) -> Self {
        let seed = stream(seed ^ 0xf1e1d, index as u64, 0) as u32;
        Self { cell: cell.max(1.0), seed, levels: normal_levels() }
    }

    fn at(&self, x: usize, y: usize) -> f32 {
        let (u, v) = (x as f32 / self.cell, y as f32 / self.cell);
        let (i, j) = (u as i32, v as i32);
        let ease = |t: f32| t * t * (3.0 - 2.0 * t);
        let (s, t) = (ease(u - i as f32), ease(v - j as f32));
        let (mut sum, mut power) = (0.0, 0.0);
        for (dx, dy, weight) in
            [(0, 0, (1.0 - s) * (1.0 - t)), (1, 0, s * (1.0 - t)), (0, 1, (1.0 - s) * t), (1, 1, s * t)]
        {
            sum += weight * normal(self.levels, u64::from(lattice(i + dx, j + dy, 0, self.seed)), 4);
            power += weight * weight;
        }
        // A blend of independent values varies less than one of them.
        sum / power.sqrt()
    }
}
