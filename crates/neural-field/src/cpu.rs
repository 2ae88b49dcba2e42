//! A round on the CPU, behind the trait that all engines share.

use crate::config::FieldConfig;
use crate::engine::CpuEngine;
use crate::error::FieldError;
use crate::field::TrainedField;
use crate::frame::FieldImages;
use crate::round::{Engine, Round};
use crate::train::{Control, StepLosses};
use crate::trust;
use nalgebra::Isometry3;
use std::sync::Arc;
use std::sync::atomic::Ordering;

/// A round on the CPU, on the current rayon pool.
#[derive(Debug)]
pub struct CpuRound {
    pub(crate) round: Round,
    pub(crate) engine: CpuEngine,
    losses: Vec<StepLosses>,
    /// The field after the last step, once somebody has asked for it.
    snapshot: Option<Arc<TrainedField>>,
}

impl CpuRound {
    /// Prepares a round as [`train`](crate::train) does.
    ///
    /// # Errors
    /// Unusable input; [`FieldError`] says what to change.
    pub fn new(
        config: &FieldConfig,
        frames: &[Arc<FieldImages>],
        poses: &[Isometry3<f64>],
    ) -> Result<Self, FieldError> {
        let round = Round::new(config, frames, poses)?;
        let engine = CpuEngine::new(config, &round.sampler);
        Ok(Self { round, engine, losses: Vec::new(), snapshot: None })
    }

    /// The field, without the copy that [`Engine::field`] needs.
    #[must_use]
    pub fn finish(self) -> TrainedField {
        TrainedField::new(&self.round, self.engine.into_parameters(), self.losses)
    }

    fn snapshot(&mut self) -> &Arc<TrainedField> {
        self.snapshot.get_or_insert_with(|| {
            Arc::new(TrainedField::new(&self.round, self.engine.parameters(), self.losses.clone()))
        })
    }
}

impl Engine for CpuRound {
    fn device(&self) -> String {
        "cpu".into()
    }

    fn train(&mut self, steps: usize, control: &Control<'_>) -> Result<(), FieldError> {
        self.snapshot = None;
        for step in self.losses.len()..self.losses.len() + steps {
            if control.stop.is_some_and(|s| s.load(Ordering::Relaxed)) {
                return Err(FieldError::Stopped);
            }
            if trust::is_due(&self.round.config, step) {
                let residuals = self.engine.residuals(&self.round.sampler, &self.round.corrections);
                let trust = trust::weights(&residuals, self.round.config.outlier_ratio);
                self.round.sampler.set_trust(&trust);
            }
            let rates = self.round.rates(step);
            let losses = self.engine.step(&self.round.sampler, &mut self.round.corrections, step, rates);
            let losses = StepLosses::from(losses);
            if !losses.total().is_finite() {
                return Err(FieldError::Diverged { step });
            }
            self.losses.push(losses);
            if let Some(progress) = control.progress {
                progress(step, &losses);
            }
        }
        Ok(())
    }

    fn losses(&self) -> &[StepLosses] {
        &self.losses
    }

    fn poses(&mut self) -> Result<Vec<Isometry3<f64>>, FieldError> {
        Ok(self.round.corrections.poses())
    }

    fn sdf(&mut self, points: &[[f32; 3]], sdf: &mut [f32]) -> Result<(), FieldError> {
        self.snapshot().sdf(points, sdf);
        Ok(())
    }

    fn sdf_and_gradient(
        &mut self,
        points: &[[f32; 3]],
        sdf: &mut [f32],
        gradient: &mut [[f32; 3]],
    ) -> Result<(), FieldError> {
        self.snapshot().sdf_and_gradient(points, sdf, gradient);
        Ok(())
    }

    fn color(
        &mut self,
        points: &[[f32; 3]],
        view_dirs: &[[f32; 3]],
        out: &mut [[f32; 3]],
    ) -> Result<(), FieldError> {
        self.snapshot().color(points, view_dirs, out);
        Ok(())
    }

    fn field(&mut self) -> Result<Arc<TrainedField>, FieldError> {
        Ok(self.snapshot().clone())
    }
}
