//! The CPU engine: one training step on all cores, bit-identical for any number of them.
//!
//! A step has three phases. Tiles run in a fixed number of chunks, each with its own gradient of the small networks.
//! The chunks' gradients are added in order. Then every lattice of the grid scatters its gradients and updates
//! itself, one task per lattice, so that no two threads write the same vertex and no sum depends on timing.

use crate::adam::{PartState, Rate, Update};
use crate::clock::Stage;
use crate::config::FieldConfig;
use crate::field::Parameters;
use crate::grid::Grid;
use crate::mlp::Networks;
use crate::pass::{FinishTiles, RunTile};
use crate::pose::PoseCorrections;
use crate::query::Query;
use crate::sampler::{Buffers, Sampler};
use crate::scatter::Scatter;
use crate::simd::Set;
use crate::tile::{Aligned, Model, RAYS, RayPose, Scratch, Tile, TileGradient, loss};
use nalgebra::Vector6;
use rayon::prelude::*;

/// Number of chunks; fixed, so that the order of additions does not depend on the number of threads.
const CHUNKS: usize = 16;

/// Points per frame that are asked how well the frame fits.
const RESIDUAL_POINTS: usize = 256;
/// Points evaluated together.
const LANES: usize = 64;

/// Amplitude of the grid's initial features.
const GRID_AMPLITUDE: f64 = 1e-4;

/// Where every engine starts, with this many frames.
pub(crate) fn initial_parameters(config: &FieldConfig, frames: usize) -> Parameters {
    let resolutions = (config.base_resolution, config.finest_resolution);
    let grid = Grid::new(config.levels, resolutions, config.log2_table_size, GRID_AMPLITUDE, config.seed);
    let networks =
        Networks::new(grid.width(), config.hidden, config.geometry_features, (config.appearance, frames));
    Parameters { weights: networks.init(config.seed), grid, networks }
}

/// Tiles handled by one task.
#[derive(Debug)]
struct Chunk {
    surface: std::ops::Range<usize>,
    ring: std::ops::Range<usize>,
    surface_tile: Tile<f32>,
    ring_tile: Tile<f32>,
    scratch: Scratch<f32>,
    buffers: Buffers,
    gradients: Vec<TileGradient<f32>>,
    weights: Aligned<f32>,
}

/// State of a round on the CPU.
#[derive(Debug)]
pub(crate) struct CpuEngine {
    pub(crate) grid: Grid<f32>,
    pub(crate) networks: Networks,
    pub(crate) weights: Aligned<f32>,
    /// Transposes of some of the weights.
    flipped: Aligned<f32>,
    /// Means of the weights' gradient and of its square.
    moments: [Vec<f32>; 2],
    /// Finest lattice first: it takes longest.
    parts: Vec<PartState>,
    chunks: Vec<Chunk>,
    truncation: f32,
    set: Set,
}

impl CpuEngine {
    pub(crate) fn new(config: &FieldConfig, sampler: &Sampler) -> Self {
        let Parameters { grid, networks, weights: initial } =
            initial_parameters(config, sampler.rays().len());
        let n = sampler.counts;
        let (lanes, central) = (n.surface_lanes(), n.central_lanes());
        let share = |tiles: usize, c: usize| c * tiles / CHUNKS..(c + 1) * tiles / CHUNKS;
        let chunks = (0..CHUNKS)
            .map(|c| {
                let (surface, ring) = (share(n.surface_tiles, c), share(n.ring_tiles, c));
                let gradients = surface
                    .clone()
                    .map(|_| TileGradient::new(lanes, central, &networks))
                    .chain(ring.clone().map(|_| TileGradient::new(n.ring_lanes(), 0, &networks)))
                    .collect();
                Chunk {
                    surface,
                    ring,
                    surface_tile: Tile::new(lanes, central),
                    ring_tile: Tile::new(n.ring_lanes(), 0),
                    scratch: Scratch::new(lanes, central, &networks),
                    buffers: Buffers::default(),
                    gradients,
                    weights: Aligned::zeros(networks.len),
                }
            })
            .collect();
        let mut weights = Aligned::zeros(networks.len);
        weights.copy_from_slice(&initial);
        let flipped = networks.flip_all(&weights);
        let parts = grid.levels.iter().enumerate().rev();
        Self {
            parts: parts
                .flat_map(|(l, level)| level.parts().map(move |vertices| PartState::new(l, vertices)))
                .collect(),
            moments: [vec![0.0; networks.len], vec![0.0; networks.len]],
            weights,
            flipped,
            grid,
            networks,
            chunks,
            truncation: (config.truncation / sampler.volume().edge) as f32,
            set: Set::best(),
        }
    }

