//! The choice of where a round is trained, and the way back to the CPU when a GPU fails.

use crate::config::FieldConfig;
use crate::cpu::CpuRound;
use crate::error::FieldError;
use crate::field::TrainedField;
use crate::frame::FieldImages;
use crate::round::Engine;
use crate::train::Control;
use nalgebra::Isometry3;
use std::sync::Arc;

/// Where rounds are trained.
#[derive(Clone, Debug, Default)]
#[non_exhaustive]
pub enum Device {
    /// All cores of the current rayon pool.
    #[default]
    Cpu,
    /// An opened GPU.
    #[cfg(feature = "gpu")]
    Gpu(crate::Gpu),
}

impl Device {
    /// A GPU if this build can use one (feature `gpu`) and there is a real one, not a program that plays one; else
    /// the CPU.
    #[must_use]
    pub fn best() -> Self {
        #[cfg(feature = "gpu")]
        if let Some(gpu) = crate::Gpu::open().ok().filter(|gpu| !gpu.is_software()) {
            return Self::Gpu(gpu);
        }
        Self::Cpu
    }

    /// The best GPU, real or not.
    ///
    /// # Errors
    /// [`FieldError::Gpu`] without an adapter, or in a build without the feature `gpu`.
    pub fn gpu() -> Result<Self, FieldError> {
        #[cfg(feature = "gpu")]
        return crate::Gpu::open().map(Self::Gpu);
        #[cfg(not(feature = "gpu"))]
        Err(FieldError::Gpu("this build has no GPU engine; build it with --features gpu".into()))
    }

    /// Prepares a round as [`train`](crate::train) does.
    ///
    /// # Errors
    /// Unusable input, or a GPU that is too small or fails.
    pub fn round(
        &self,
        config: &FieldConfig,
        frames: &[Arc<FieldImages>],
        poses: &[Isometry3<f64>],
    ) -> Result<Box<dyn Engine>, FieldError> {
        match self {
            Self::Cpu => Ok(Box::new(CpuRound::new(config, frames, poses)?)),
            #[cfg(feature = "gpu")]
            Self::Gpu(gpu) => Ok(Box::new(crate::GpuRound::new(gpu, config, frames, poses)?)),
        }
    }

    /// Trains a round as [`train`](crate::train) does.
    ///
    /// A GPU that can't hold the round, fails or is lost costs the round's time so far, not the round: it is trained
    /// on the CPU, as are all later ones if the device is lost, and [`Trained::warning`] says why.
    ///
    /// # Errors
    /// Unusable input, a stop asked for by the caller, or divergence.
    pub fn train(
        &mut self,
        config: &FieldConfig,
        frames: &[Arc<FieldImages>],
        poses: &[Isometry3<f64>],
        control: &Control<'_>,
    ) -> Result<Trained, FieldError> {
        match self.train_here(config, frames, poses, control) {
            Err(FieldError::Gpu(reason)) => {
                if self.is_lost() {
                    *self = Self::Cpu;
                }
                let trained = Self::Cpu.train_here(config, frames, poses, control)?;
                Ok(Trained { warning: Some(format!("{reason}; trained on the CPU")), ..trained })
            }
            outcome => outcome,
        }
    }

    fn train_here(
        &self,
        config: &FieldConfig,
        frames: &[Arc<FieldImages>],
        poses: &[Isometry3<f64>],
        control: &Control<'_>,
    ) -> Result<Trained, FieldError> {
        let mut round = self.round(config, frames, poses)?;
        round.train(config.steps, control)?;
        Ok(Trained { field: round.field()?, device: round.device(), warning: None })
    }

    /// Whether nothing more can be expected of it.
    fn is_lost(&self) -> bool {
        match self {
            Self::Cpu => false,
            #[cfg(feature = "gpu")]
            Self::Gpu(gpu) => gpu.is_lost(),
        }
    }
}

/// A trained field and where it comes from.
#[derive(Clone, Debug)]
pub struct Trained {
    /// The field.
    pub field: Arc<TrainedField>,
    /// The device that trained it, for people.
    pub device: String,
    /// Why it was not the device asked for.
    pub warning: Option<String>,
}
