//! The device's memory of a round.

use super::device::{Gpu, fail};
use super::layout::WeightLayout;
use super::upload::Upload;
use crate::error::FieldError;
use crate::field::Parameters;
use crate::grid::{FEATURES, GROUP};
use crate::round::Round;
use crate::tile::{RAYS, loss};

/// Steps whose schedule and losses fit on the device at a time.
pub(crate) const BATCH: usize = 4096;
/// Lanes for which a copy of the network gradient pays, and most copies.
const CHUNK_LANES: u32 = 512;
const MAX_CHUNKS: u32 = 64;

/// Numbers of rays, samples and features.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sizes {
    pub(crate) frames: u32,
    pub(crate) surface_rays: u32,
    pub(crate) ring_rays: u32,
    pub(crate) free: u32,
    /// Samples of a surface ray, the central ones among them.
    pub(crate) rows: u32,
    pub(crate) central: u32,
    /// Padded width of the encoding.
    pub(crate) encoding: u32,
    pub(crate) hidden: u32,
    pub(crate) features: u32,
    pub(crate) color_in: u32,
    /// Vertices of all lattices.
    pub(crate) vertices: u32,
    /// Copies of the network gradient.
    pub(crate) chunks: u32,
}

impl Sizes {
    pub(crate) fn new(round: &Round, parameters: &Parameters) -> Self {
        let (n, networks) = (round.sampler.counts, &parameters.networks);
        let mut sizes = Self {
            frames: round.frames.len() as u32,
            surface_rays: (n.surface_tiles * RAYS) as u32,
            ring_rays: (n.ring_tiles * RAYS) as u32,
            free: n.free as u32,
            rows: (n.free + n.band) as u32,
            central: n.central as u32,
            encoding: networks.encoding() as u32,
            hidden: networks.hidden() as u32,
            features: networks.features as u32,
            color_in: networks.color[0].inputs as u32,
            vertices: parameters.grid.levels.iter().map(|l| l.len as u32).sum(),
            chunks: 1,
        };
        sizes.chunks = sizes.lanes().div_ceil(CHUNK_LANES).min(MAX_CHUNKS);
        sizes
    }

    pub(crate) fn rays(&self) -> u32 {
        self.surface_rays + self.ring_rays
    }

    pub(crate) fn ring_lanes(&self) -> u32 {
        self.ring_rays * self.free
    }

    /// Samples of a step: those of the ring rays, then those of the surface rays, the central ones last.
    pub(crate) fn lanes(&self) -> u32 {
        self.ring_lanes() + self.surface_rays * self.rows
    }

    pub(crate) fn central_lanes(&self) -> u32 {
        self.surface_rays * self.central
    }

    pub(crate) fn central_from(&self) -> u32 {
        self.lanes() - self.central_lanes()
    }
}

/// All buffers of a round. Rows are features, axes or channels, columns are lanes: `[row][lane]`.
#[derive(Debug)]
pub(crate) struct Buffers {
    // What is trained.
    pub(crate) table: wgpu::Buffer,
    pub(crate) table_gradient: wgpu::Buffer,
    pub(crate) first_moments: wgpu::Buffer,
    pub(crate) second_moments: wgpu::Buffer,
    pub(crate) touched: wgpu::Buffer,
    pub(crate) weights: wgpu::Buffer,
    pub(crate) weight_gradient: wgpu::Buffer,
    pub(crate) weight_moments: wgpu::Buffer,
    pub(crate) theta: wgpu::Buffer,
    pub(crate) theta_gradient: wgpu::Buffer,
    pub(crate) theta_moments: wgpu::Buffer,
    // What it is trained on.
    pub(crate) initial_poses: wgpu::Buffer,
    pub(crate) poses: wgpu::Buffer,
    pub(crate) frames: wgpu::Buffer,
    pub(crate) slots: wgpu::Buffer,
    pub(crate) candidates: wgpu::Buffer,
    pub(crate) occupancy: wgpu::Buffer,
    pub(crate) schedule: wgpu::Buffer,
    pub(crate) losses: wgpu::Buffer,
    // A step's rays.
    pub(crate) rays: wgpu::Buffer,
    pub(crate) ray_losses: wgpu::Buffer,
    pub(crate) twists: wgpu::Buffer,
    // Their samples.
    pub(crate) samples: wgpu::Buffer,
    pub(crate) places: wgpu::Buffer,
    pub(crate) d_places: wgpu::Buffer,
    pub(crate) encoding: wgpu::Buffer,
    pub(crate) d_encoding: wgpu::Buffer,
    pub(crate) hidden: wgpu::Buffer,
    pub(crate) d_hidden: wgpu::Buffer,
    pub(crate) sdf: wgpu::Buffer,
    pub(crate) d_sdf: wgpu::Buffer,
    // Central samples: colour.
    pub(crate) central: wgpu::Buffer,
    pub(crate) color_in: wgpu::Buffer,
    pub(crate) d_color_in: wgpu::Buffer,
    pub(crate) color_a: wgpu::Buffer,
    pub(crate) color_b: wgpu::Buffer,
    pub(crate) d_color_a: wgpu::Buffer,
    pub(crate) d_color_b: wgpu::Buffer,
    pub(crate) rgb: wgpu::Buffer,
    // Central samples: eikonal term.
    pub(crate) active: wgpu::Buffer,
    pub(crate) by_feature: wgpu::Buffer,
    pub(crate) gamma: wgpu::Buffer,
    pub(crate) q: wgpu::Buffer,
    pub(crate) units: wgpu::Buffer,
    pub(crate) lane_losses: wgpu::Buffer,
    // Queries.
    pub(crate) query_encoding: wgpu::Buffer,
    pub(crate) directions: wgpu::Buffer,
}

