//! Where the time of a training step goes, and what the machine could do at best (feature `bench`).

use crate::adam::{Rate, Update};
use crate::clock::{Stage, thread_seconds};
use crate::config::FieldConfig;
use crate::engine::CpuEngine;
use crate::error::FieldError;
use crate::frame::FieldImages;
use crate::free::active_units;
use crate::grid::FEATURES;
use crate::lanes::Lanes;
use crate::pass::{RunTile, encode};
use crate::pose::PoseCorrections;
use crate::real::{self, Isa};
use crate::round::Round;
use crate::sampler::{Buffers, Sampler};
use crate::simd::Set;
use crate::tile::{Model, Panel, RayPose, Scratch, Tile, TileGradient};
use nalgebra::Isometry3;
use std::sync::Arc;
use std::time::Instant;

/// What one kernel did in the measured steps, all workers together.
#[derive(Clone, Copy, Debug)]
pub struct Kernel {
    /// Name.
    pub name: &'static str,
    /// Seconds of all workers in sum.
    pub seconds: f64,
    /// Floating-point operations of the network products (a multiply-add is two); 0 where another thing is counted.
    pub flops: f64,
    /// Bytes read and written in the tables; 0 where another thing is counted.
    pub bytes: f64,
}

/// The measured steps.
#[derive(Clone, Debug)]
pub struct StepProfile {
    /// Number of steps.
    pub steps: usize,
    /// Wall-clock seconds of the steps.
    pub seconds: f64,
    /// Samples of a step.
    pub samples: usize,
    /// Time by kernel.
    pub kernels: Vec<Kernel>,
}

/// Runs some steps of a round and measures them, after two that don't count. Uses the current rayon pool.
///
/// # Errors
/// As [`train`](crate::train).
pub fn profile_steps(
    config: &FieldConfig,
    frames: &[Arc<FieldImages>],
    poses: &[Isometry3<f64>],
    steps: usize,
) -> Result<StepProfile, FieldError> {
    const WARM_UP: usize = 2;
    let (sampler, mut corrections, mut engine) = prepare(config, frames, poses)?;
    let rates = (config.learning_rate, config.pose_learning_rate);
    for step in 0..WARM_UP {
        engine.step(&sampler, &mut corrections, step, rates);
    }
    let (before, lanes_before) = (engine.seconds(), engine.lanes());
    let start = Instant::now();
    for step in WARM_UP..WARM_UP + steps {
        engine.step(&sampler, &mut corrections, step, rates);
    }
    let seconds = start.elapsed().as_secs_f64();
    let after = engine.seconds();
    let work = Work::of(config, &sampler, &engine);
    let pulled = (engine.lanes()[Stage::Geometry as usize] - lanes_before[Stage::Geometry as usize]) as f64;
    let names = ["sampling", "encode", "geometry", "colour", "eikonal", "poses", "scatter", "adam"];
    let kernels = names
        .iter()
        .enumerate()
        .map(|(k, name)| Kernel {
            name,
            seconds: after[k] - before[k],
            flops: work.flops[k] * steps as f64
                + if k == Stage::Geometry as usize { pulled * work.pulled } else { 0.0 },
            bytes: work.bytes[k] * steps as f64,
        })
        .collect();
    Ok(StepProfile { steps, seconds, samples: work.samples, kernels })
}

fn prepare(
    config: &FieldConfig,
    frames: &[Arc<FieldImages>],
    poses: &[Isometry3<f64>],
) -> Result<(Sampler, PoseCorrections, CpuEngine), FieldError> {
    let Round { sampler, corrections, .. } = Round::new(config, frames, poses)?;
    let engine = CpuEngine::new(config, &sampler);
    Ok((sampler, corrections, engine))
}

/// Work of one step by kernel, from the shapes alone.
struct Work {
    samples: usize,
    /// Operations of the geometry network's gradients on a free lane, on which they depend on the data.
    pulled: f64,
    flops: [f64; 8],
    bytes: [f64; 8],
}

impl Work {
    fn of(config: &FieldConfig, sampler: &Sampler, engine: &CpuEngine) -> Self {
        let (n, c) = (&engine.networks, sampler.counts);
        let samples = c.surface_tiles * c.surface_lanes() + c.ring_tiles * c.ring_lanes();
        let central = (c.surface_tiles * c.central_lanes()) as f64;
        let all = samples as f64;
        let (e, h, f) = (n.encoding() as f64, n.hidden() as f64, n.features as f64);
        // What the first colour layer does once a ray isn't counted.
        let layers = f * h + h * h + 3.0 * h;
        let eikonal = if config.weights.eikonal > 0.0 && config.eikonal_every > 0 {
            central / config.eikonal_every as f64
        } else {
            0.0
        };
        let corners = (8 * FEATURES * size_of::<f32>() * config.levels) as f64 * all;
        Self {
            samples,
            pulled: 4.0 * e * h + 2.0 * h,
            flops: [
                0.0,
                0.0,
                all * 2.0 * (e * h + h) + central * 4.0 * (e * h + h + f * h),
                central * (2.0 * f * h + 6.0 * layers),
                eikonal * 4.0 * e * h,
                0.0,
                0.0,
                0.0,
            ],
            bytes: [0.0, corners, 0.0, 0.0, 0.0, 0.0, 2.0 * corners, 0.0],
        }
    }
}

/// The instruction set that the kernels use on this machine.
pub fn instruction_set() -> &'static str {
    Set::best().name()
}

