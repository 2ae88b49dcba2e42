//! What a round starts from, and the trait of the engines that run it.

use crate::config::FieldConfig;
use crate::error::FieldError;
use crate::field::TrainedField;
use crate::frame::FieldImages;
use crate::pose::PoseCorrections;
use crate::rays::FrameRays;
use crate::sampler::Sampler;
use crate::train::{Control, StepLosses};
use crate::volume::Volume;
use nalgebra::Isometry3;
use rayon::prelude::*;
use std::sync::Arc;

/// A round of training on some device. Every engine runs the step of `docs/field.md` with the same random numbers:
/// from the same frames and seed, results differ by the rounding of sums only.
pub trait Engine {
    /// The device that does the work, for people.
    fn device(&self) -> String;

    /// Runs further steps. Learning rates fall over the configured number of steps and stay low after that.
    ///
    /// # Errors
    /// A stop asked for by the caller, divergence, or a device that fails.
    fn train(&mut self, steps: usize, control: &Control<'_>) -> Result<(), FieldError>;

    /// Losses of every step so far.
    fn losses(&self) -> &[StepLosses];

    /// Refined `obj_from_cam` per frame, metres; the first as it was given.
    ///
    /// # Errors
    /// A device that fails.
    fn poses(&mut self) -> Result<Vec<Isometry3<f64>>, FieldError>;

    /// Signed distances as [`TrainedField::sdf`].
    ///
    /// # Errors
    /// A device that fails.
    fn sdf(&mut self, points: &[[f32; 3]], sdf: &mut [f32]) -> Result<(), FieldError>;

    /// Signed distances and gradients as [`TrainedField::sdf_and_gradient`].
    ///
    /// # Errors
    /// A device that fails.
    fn sdf_and_gradient(
        &mut self,
        points: &[[f32; 3]],
        sdf: &mut [f32],
        gradient: &mut [[f32; 3]],
    ) -> Result<(), FieldError>;

    /// Colours as [`TrainedField::color`].
    ///
    /// # Errors
    /// A device that fails.
    fn color(
        &mut self,
        points: &[[f32; 3]],
        view_dirs: &[[f32; 3]],
        out: &mut [[f32; 3]],
    ) -> Result<(), FieldError>;

    /// The field as it is now, in main memory, free of the engine.
    ///
    /// # Errors
    /// A device that fails.
    fn field(&mut self) -> Result<Arc<TrainedField>, FieldError>;
}

/// Frames with their candidate rays, and the poses to be corrected.
#[derive(Debug)]
pub(crate) struct Round {
    pub(crate) config: FieldConfig,
    pub(crate) frames: Vec<Arc<FieldImages>>,
    pub(crate) sampler: Sampler,
    pub(crate) corrections: PoseCorrections,
}

impl Round {
    pub(crate) fn new(
        config: &FieldConfig,
        frames: &[Arc<FieldImages>],
        poses: &[Isometry3<f64>],
    ) -> Result<Self, FieldError> {
        check(config, frames, poses)?;
        let volume = Volume::build(frames, poses, config).ok_or(FieldError::NoSurface)?;
        let rays: Vec<FrameRays> =
            frames.par_iter().zip(poses).map(|(f, p)| FrameRays::collect(f, p, &volume, config)).collect();
        let corrections = PoseCorrections::new(
            poses,
            volume.center,
            volume.edge,
            config.max_translation,
            config.max_rotation_deg.to_radians(),
        );
        let sampler = Sampler::new(config, volume, rays).ok_or(FieldError::NoSurface)?;
        Ok(Self { config: config.clone(), frames: frames.to_vec(), sampler, corrections })
    }

    /// Learning rates of grid and networks, and of the poses.
    pub(crate) fn rates(&self, step: usize) -> (f64, f64) {
        let c = &self.config;
        let decay = c.decay.powf((step as f64 / c.steps as f64).min(1.0));
        (c.learning_rate * decay, c.pose_learning_rate * decay * pose_ramp(c, step))
    }
}

/// 0 until `pose_start`, then up to 1 over as many steps: a field that is still noise has no say in the poses. 0 again
/// from `pose_end` on.
fn pose_ramp(config: &FieldConfig, step: usize) -> f64 {
    if step as f64 >= config.pose_end * config.steps as f64 {
        return 0.0;
    }
    let start = config.pose_start * config.steps as f64;
    if start < 1.0 { 1.0 } else { (step as f64 / start - 1.0).clamp(0.0, 1.0) }
}

fn check(
    config: &FieldConfig,
    frames: &[Arc<FieldImages>],
    poses: &[Isometry3<f64>],
) -> Result<(), FieldError> {
    config.validate()?;
    if frames.is_empty() {
        return Err(FieldError::NoFrames);
    }
    if frames.len() != poses.len() {
        return Err(FieldError::PoseCount { frames: frames.len(), poses: poses.len() });
    }
    for (frame, pose) in frames.iter().zip(poses) {
        frame.validate()?;
        let finite = pose.translation.vector.iter().chain(pose.rotation.coords.iter()).all(|v| v.is_finite());
        if !finite {
            return Err(FieldError::Pose { id: frame.id });
        }
    }
    Ok(())
}