    pub(crate) fn parameters(&self) -> Parameters {
        Parameters { grid: self.grid.clone(), networks: self.networks, weights: self.weights.to_vec() }
    }

    pub(crate) fn into_parameters(self) -> Parameters {
        Parameters { grid: self.grid, networks: self.networks, weights: self.weights.to_vec() }
    }

    /// One step: samples, gradients, updates. Returns the weighted losses; poses are updated in place.
    pub(crate) fn step(
        &mut self,
        sampler: &Sampler,
        poses: &mut PoseCorrections,
        step: usize,
        (rate, pose_rate): (f64, f64),
    ) -> [f64; loss::COUNT] {
        let ray_poses = poses.ray_poses::<f32>();
        let set = self.set;
        let mut chunks = std::mem::take(&mut self.chunks);
        let model = self.model();
        chunks
            .par_iter_mut()
            .with_max_len(1)
            .for_each(|chunk| chunk.run(set, &model, sampler, &ray_poses, step));
        self.chunks = chunks;

        let iteration = step + 1;
        let losses = self.update_poses(poses, pose_rate, iteration);
        let rate = Rate::new(rate, iteration);
        let (first, others) = self.chunks.split_at_mut(1);
        let total = &mut first[0].weights;
        for chunk in others {
            for (t, g) in total.iter_mut().zip(chunk.weights.iter_mut()) {
                *t += std::mem::take(g);
            }
        }
        let [mean, square] = &mut self.moments;
        set.call(Update { rate, value: &mut self.weights, grad: total, mean, square });
        self.networks.flip(&self.weights, &mut self.flipped);

        let chunks = &self.chunks;
        self.grid.shares(&mut self.parts).into_par_iter().with_max_len(1).for_each(|(level, part, table)| {
            part.clock.start();
            for tile in chunks.iter().flat_map(|c| &c.gradients) {
                set.call(Scatter { level, l: part.level, tile, to: &mut part.vertices() });
            }
            part.step(set, rate, table);
        });
        losses
    }

