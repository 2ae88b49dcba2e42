//! One round of training, from frames and poses to a field.

use crate::config::FieldConfig;
use crate::engine::CpuEngine;
use crate::error::FieldError;
use crate::field::TrainedField;
use crate::frame::FieldImages;
use crate::pose::PoseCorrections;
use crate::rays::FrameRays;
use crate::sampler::Sampler;
use crate::trust;
use crate::volume::Volume;
use nalgebra::Isometry3;
use rayon::prelude::*;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Weighted losses of one step, as they enter the sum.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepLosses {
    /// Uncertain free space.
    pub uncertain: f64,
    /// Empty space.
    pub empty: f64,
    /// Near-surface distance.
    pub surface: f64,
    /// Colour.
    pub color: f64,
    /// Eikonal regularisation.
    pub eikonal: f64,
}

impl StepLosses {
    /// The training loss.
    pub fn total(&self) -> f64 {
        self.uncertain + self.empty + self.surface + self.color + self.eikonal
    }
}

/// A callback that gets a step's number (from 0) and its losses.
pub type Progress<'a> = dyn Fn(usize, &StepLosses) + Sync + 'a;

/// How the caller follows and interrupts a round.
#[derive(Clone, Copy, Default)]
pub struct Control<'a> {
    /// Training ends with [`FieldError::Stopped`] soon after this becomes true.
    pub stop: Option<&'a AtomicBool>,
    /// Called after every step.
    pub progress: Option<&'a Progress<'a>>,
}

/// Trains a field on posed frames and refines their poses: one round, starting from fresh networks.
///
/// `poses` are `obj_from_cam` (metres, OpenCV camera), one per frame. The first frame is the anchor: its pose comes
/// back bit for bit, and with it the object frame. Runs on the current rayon pool; the result depends on inputs and
/// seed only, not on the number of threads.
///
/// # Errors
/// Unusable input ([`FieldError`] says what to change), a stop asked for by the caller, or divergence.
pub fn train(
    config: &FieldConfig,
    frames: &[Arc<FieldImages>],
    poses: &[Isometry3<f64>],
    control: &Control<'_>,
) -> Result<TrainedField, FieldError> {
    check(config, frames, poses)?;
    let volume = Volume::build(frames, poses, config).ok_or(FieldError::NoSurface)?;
    let rays: Vec<FrameRays> =
        frames.par_iter().zip(poses).map(|(f, p)| FrameRays::collect(f, p, &volume, config)).collect();
    let mut corrections = PoseCorrections::new(
        poses,
        volume.center,
        volume.edge,
        config.max_translation,
        config.max_rotation_deg.to_radians(),
    );
    let mut sampler = Sampler::new(config, volume, rays).ok_or(FieldError::NoSurface)?;
    let mut engine = CpuEngine::new(config, &sampler);
    let mut losses = Vec::new();
    for step in 0..config.steps {
        if control.stop.is_some_and(|s| s.load(Ordering::Relaxed)) {
            return Err(FieldError::Stopped);
        }
        if trust::is_due(config, step) {
            sampler
                .set_trust(&trust::weights(&engine.residuals(&sampler, &corrections), config.outlier_ratio));
        }
        let decay = config.decay.powf(step as f64 / config.steps as f64);
        let rates =
            (config.learning_rate * decay, config.pose_learning_rate * decay * pose_ramp(config, step));
        let [uncertain, empty, surface, color, eikonal] =
            engine.step(&sampler, &mut corrections, step, rates);
        let step_losses = StepLosses { uncertain, empty, surface, color, eikonal };
        if !step_losses.total().is_finite() {
            return Err(FieldError::Diverged { step });
        }
        losses.push(step_losses);
        if let Some(progress) = control.progress {
            progress(step, &step_losses);
        }
    }
    Ok(TrainedField::new(config, engine, &sampler, &corrections, frames, losses))
}

/// 0 until `pose_start`, then up to 1 over as many steps: a field that is still noise has no say in the poses.
fn pose_ramp(config: &FieldConfig, step: usize) -> f64 {
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
