//! Draws a step's rays and samples and writes their targets into tiles.

use crate::config::FieldConfig;
use crate::draws::{Draws, Purpose};
use crate::rays::{FrameRays, RingKind};
use crate::tile::{RAYS, RayPose, Tile};
use crate::volume::Volume;
use octree_sampler::sampling;

/// Samples per ray after rounding to whole vectors.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Counts {
    pub(crate) free: usize,
    pub(crate) band: usize,
    pub(crate) central: usize,
    pub(crate) surface_tiles: usize,
    pub(crate) ring_tiles: usize,
}

impl Counts {
    pub(crate) fn new(config: &FieldConfig) -> Self {
        let band = config.band_samples.next_multiple_of(4);
        Self {
            free: config.free_samples.next_multiple_of(4),
            band,
            central: config.color_samples.next_multiple_of(4).min(band),
            surface_tiles: config.surface_rays.div_ceil(RAYS),
            ring_tiles: config.ring_rays.div_ceil(RAYS),
        }
    }

    /// The first of the band's strata that counts as central: those around the measured depth do.
    pub(crate) fn central_from(&self, behind: f64) -> usize {
        let middle = self.band as f64 / (1.0 + behind);
        (middle - 0.5 * self.central as f64).round().clamp(0.0, (self.band - self.central) as f64) as usize
    }

    pub(crate) fn surface_lanes(&self) -> usize {
        RAYS * (self.free + self.band)
    }

    pub(crate) fn central_lanes(&self) -> usize {
        RAYS * self.central
    }

    pub(crate) fn ring_lanes(&self) -> usize {
        RAYS * self.free
    }
}

/// Everything that stays the same over a round.
#[derive(Debug)]
pub(crate) struct Sampler {
    config: FieldConfig,
    pub(crate) counts: Counts,
    volume: Volume,
    rays: Vec<FrameRays>,
    /// Frames that have rays of a kind.
    pub(crate) surface_frames: Vec<usize>,
    pub(crate) ring_frames: Vec<usize>,
    /// Factor on the losses of each frame's rays.
    weights: Vec<f32>,
}

/// Buffers of one worker.
#[derive(Clone, Debug, Default)]
pub(crate) struct Buffers {
    intervals: Vec<[f32; 2]>,
    depths: Vec<f32>,
}

/// A ray in the object frame, metres.
struct Ray<'a> {
    origin: [f32; 3],
    dir: [f32; 3],
    volume: &'a Volume,
}

impl Ray<'_> {
    /// Whether a sample lies in the cube of the field.
    fn in_cube(&self, t: f32) -> bool {
        let half = 0.4999 * self.volume.edge as f32;
        (0..3).all(|a| (self.origin[a] + t * self.dir[a] - self.volume.center[a] as f32).abs() <= half)
    }
}

impl Sampler {
    /// `None` when no frame has a ray with depth.
    pub(crate) fn new(config: &FieldConfig, volume: Volume, rays: Vec<FrameRays>) -> Option<Self> {
        let surface_frames: Vec<usize> =
            (0..rays.len()).filter(|&f| !rays[f].surface.dir.is_empty()).collect();
        let ring_frames: Vec<usize> = (0..rays.len()).filter(|&f| !rays[f].ring.dir.is_empty()).collect();
        let mut counts = Counts::new(config);
        if ring_frames.is_empty() {
            counts.ring_tiles = 0;
        }
        let mut weights = vec![1.0; rays.len()];
        if let Some(first) = weights.first_mut() {
            *first = config.first_frame_weight as f32;
        }
        (!surface_frames.is_empty()).then(|| Self {
            config: config.clone(),
            weights,
            counts,
            volume,
            rays,
            surface_frames,
            ring_frames,
        })
    }

    pub(crate) fn volume(&self) -> &Volume {
        &self.volume
    }

    pub(crate) fn rays(&self) -> &[FrameRays] {
        &self.rays
    }

    fn draws(&self, purpose: Purpose, step: usize, ray: usize) -> Draws {
        Draws::new(self.config.seed, purpose, step, ray)
    }