    pub(crate) fn model(&self) -> Model<'_, f32> {
        Model {
            grid: &self.grid,
            networks: &self.networks,
            weights: &self.weights,
            flipped: &self.flipped,
            truncation: self.truncation,
        }
    }

    /// Per frame, how far its points are from the present surface (truncation units): the 70th percentile, so that a
    /// frame whose wrong pose is contradicted by others over part of its surface shows too. NaN without points.
    pub(crate) fn residuals(&self, sampler: &Sampler, poses: &PoseCorrections) -> Vec<f32> {
        let model = self.model();
        let inverse = 1.0 / sampler.volume().edge as f32;
        let ray_poses = poses.ray_poses::<f32>();
        sampler
            .rays()
            .par_iter()
            .zip(&ray_poses)
            .map(|(rays, pose)| {
                let rays = &rays.surface;
                let take = rays.dir.len().min(RESIDUAL_POINTS);
                let mut scratch = Scratch::new(LANES, LANES, &self.networks);
                let mut pos = vec![0.5; 3 * LANES];
                let mut errors = Vec::with_capacity(take);
                for start in (0..take).step_by(LANES) {
                    let count = (take - start).min(LANES);
                    for l in 0..count {
                        let i = (start + l) * rays.dir.len() / take;
                        let (d, t) = (rays.dir[i], rays.distance[i] * inverse);
                        for a in 0..3 {
                            let row = pose.rotation[a];
                            let along = row[0] * d[0] + row[1] * d[1] + row[2] * d[2];
                            pos[a * LANES + l] = (0.5 + pose.translation[a] + t * along).clamp(0.0, 1.0);
                        }
                    }
                    self.set.call(Query::<f32, false> {
                        model: &model,
                        lanes: LANES,
                        pos: &pos,
                        scratch: &mut scratch,
                    });
                    errors.extend(scratch.distances()[..count].iter().map(|s| s.abs()));
                }
                if errors.is_empty() {
                    return f32::NAN;
                }
                let rank = errors.len() * 7 / 10;
                *errors.select_nth_unstable_by(rank, f32::total_cmp).1
            })
            .collect()
    }

    fn update_poses(&self, poses: &mut PoseCorrections, rate: f64, iteration: usize) -> [f64; loss::COUNT] {
        let mut twists = vec![Vector6::zeros(); poses.theta.len()];
        let mut losses = [0.0; loss::COUNT];
        for tile in self.chunks.iter().flat_map(|c| &c.gradients) {
            for r in 0..RAYS {
                twists[tile.frame[r]] += Vector6::from(tile.twist[r].map(f64::from));
            }
            for (sum, l) in losses.iter_mut().zip(tile.losses) {
                *sum += f64::from(l);
            }
        }
        if rate > 0.0 && poses.theta.len() > 1 {
            poses.step(&twists, rate, iteration);
        }
        losses
    }
}

#[cfg(feature = "bench")]
impl CpuEngine {
    fn clocks(&self) -> impl Iterator<Item = &crate::clock::Clock> {
        self.chunks.iter().map(|c| &c.scratch.clock).chain(self.parts.iter().map(|p| &p.clock))
    }

    /// Lanes that stages counted, so far.
    pub(crate) fn lanes(&self) -> [usize; crate::clock::STAGES] {
        self.clocks().fold(Default::default(), |sum: [usize; crate::clock::STAGES], clock| {
            let lanes = clock.lanes();
            std::array::from_fn(|s| sum[s] + lanes[s])
        })
    }

    /// Seconds of all workers by stage, so far.
    pub(crate) fn seconds(&self) -> [f64; crate::clock::STAGES] {
        let clocks = self.clocks();
        clocks.fold(Default::default(), |sum: [f64; crate::clock::STAGES], clock| {
            let seconds = clock.seconds();
            std::array::from_fn(|s| sum[s] + seconds[s])
        })
    }
}

impl Chunk {
    fn run(
        &mut self,
        set: Set,
        model: &Model<'_, f32>,
        sampler: &Sampler,
        poses: &[RayPose<f32>],
        step: usize,
    ) {
        let Self { surface, ring, surface_tile, ring_tile, scratch, buffers, gradients, weights } = self;
        let mut outs = gradients.iter_mut();
        for index in surface.clone() {
            let Some(out) = outs.next() else { return };
            scratch.clock.start();
            sampler.fill_surface((step, index), poses, surface_tile, buffers);
            scratch.clock.lap(Stage::Sample);
            set.call(RunTile { model, poses, tile: surface_tile, scratch, out, grad: weights });
        }
        for index in ring.clone() {
            let Some(out) = outs.next() else { return };
            scratch.clock.start();
            sampler.fill_ring((step, index), poses, ring_tile, buffers);
            scratch.clock.lap(Stage::Sample);
            set.call(RunTile { model, poses, tile: ring_tile, scratch, out, grad: weights });
        }
        scratch.clock.start();
        set.call(FinishTiles { model, scratch, grad: weights });
        scratch.clock.lap(Stage::Geometry);
    }
}