/// Most multiply-adds that `threads` threads do with the instruction set of the kernels, in operations per second (two
/// a multiply-add) of processor time.
pub fn peak_flops(threads: usize) -> f64 {
    const ROUNDS: usize = 2_000_000;
    let loops = || {
        let mut count = 0;
        let start = thread_seconds();
        Set::best().call(MultiplyAdd { rounds: ROUNDS, count: &mut count });
        2.0 * count as f64 / (thread_seconds() - start)
    };
    let best = (0..3).map(|_| {
        std::thread::scope(|scope| {
            let workers: Vec<_> = (0..threads).map(|_| scope.spawn(loops)).collect();
            workers.into_iter().filter_map(|w| w.join().ok()).sum()
        })
    });
    best.fold(0.0, f64::max)
}

/// Bytes per second that `threads` threads read and write together when they copy arrays larger than any cache.
pub fn peak_bytes(threads: usize) -> f64 {
    const LENGTH: usize = 16 << 20;
    let best = (0..3).map(|_| {
        let mut arrays: Vec<_> = (0..threads).map(|_| (vec![1.0f32; LENGTH], vec![0.0f32; LENGTH])).collect();
        let start = Instant::now();
        std::thread::scope(|scope| {
            for (from, to) in &mut arrays {
                scope.spawn(|| {
                    to.copy_from_slice(from);
                    std::hint::black_box(to);
                });
            }
        });
        (threads * LENGTH * 2 * size_of::<f32>()) as f64 / start.elapsed().as_secs_f64()
    });
    best.fold(0.0, f64::max)
}

/// Independent multiply-adds on twelve registers, `rounds` times each; adds their number to `count`.
struct MultiplyAdd<'a> {
    rounds: usize,
    count: &'a mut usize,
}

impl real::Kernel for MultiplyAdd<'_> {
    #[inline(always)]
    fn run<I: Isa>(self) {
        const SUMS: usize = 12;
        let factor = I::F32::splat(std::hint::black_box(0.999));
        let add = I::F32::splat(std::hint::black_box(0.001));
        let mut sums = [add; SUMS];
        for _ in 0..self.rounds {
            for sum in &mut sums {
                *sum = sum.madd(factor, add);
            }
        }
        for sum in sums {
            std::hint::black_box(sum.total());
        }
        *self.count += self.rounds * SUMS * I::F32::N;
    }
}

/// A part of a tile's forward pass.
struct Forward<'a> {
    model: &'a Model<'a, f32>,
    lanes: usize,
    central: usize,
    /// With these the encoding, without the hidden layer.
    pos: Option<&'a [f32]>,
    scratch: &'a mut Scratch<f32>,
}

impl real::Kernel for Forward<'_> {
    #[inline(always)]
    fn run<I: Isa>(self) {
        for panel in Panel::all(self.lanes, self.central) {
            match self.pos {
                Some(pos) => encode::<f32, I, true>(self.model, (pos, self.lanes), panel, self.scratch),
                None => active_units::<f32, I>(self.model, panel, self.scratch),
            }
        }
    }
}

/// The kernels of a step one by one, for micro-benchmarks.
#[derive(Debug)]
pub struct Kernels {
    sampler: Sampler,
    engine: CpuEngine,
    poses: Vec<RayPose<f32>>,
    tile: Tile<f32>,
    scratch: Scratch<f32>,
    out: TileGradient<f32>,
    buffers: Buffers,
    weights: Vec<f32>,
    moments: [Vec<f32>; 2],
    step: usize,
}

impl Kernels {
    /// Prepares a round and one tile of it.
    ///
    /// # Errors
    /// As [`train`](crate::train).
    pub fn new(
        config: &FieldConfig,
        frames: &[Arc<FieldImages>],
        poses: &[Isometry3<f64>],
    ) -> Result<Self, FieldError> {
        let (sampler, corrections, engine) = prepare(config, frames, poses)?;
        let (lanes, central) = (sampler.counts.surface_lanes(), sampler.counts.central_lanes());
        let mut kernels = Self {
            poses: corrections.ray_poses(),
            tile: Tile::new(lanes, central),
            scratch: Scratch::new(lanes, central, &engine.networks),
            out: TileGradient::new(lanes, central, &engine.networks),
            buffers: Buffers::default(),
            weights: vec![0.0; engine.networks.len],
            moments: [vec![0.0; engine.networks.len], vec![0.0; engine.networks.len]],
            sampler,
            engine,
            step: 0,
        };
        kernels.sample();
        kernels.tile();
        Ok(kernels)
    }

    /// Samples of the tile.
    pub fn lanes(&self) -> usize {
        self.tile.lanes
    }

    /// Draws the rays and samples of a tile.
    pub fn sample(&mut self) {
        self.step += 1;
        self.sampler.fill_surface((self.step, 0), &self.poses, &mut self.tile, &mut self.buffers);
    }

    /// Encodes the tile's samples.
    pub fn encode(&mut self) {
        self.forward(true);
    }

    /// The hidden layer of the geometry network.
    pub fn layer(&mut self) {
        self.forward(false);
    }

    fn forward(&mut self, encode: bool) {
        let Self { engine, tile, out, scratch, .. } = self;
        let model = &engine.model();
        Set::best().call(Forward {
            model,
            lanes: tile.lanes,
            central: tile.central,
            pos: encode.then_some(&out.pos),
            scratch,
        });
    }

    /// The whole tile, forward and backward.
    pub fn tile(&mut self) {
        let Self { engine, poses, tile, scratch, out, weights, .. } = self;
        let model = &engine.model();
        Set::best().call(RunTile { model, poses, tile, scratch, out, grad: weights });
    }

    /// Adam on the networks.
    pub fn adam(&mut self) {
        let [mean, square] = &mut self.moments;
        let (value, grad) = (&mut self.engine.weights, &mut self.weights);
        Set::best().call(Update { rate: Rate::new(1e-3, 1), value, grad, mean, square });
    }
}
