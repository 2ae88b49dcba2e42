//! One round of training, from frames and poses to a field.

use crate::config::FieldConfig;
use crate::cpu::CpuRound;
use crate::error::FieldError;
use crate::field::TrainedField;
use crate::frame::FieldImages;
use crate::round::Engine;
use crate::tile::loss;
use nalgebra::Isometry3;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

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

impl From<[f64; loss::COUNT]> for StepLosses {
    fn from([uncertain, empty, surface, color, eikonal]: [f64; loss::COUNT]) -> Self {
        Self { uncertain, empty, surface, color, eikonal }
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
    let mut round = CpuRound::new(config, frames, poses)?;
    round.train(config.steps, control)?;
    Ok(round.finish())
}
