//! The sensor's faults: noise, quantisation, missing depth, exposure.

use crate::noise::stream;
use crate::scene::{Camera, Clean};
use rand::Rng;
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;
use rgbd_io::Image;

/// What a structured-light RGB-D camera does to a perfect frame.
///
/// The noise of the depth is Gaussian with
/// `sigma = base + quadratic z^2 + grazing / sqrt(z) theta^2 / (pi/2 - theta)^2`, where theta is the angle between
/// the surface's normal and the ray: growth with the square of the distance after Khoshelham and Elberink, Sensors
/// 12(2), 2012, eq. 10; growth at grazing angles after Nguyen, Izadi and Lovell, 3DIMPVT 2012, eq. 3, who give it
/// for theta above 60 degrees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sensor {
    /// Noise that is there at any distance, metres.
    pub depth_base: f32,
    /// Noise per squared distance, 1/metre.
    pub depth_quadratic: f32,
    /// Coefficient of the grazing-angle term, metres^1.5.
    pub depth_grazing: f32,
    /// Standard deviation of the place where a pixel's depth is read, pixels: frays the edges.
    pub lateral: f32,
    /// Depth is rounded to multiples of this, metres; `0` = not at all.
    pub quantum: f32,
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
    /// Standard deviation of the colour noise, of 255.
    pub color_noise: f32,
    /// Share of the time between two frames in which the shutter is open; `0` = no motion blur.
    pub exposure: f32,
    /// Amplitude of the slow change of brightness (`0.2` = plus and minus 20 %), over 90 frames.
    pub brightness_swing: f32,
}

impl Sensor {
    /// No fault at all: depth as exact as `f32` allows.
    pub fn perfect() -> Self {
        Self {
            depth_base: 0.0,
            depth_quadratic: 0.0,
            depth_grazing: 0.0,
            lateral: 0.0,
            quantum: 0.0,
            max_range: f32::INFINITY,
            edge_step: 0.02,
            edge_radius: 1,
            edge_dropout: 0.0,
            flying: 0.0,
            grazing_limit: std::f32::consts::FRAC_PI_2,
            hole_share: 0.0,
            hole_radius: 0.0,
            color_noise: 0.0,
            exposure: 0.0,
            brightness_swing: 0.0,
        }
    }

    /// A structured-light camera: about 1.1 mm noise at 0.6 m, 1 mm steps, missing depth at edges, grazing angles
    /// and in small holes.
    pub fn structured_light() -> Self {
        Self {
            depth_base: 0.000_4,
            depth_quadratic: 0.001_9,
            depth_grazing: 0.000_1,
            lateral: 0.4,
            quantum: 0.001,
            max_range: 4.0,
            edge_step: 0.02,
            edge_radius: 2,
            edge_dropout: 0.35,
            flying: 0.03,
            grazing_limit: 75f32.to_radians(),
            hole_share: 0.012,
            hole_radius: 5.0,
            color_noise: 2.5,
            exposure: 0.0,
            brightness_swing: 0.05,
        }
    }

