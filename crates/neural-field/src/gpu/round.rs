//! A round on a GPU.

use super::buffers::{BATCH, Buffers, Sizes};
use super::device::{Dispatch, Gpu, fail};
use super::layout::WeightLayout;
use super::program::{MAX_LEVELS, Plan};
use super::upload::Upload;
use crate::adam::Rate;
use crate::config::FieldConfig;
use crate::engine::initial_parameters;
use crate::error::FieldError;
use crate::field::{Parameters, TrainedField};
use crate::frame::FieldImages;
use crate::grid::FEATURES;
use crate::round::{Engine, Round};
use crate::tile::loss;
use crate::train::{Control, StepLosses};
use nalgebra::{Isometry3, Vector6};
use std::sync::Arc;
use std::sync::atomic::Ordering;

/// Steps handed to the device at a time: enough to keep it busy, few enough to stop soon when asked to.
const SUBMIT: usize = 8;
/// Words of the schedule before its steps, and of a step.
const STEP_WORDS: usize = 8;

/// A round on a GPU: what [`CpuRound`](crate::CpuRound) does, on an opened [`Gpu`].
#[derive(Debug)]
pub struct GpuRound {
    pub(super) gpu: Gpu,
    pub(super) round: Round,
    /// Shapes, and the values as last downloaded.
    pub(super) parameters: Parameters,
    pub(super) layout: WeightLayout,
    pub(super) sizes: Sizes,
    pub(super) buffers: Buffers,
    pub(super) programs: Programs,
    losses: Vec<StepLosses>,
    snapshot: Option<Arc<TrainedField>>,
}

/// Everything the device is ever told to do in a round, recorded once.
#[derive(Debug)]
pub(super) struct Programs {
    /// Gradients without and with colour.
    pub(super) gradients: [Vec<Dispatch>; 2],
    pub(super) updates: Vec<Dispatch>,
    query: Vec<Dispatch>,
    query_slopes: Vec<Dispatch>,
    query_color: Vec<Dispatch>,
}

impl GpuRound {
    /// Prepares a round as [`train`](crate::train) does, and sends it to the device.
    ///
    /// # Errors
    /// Unusable input, or a device that is too small or fails; [`FieldError`] says what to change.
    pub fn new(
        gpu: &Gpu,
        config: &FieldConfig,
        frames: &[Arc<FieldImages>],
        poses: &[Isometry3<f64>],
    ) -> Result<Self, FieldError> {
        gpu.check()?;
        if config.appearance > 0 || config.outlier_ratio > 0.0 {
            return Err(fail("appearance codes and outlier_ratio, which the kernels don't know"));
        }
        let round = Round::new(config, frames, poses)?;
        let parameters = initial_parameters(config, frames.len());
        if parameters.grid.levels.len() > MAX_LEVELS {
            return Err(fail("more lattices than the kernels' tables hold"));
        }
        let layout = WeightLayout::new(&parameters.networks);
        let sizes = Sizes::new(&round, &parameters);
        let upload = Upload::new(&round);
        let buffers = Buffers::new(gpu, &sizes, &layout, &upload)?;
        let table: Vec<f32> = parameters.grid.tables.iter().flatten().copied().collect();
        gpu.write(&buffers.table, bytemuck::cast_slice(&table));
        gpu.write(&buffers.weights, bytemuck::cast_slice(&layout.for_device(&parameters.weights)));
        gpu.write(&buffers.initial_poses, bytemuck::cast_slice(&upload.poses));
        gpu.write(&buffers.frames, bytemuck::cast_slice(&upload.frames));
        gpu.write(&buffers.slots, bytemuck::cast_slice(&upload.slots));
        gpu.write(&buffers.candidates, bytemuck::cast_slice(&upload.candidates));
        gpu.write(&buffers.occupancy, bytemuck::cast_slice(&upload.occupancy));
        let plan = Plan {
            gpu,
            round: &round,
            sizes: &sizes,
            weights: &layout,
            levels: &parameters.grid.levels,
            buffers: &buffers,
            upload: &upload,
            truncation: (config.truncation / round.sampler.volume().edge) as f32,
        };
        let programs = Programs {
            gradients: [plan.gradients(false), plan.gradients(true)],
            updates: plan.updates(),
            query: plan.query(false),
            query_slopes: plan.query(true),
            query_color: plan.query_color(),
        };
        gpu.wait(None)?;
        let (losses, snapshot) = (Vec::new(), None);
        let gpu = gpu.clone();
        Ok(Self { gpu, round, parameters, layout, sizes, buffers, programs, losses, snapshot })
    }