    fn ray<'a>(&'a self, pose: &RayPose<f32>, dir: [f32; 3]) -> Ray<'a> {
        let v = &self.volume;
        Ray {
            origin: std::array::from_fn(|a| pose.translation[a] * v.edge as f32 + v.center[a] as f32),
            dir: pose.rotation.map(|row| row[0] * dir[0] + row[1] * dir[1] + row[2] * dir[2]),
            volume: v,
        }
    }

    /// Multiplies the configured weight of each frame's rays by its trust.
    pub(crate) fn set_trust(&mut self, trust: &[f32]) {
        for (f, (weight, trust)) in self.weights.iter_mut().zip(trust).enumerate() {
            *weight = trust * if f == 0 { self.config.first_frame_weight as f32 } else { 1.0 };
        }
    }

    /// Rays with depth: free samples first, then the outer band, then the central band.
    pub(crate) fn fill_surface(
        &self,
        (step, index): (usize, usize),
        poses: &[RayPose<f32>],
        tile: &mut Tile<f32>,
        buffers: &mut Buffers,
    ) {
        let (c, n) = (&self.config, self.counts);
        let rays = (n.surface_tiles * RAYS) as f32;
        let active = step as f64 >= c.color_start * c.steps as f64;
        tile.has_color = c.weights.color > 0.0 && active;
        tile.has_eikonal =
            c.weights.eikonal > 0.0 && c.eikonal_every > 0 && (index + step) % c.eikonal_every == 0;
        tile.w_uncertain.fill(0.0);
        tile.bell.fill(0.0);
        tile.w_eikonal.fill(0.0);
        let eikonal = c.weights.eikonal as f32 * c.eikonal_every as f32 / (rays * n.central as f32);
        let falloff_rate = if c.surface_falloff > 0.0 { (1.0 / c.surface_falloff) as f32 } else { 0.0 };
        let central_from = n.central_from(c.behind);
        for r in 0..RAYS {
            let slot = step * n.surface_tiles * RAYS + index * RAYS + r;
            let frame = self.surface_frames[slot % self.surface_frames.len()];
            let source = &self.rays[frame].surface;
            let mut draws = self.draws(Purpose::Surface, step, index * RAYS + r);
            let i = draws.pick(source.dir.len());
            let (d, cosine, deep) = (source.distance[i], source.cosine[i], source.depth[i]);
            let weight = self.weights[frame];
            let behind = (c.behind as f32).min(deep);
            tile.frame[r] = frame;
            tile.dir[r] = source.dir[i];
            tile.color[r] = source.color[i];
            tile.w_color[r] = weight * c.weights.color as f32 / (3.0 * rays);
            let ray = self.ray(&poses[frame], source.dir[i]);
            let half = c.truncation as f32;
            let far = d + c.behind as f32 * half;

            buffers.depths.clear();
            self.volume.octree.intervals(ray.origin, ray.dir, 0.0, far, &mut buffers.intervals);
            sampling::stratified(&buffers.intervals, n.free, || draws.uniform(), &mut buffers.depths);
            if buffers.depths.is_empty() {
                // The pose has moved the ray out of the occupied space: keep to the space before the surface.
                sampling::band(d - 3.0 * half, d, n.free, || draws.uniform(), &mut buffers.depths);
            }
            buffers.depths.resize(n.free, d);
            sampling::band(d - half, far, n.band, || draws.uniform(), &mut buffers.depths);
            buffers.depths.resize(n.free + n.band, d);

            let (w_surface, w_empty) = (
                cosine * cosine * weight * c.weights.surface as f32 / (rays * n.band as f32),
                weight * c.weights.empty as f32 / (rays * n.free as f32),
            );
            let mut bell_sum = 1e-10;
            for (k, &t) in buffers.depths.iter().enumerate() {
                let row = match k.checked_sub(n.free) {
                    None => k,
                    Some(b) if b < central_from => k,
                    Some(b) if b >= central_from + n.central => k - n.central,
                    Some(b) => n.free + n.band - n.central + (b - central_from),
                };
                let lane = row * RAYS + r;
                let target = (d - t) * cosine / c.truncation as f32;
                let inside = ray.in_cube(t);
                let near = inside && target.abs() <= 1.0 && target >= -behind - 1e-3;
                tile.t[lane] = t / self.volume.edge as f32;
                tile.target[lane] = if target > 1.0 { c.free_distance as f32 } else { target };
                let falloff = 1.0 / (1.0 + (target * falloff_rate).powi(2));
                tile.w_surface[lane] = if near { w_surface * falloff } else { 0.0 };
                tile.w_empty[lane] = if inside && target > 1.0 { w_empty } else { 0.0 };
                if lane >= tile.lanes - tile.central && near {
                    let central = lane - (tile.lanes - tile.central);
                    let e = (-(c.color_sharpness as f32) * target).exp();
                    tile.bell[central] = e / ((1.0 + e) * (1.0 + e));
                    bell_sum += tile.bell[central];
                    tile.w_eikonal[central] = weight * eikonal;
                }
            }
            for b in tile.bell.iter_mut().skip(r).step_by(RAYS) {
                *b /= bell_sum;
            }
            if bell_sum < 1e-6 {
                tile.w_color[r] = 0.0;
            }
        }
    }

    /// Rays through the ring around the mask: free samples only.
    pub(crate) fn fill_ring(
        &self,
        (step, index): (usize, usize),
        poses: &[RayPose<f32>],
        tile: &mut Tile<f32>,
        buffers: &mut Buffers,
    ) {
        let (c, n) = (&self.config, self.counts);
        let samples = (n.ring_tiles * RAYS * n.free) as f32;
        for r in 0..RAYS {
            let slot = step * n.ring_tiles * RAYS + index * RAYS + r;
            let frame = self.ring_frames[slot % self.ring_frames.len()];
            let source = &self.rays[frame].ring;
            let mut draws = self.draws(Purpose::Ring, step, index * RAYS + r);
            let i = draws.pick(source.dir.len());
            let weight = self.weights[frame] / samples;
            tile.frame[r] = frame;
            tile.dir[r] = source.dir[i];
            let ray = self.ray(&poses[frame], source.dir[i]);
            buffers.depths.clear();
            self.volume.octree.intervals(ray.origin, ray.dir, 0.0, source.limit[i], &mut buffers.intervals);
            sampling::stratified(&buffers.intervals, n.free, || draws.uniform(), &mut buffers.depths);
            let hit = !buffers.depths.is_empty();
            buffers.depths.resize(n.free, 0.0);
            let empty = source.kind[i] == RingKind::Empty;
            let clearance = source.clearance[i];
            let least = if empty { clearance } else { clearance.min(c.epsilon as f32) };
            for (k, &t) in buffers.depths.iter().enumerate() {
                let lane = k * RAYS + r;
                let on = hit && ray.in_cube(t);
                tile.t[lane] = if on { t / self.volume.edge as f32 } else { 0.0 };
                tile.target[lane] = least;
                tile.w_empty[lane] = if on && empty { weight * c.weights.empty as f32 } else { 0.0 };
                tile.w_uncertain[lane] = if on && !empty { weight * c.weights.uncertain as f32 } else { 0.0 };
            }
        }
    }
}