impl Buffers {
    /// Allocates all, or says which one the adapter can't hold.
    pub(crate) fn new(
        gpu: &Gpu,
        sizes: &Sizes,
        weights: &WeightLayout,
        upload: &Upload,
    ) -> Result<Self, FieldError> {
        let limits = gpu.limits();
        let most = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
        let mut too_large = None;
        let mut of = |name: &str, numbers: u64| {
            // A binding's size is a multiple of 16 where a kernel reads vectors.
            let bytes = (4 * numbers).next_multiple_of(16).max(16);
            if bytes > most || too_large.is_some() {
                too_large.get_or_insert(format!(
                    "the buffer {name} needs {} MiB, {} allows {}; use fewer rays, samples or lattice cells, or the CPU",
                    bytes >> 20,
                    gpu.name(),
                    most >> 20
                ));
                return gpu.zeros(name, 16);
            }
            gpu.zeros(name, bytes)
        };
        let wide = |n: u32| u64::from(n);
        let (n, c, rays) = (wide(sizes.lanes()), wide(sizes.central_lanes()), wide(sizes.rays()));
        let (e, h, frames) = (wide(sizes.encoding), wide(sizes.hidden), wide(sizes.frames));
        let table = wide(sizes.vertices) * FEATURES as u64;
        let copy = wide(weights.len);
        let scope = gpu.catch_out_of_memory();
        let buffers = Self {
            // The largest first: what follows is not allocated when it does not fit.
            hidden: of("hidden", h * n),
            table: of("table", table),
            table_gradient: of("table_gradient", table),
            first_moments: of("first_moments", table),
            second_moments: of("second_moments", table),
            touched: of("touched", wide(sizes.vertices) / GROUP as u64),
            weights: of("weights", copy),
            weight_gradient: of("weight_gradient", copy * wide(sizes.chunks)),
            weight_moments: of("weight_moments", 2 * copy),
            theta: of("theta", 6 * frames),
            theta_gradient: of("theta_gradient", 6 * frames),
            theta_moments: of("theta_moments", 12 * frames),
            initial_poses: of("initial_poses", 16 * frames),
            poses: of("poses", 16 * frames),
            frames: of("frames", upload.frames.len() as u64),
            slots: of("slots", upload.slots.len() as u64),
            candidates: of("candidates", upload.candidates.len() as u64),
            occupancy: of("occupancy", upload.occupancy.len() as u64),
            schedule: of("schedule", 8 * (1 + BATCH as u64)),
            losses: of("losses", (loss::COUNT * BATCH) as u64),
            rays: of("rays", 12 * rays),
            ray_losses: of("ray_losses", loss::COUNT as u64 * rays),
            twists: of("twists", 6 * rays),
            samples: of("samples", 4 * n),
            places: of("places", 3 * n),
            d_places: of("d_places", 3 * n),
            encoding: of("encoding", e * n),
            d_encoding: of("d_encoding", e * n),
            d_hidden: of("d_hidden", h * n),
            sdf: of("sdf", n),
            d_sdf: of("d_sdf", n),
            central: of("central", 2 * c),
            color_in: of("color_in", wide(sizes.color_in) * c),
            d_color_in: of("d_color_in", wide(sizes.color_in) * c),
            color_a: of("color_a", h * c),
            color_b: of("color_b", h * c),
            d_color_a: of("d_color_a", h * c),
            d_color_b: of("d_color_b", h * c),
            rgb: of("rgb", 3 * c),
            active: of("active", h * c),
            by_feature: of("by_feature", e * c),
            gamma: of("gamma", 4 * c),
            q: of("q", e * c),
            units: of("units", h * c),
            lane_losses: of("lane_losses", c),
            query_encoding: of("query_encoding", e * c),
            directions: of("directions", 4 * c),
        };
        gpu.caught(scope, "not enough memory for a step; use fewer rays or samples, or the CPU")?;
        match too_large {
            Some(text) => Err(fail(&text)),
            None => gpu.check().map(|()| buffers),
        }
    }
}