    /// Learning rates of the next steps, with the cursor on the first of them.
    pub(super) fn write_schedule(&self, first: usize, steps: usize) {
        let mut words = vec![0u32; STEP_WORDS];
        for step in first..first + steps {
            let (rate, pose_rate) = self.round.rates(step);
            let (adam, t) = (Rate::new(rate, step + 1), (step + 1) as f64);
            let moves = pose_rate > 0.0 && self.round.frames.len() > 1;
            let pose_rate = if moves { pose_rate / (1.0 - 0.9f64.powf(t)) } else { 0.0 };
            let pose_root = 1.0 / (1.0 - 0.999f64.powf(t));
            let numbers = [adam.step, adam.root, pose_rate as f32, pose_root as f32];
            words.push(step as u32);
            words.extend(numbers.map(f32::to_bits));
            words.extend([0; 3]);
        }
        self.gpu.write(&self.buffers.schedule, bytemuck::cast_slice(&words));
    }

    /// Whether a step trains colour.
    pub(super) fn has_color(&self, step: usize) -> bool {
        let c = &self.round.config;
        c.weights.color > 0.0 && step as f64 >= c.color_start * c.steps as f64
    }

    /// At most [`BATCH`] steps.
    fn batch(&mut self, steps: usize, control: &Control<'_>) -> Result<(), FieldError> {
        let first = self.losses.len();
        self.write_schedule(first, steps);
        let mut earlier = None;
        for from in (first..first + steps).step_by(SUBMIT) {
            if control.stop.is_some_and(|s| s.load(Ordering::Relaxed)) {
                return Err(FieldError::Stopped);
            }
            let to = (from + SUBMIT).min(first + steps);
            let dispatches = (from..to).flat_map(|step| {
                self.programs.gradients[usize::from(self.has_color(step))]
                    .iter()
                    .chain(&self.programs.updates)
            });
            let submission = self.gpu.submit(dispatches);
            // One submission runs while the next is recorded; more would only delay a stop.
            if let Some(earlier) = earlier.replace(submission) {
                self.gpu.wait(Some(earlier))?;
            }
        }
        let values = self.gpu.read(&self.buffers.losses, loss::COUNT * steps)?;
        for (i, values) in values.as_chunks::<{ loss::COUNT }>().0.iter().enumerate() {
            let losses = StepLosses::from(values.map(f64::from));
            if !losses.total().is_finite() {
                return Err(FieldError::Diverged { step: first + i });
            }
            self.losses.push(losses);
            if let Some(progress) = control.progress {
                progress(first + i, &losses);
            }
        }
        Ok(())
    }

    /// Fetches what was trained.
    pub(super) fn download(&mut self) -> Result<(), FieldError> {
        let table = self.gpu.read(&self.buffers.table, self.sizes.vertices as usize * FEATURES)?;
        let mut rest = table.as_slice();
        for level in &mut self.parameters.grid.tables {
            let (mine, others) = rest.split_at(level.len().min(rest.len()));
            level[..mine.len()].copy_from_slice(mine);
            rest = others;
        }
        let weights = self.gpu.read(&self.buffers.weights, self.layout.len as usize)?;
        self.layout.of_device(&weights, &mut self.parameters.weights);
        let theta = self.gpu.read(&self.buffers.theta, 6 * self.round.frames.len())?;
        for (to, from) in self.round.corrections.theta.iter_mut().zip(theta.as_chunks::<6>().0) {
            *to = Vector6::from(from.map(f64::from));
        }
        Ok(())
    }

    fn snapshot(&mut self) -> Result<Arc<TrainedField>, FieldError> {
        if let Some(field) = &self.snapshot {
            return Ok(field.clone());
        }
        self.download()?;
        let field = Arc::new(TrainedField::new(&self.round, self.parameters.clone(), self.losses.clone()));
        Ok(self.snapshot.insert(field).clone())
    }

    /// Points of a query block.
    fn block(&self) -> usize {
        self.sizes.central_lanes() as usize
    }