    /// Standard deviation (metres) of the depth noise at depth `z` (metres) on a surface whose normal forms an angle
    /// of the given cosine with the ray.
    pub fn depth_sigma(&self, z: f32, cosine: f32) -> f32 {
        let mut sigma = self.depth_base + self.depth_quadratic * z * z;
        if cosine < 0.5 {
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
        // Most surfaces are far from grazing, and the arc cosine is slow.
        if cosine > 0.75 && self.grazing_limit > 0.73 {
            return 0.0;
        }
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
        let range = self.edge_ranges(clean, w, h);
        let mut out = vec![0.0f32; w * h];
        out.par_chunks_mut(w.max(1)).enumerate().for_each(|(y, row)| {
            let mut rng = Draw::new(stream(seed, index as u64, y as u64));
            for (x, pixel) in row.iter_mut().enumerate() {
                *pixel = self.read(clean, &range, [x, y], [w, h], &mut rng);
            }
        });
        self.punch_holes(&mut out, w, h, seed, index);
        Image::from_vec(w, h, out).unwrap_or_default()
    }

    /// One pixel's depth. Draws the same number of random values whatever happens, which keeps rows comparable
    /// between settings.
    fn read(
        &self,
        clean: &Clean,
        range: &[(f32, f32)],
        at: [usize; 2],
        size: [usize; 2],
        rng: &mut Draw,
    ) -> f32 {
        let [across, down] = [rng.rough_normal(), rng.rough_normal()];
        let noise = rng.normal();
        let [[keep_edge, keep_slant], [fly, between]] = [rng.units(), rng.units()];
        // A negative value is cast to zero.
        let moved =
            |v: usize, by: f32, limit: usize| ((v as f32 + self.lateral * by + 0.5) as usize).min(limit - 1);
        let i = moved(at[1], down, size[1]) * size[0] + moved(at[0], across, size[0]);
        let (near, far) = range[at[1] * size[0] + at[0]];
        let on_edge = far - near > self.edge_step;
        if on_edge && keep_edge < self.edge_dropout {
            return 0.0;
        }
        let (mut z, cosine) = (clean.depth[i], clean.cosine[i]);
        if keep_slant < self.grazing_loss(cosine) {
            return 0.0;
        }
        if on_edge && far.is_finite() && fly < self.flying {
            z = near + (far - near) * between;
        }
        z += noise * self.depth_sigma(z, cosine);
        if self.quantum > 0.0 {
            // Depth is positive and small: a cast rounds it without a call.
            z = (z / self.quantum + 0.5) as i32 as f32 * self.quantum;
        }
        if z.is_finite() && z > 0.0 && z <= self.max_range { z } else { 0.0 }
    }

    /// Smallest and largest depth within `edge_radius` of every pixel.
    fn edge_ranges(&self, clean: &Clean, w: usize, h: usize) -> Vec<(f32, f32)> {
        let r = self.edge_radius;
        let join = |a: (f32, f32), b: (f32, f32)| (a.0.min(b.0), a.1.max(b.1));
        let empty = (f32::INFINITY, f32::NEG_INFINITY);
        let mut across = vec![empty; w * h];
        across.par_chunks_mut(w.max(1)).enumerate().for_each(|(y, row)| {
            let z = &clean.depth[y * w..(y + 1) * w];
            for (x, out) in row.iter_mut().enumerate() {
                let window = &z[x.saturating_sub(r)..(x + r + 1).min(w)];
                *out = window.iter().fold(empty, |m, &v| join(m, (v, v)));
            }
        });
        let mut both = vec![empty; w * h];
        both.par_chunks_mut(w.max(1)).enumerate().for_each(|(y, row)| {
            for v in y.saturating_sub(r)..(y + r + 1).min(h) {
                for (x, out) in row.iter_mut().enumerate() {
                    *out = join(*out, across[v * w + x]);
                }
            }
        });
        both
    }

    fn punch_holes(&self, depth: &mut [f32], w: usize, h: usize, seed: u64, index: usize) {
        if self.hole_share <= 0.0 || self.hole_radius <= 0.0 || w == 0 || h == 0 {
            return;
        }
        let mut rng = Draw::new(stream(seed, index as u64, u64::MAX));
        // Radii are even between 30 % and 100 % of the largest: the mean of their squares is 0.463 of its square.
        let area = std::f32::consts::PI * 0.463 * self.hole_radius * self.hole_radius;
        let count = self.hole_share * (w * h) as f32 / area;
        let count = count as usize + usize::from(rng.unit() < count.fract());
        for _ in 0..count {
            let (cx, cy) = (rng.unit() * w as f32, rng.unit() * h as f32);
            let r = self.hole_radius * (0.3 + 0.7 * rng.unit());
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
        let mut out = vec![[0u8; 3]; color.len()];
        out.par_chunks_mut(w.max(1)).enumerate().for_each(|(y, row)| {
            let mut rng = Draw::new(stream(seed ^ 0xc0_10, index as u64, y as u64));
            for (x, pixel) in row.iter_mut().enumerate() {
                let noise = if self.color_noise > 0.0 {
                    std::array::from_fn(|_| rng.rough_normal())
                } else {
                    [0.0; 3]
                };
                *pixel = std::array::from_fn(|k| {
                    let v = color[y * w + x][k] * gain + self.color_noise * noise[k];
                    (v + 0.5) as u8
                });
            }
        });
        Image::from_vec(w, camera.height, out).unwrap_or_default()
    }
}

/// Random values of one row.
struct Draw(Pcg64Mcg);

impl Draw {
    fn new(seed: u128) -> Self {
        Self(Pcg64Mcg::new(seed))
    }

    /// Even in `[0, 1)`.
    fn unit(&mut self) -> f32 {
        (self.0.next_u64() >> 40) as f32 / 16_777_216.0
    }

    /// Two values of one draw, even in `[0, 1)`.
    fn units(&mut self) -> [f32; 2] {
        let v = self.0.next_u64();
        [v >> 40, v >> 8 & 0xff_ffff].map(|b| b as f32 / 16_777_216.0)
    }

    /// A standard normal value (Box and Muller 1958, of whose pair every other one is used).
    fn normal(&mut self) -> f32 {
        let [a, b] = self.units();
        (-2.0 * (1.0 - a).ln()).sqrt() * (std::f32::consts::TAU * b).cos()
    }

    /// Nearly normal, unit variance: the sum of four even values. Good enough for colours, which are rounded.
    fn rough_normal(&mut self) -> f32 {
        const ROOT_3: f32 = 1.732_050_8;
        let v = self.0.next_u64();
        let sum: u64 = (0..4).map(|i| v >> (16 * i) & 0xffff).sum();
        // Four even values on [0, 1) have variance 1/3.
        (sum as f32 / 65_536.0 - 2.0) * ROOT_3
    }
}