    /// Runs a query on at most a block of points; the results are in the buffers.
    fn query(
        &self,
        field: &TrainedField,
        points: &[[f32; 3]],
        programs: &[&Vec<Dispatch>],
    ) -> Result<(), FieldError> {
        let block = self.block();
        let mut places = vec![0.5f32; 3 * block];
        for (lane, p) in points.iter().enumerate() {
            for (axis, v) in field.place(*p).into_iter().enumerate() {
                places[axis * block + lane] = v;
            }
        }
        self.gpu.write(&self.buffers.places, bytemuck::cast_slice(&places));
        self.gpu.submit(programs.iter().flat_map(|p| p.iter()));
        self.gpu.check()
    }
}

impl Engine for GpuRound {
    fn device(&self) -> String {
        self.gpu.name().to_owned()
    }

    fn train(&mut self, steps: usize, control: &Control<'_>) -> Result<(), FieldError> {
        self.snapshot = None;
        let end = self.losses.len() + steps;
        while self.losses.len() < end {
            self.batch((end - self.losses.len()).min(BATCH), control)?;
        }
        Ok(())
    }

    fn losses(&self) -> &[StepLosses] {
        &self.losses
    }

    fn poses(&mut self) -> Result<Vec<Isometry3<f64>>, FieldError> {
        self.snapshot()?;
        Ok(self.round.corrections.poses())
    }

    fn sdf(&mut self, points: &[[f32; 3]], sdf: &mut [f32]) -> Result<(), FieldError> {
        let field = self.snapshot()?;
        let block = self.block();
        for (points, sdf) in points.chunks(block).zip(sdf.chunks_mut(block)) {
            self.query(&field, points, &[&self.programs.query])?;
            let values = self.gpu.read(&self.buffers.sdf, points.len())?;
            for ((out, value), p) in sdf.iter_mut().zip(values).zip(points) {
                *out = field.distance(*p, value);
            }
        }
        Ok(())
    }

    fn sdf_and_gradient(
        &mut self,
        points: &[[f32; 3]],
        sdf: &mut [f32],
        gradient: &mut [[f32; 3]],
    ) -> Result<(), FieldError> {
        let field = self.snapshot()?;
        let block = self.block();
        let outputs = sdf.chunks_mut(block).zip(gradient.chunks_mut(block));
        for (points, (sdf, gradient)) in points.chunks(block).zip(outputs) {
            self.query(&field, points, &[&self.programs.query_slopes])?;
            let values = self.gpu.read(&self.buffers.sdf, points.len())?;
            let slopes = self.gpu.read(&self.buffers.gamma, 4 * points.len())?;
            for (i, (p, [x, y, z, _])) in points.iter().zip(slopes.as_chunks::<4>().0).enumerate() {
                if let (Some(s), Some(g)) = (sdf.get_mut(i), gradient.get_mut(i)) {
                    *s = field.distance(*p, values[i]);
                    *g = field.slope([*x, *y, *z]).map(|v| field.known(*p, v));
                }
            }
        }
        Ok(())
    }

    fn color(
        &mut self,
        points: &[[f32; 3]],
        view_dirs: &[[f32; 3]],
        out: &mut [[f32; 3]],
    ) -> Result<(), FieldError> {
        let field = self.snapshot()?;
        let block = self.block();
        let inputs = points.chunks(block).zip(view_dirs.chunks(block));
        for ((points, dirs), out) in inputs.zip(out.chunks_mut(block)) {
            let dirs: Vec<f32> = dirs
                .iter()
                .flat_map(|d| {
                    let [x, y, z] = field.view(*d);
                    [x, y, z, 0.0]
                })
                .collect();
            self.gpu.write(&self.buffers.directions, bytemuck::cast_slice(&dirs));
            self.query(&field, points, &[&self.programs.query, &self.programs.query_color])?;
            let rgb = self.gpu.read(&self.buffers.rgb, 3 * block)?;
            for (i, (out, p)) in out.iter_mut().zip(points).enumerate() {
                let rgb = [0, 1, 2].map(|c| 1.0 / (1.0 + (-rgb[c * block + i]).exp()));
                *out = field.color_at(*p, rgb);
            }
        }
        Ok(())
    }

    fn field(&mut self) -> Result<Arc<TrainedField>, FieldError> {
        self.snapshot()
    }
}
