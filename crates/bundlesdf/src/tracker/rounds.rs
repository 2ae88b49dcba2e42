//! The tracker's side of the Neural Object Field: when rounds start, what their poses change, the final mesh.

use std::sync::atomic::AtomicBool;

use marching_cubes::TriMesh;
use neural_field::FieldConfig;
use serde::{Deserialize, Serialize};

use super::Tracker;
use crate::{
    config::{Config, Refiner},
    field_worker::{FieldReply, FieldRequest, FieldWorker, Round, RoundError},
    pool::{Keyframe, carry},
    report::RoundReport,
    surface::{field_surface, fused_surface},
};

/// Failures that are told; a device that is gone would fill the report with the same line.
const MOST_FAILURES: usize = 20;

/// What the field has done.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FieldSummary {
    /// Rounds finished.
    pub rounds: usize,
    /// Median time of an online round (milliseconds); of the last one, if it was the only one.
    pub ms_per_round_median: f64,
    /// Training steps of these rounds.
    pub steps: usize,
    /// The device that trained the last field.
    #[serde(default)]
    pub device: String,
    /// Why rounds were not trained on the device asked for, if any were not.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub warnings: Vec<String>,
    /// Why rounds failed, if any did.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub failures: Vec<String>,
    /// Every finished round, the last one over all keyframes included.
    #[serde(default)]
    pub history: Vec<RoundReport>,
    /// Time of each finished online round (milliseconds).
    #[serde(skip)]
    pub(super) times: Vec<f64>,
}

/// The final result.
#[derive(Debug)]
pub struct Reconstruction {
    /// Metric mesh in the object frame; `None` without a trained field.
    pub mesh: Option<TriMesh>,
    /// Keyframes with their final poses.
    pub keyframes: Vec<Keyframe>,
    /// What the field did.
    pub field: FieldSummary,
}

impl Tracker {
    pub(super) fn round_is_due(&self) -> bool {
        let settings = &self.config.field;
        let idle = self.worker.as_ref().is_some_and(|w| !w.is_busy());
        let first = self.summary.rounds == 0 && self.pool.keyframes().len() >= settings.first_round_keyframes;
        // Beside a running tracker every new keyframe is worth a round; in lockstep a round waits for a batch.
        let batch = match self.schedule {
            crate::Schedule::Lockstep => settings.keyframes_per_round,
            crate::Schedule::Realtime => 1,
        };
        let more = self.summary.rounds > 0 && self.new_keyframes >= batch;
        idle && self.new_keyframes > 0 && (first || more)
    }

    pub(super) fn start_round(&mut self) {
        self.submit(self.config.field.steps);
    }

    fn submit(&mut self, steps: usize) {
        let settings = &self.config.field;
        let round = match settings.refiner {
            Refiner::PoseGraph => Round::PoseGraph,
            Refiner::Field | Refiner::None => Round::Field(Box::new(field_config(&self.config, steps))),
        };
        let frames =
            self.pool.keyframes().iter().map(|k| (k.index, k.observation.clone(), k.obj_from_cam)).collect();
        self.new_keyframes = 0;
        self.note_round(steps);
        let (graph, edges) = (self.config.graph.clone(), self.pool.all_edges());
        if let Some(worker) = &mut self.worker
            && let Err(reason) = worker.submit(FieldRequest { round, graph, edges, frames })
        {
            self.apply(Err(reason));
        }
    }

    /// Takes the reply of the round under way, if there is one by now, and moves every pose that depends on it.
    pub(super) fn poll_field(&mut self) {
        if let Some(reply) = self.worker.as_mut().and_then(FieldWorker::poll) {
            self.apply(reply);
        }
    }

    /// The same after waiting for the reply; `stop` ends the round early, and without an update.
    pub(super) fn wait_for_field(&mut self, stop: &AtomicBool) {
        if let Some(reply) = self.worker.as_mut().and_then(|w| w.wait(stop)) {
            self.apply(reply);
        }
    }

    fn apply(&mut self, reply: FieldReply) {
        let update = match reply {
            Ok(update) => update,
            Err(RoundError::Stopped) => return,
            Err(RoundError::Failed(reason)) => {
                tracing::warn!(%reason, "a field round failed; tracking goes on without it");
                if self.summary.failures.len() < MOST_FAILURES {
                    self.summary.failures.push(reason);
                }
                return;
            }
        };
        if update.field.is_some() {
            self.provenance.round = self.provenance.asked.take();
        }
        let near = self.reference.as_ref().map_or(0, |r| r.index);
        if let Some((old, new)) = self.pool.apply_field_poses(&update.poses, near) {
            if let Some(reference) = &mut self.reference {
                reference.pose = carry(&old, &new, &reference.pose);
            }
            self.motion.carry(|pose| carry(&old, &new, pose));
        }
        self.summary.history.push(RoundReport::of(&update));
        self.field = update.field.or(self.field.take());
        self.surface = fused_surface(&self.pool);
        if let Some(warning) = update.warning.filter(|_| self.summary.warnings.len() < MOST_FAILURES) {
            tracing::warn!(%warning, "not on the device asked for");
            self.summary.warnings.push(warning);
        }
        if !update.device.is_empty() {
            self.summary.device = update.device;
        }
        self.summary.rounds += 1;
        self.summary.steps = update.steps;
        self.summary.times.push(update.elapsed.as_secs_f64() * 1e3);
        self.summary.ms_per_round_median = median(&self.summary.times);
    }

    /// Ends the tracking: a last round over all keyframes and the mesh of its field.
    pub fn finish(self) -> Reconstruction {
        self.finish_unless(&AtomicBool::new(false))
    }

    /// The same, but the last round ends early when `stop` becomes true; the mesh is then the newest field's.
    pub fn finish_unless(mut self, stop: &AtomicBool) -> Reconstruction {
        self.wait_for_field(stop);
        if self.config.field.refiner == Refiner::Field && !self.pool.keyframes().is_empty() {
            let online = self.summary.clone();
            self.submit(self.config.field.final_steps);
            self.wait_for_field(stop);
            // The last round has its own length: among online ones it would distort their median.
            if online.rounds > 0 {
                self.summary.ms_per_round_median = online.ms_per_round_median;
                self.summary.steps = online.steps;
            }
        }
        self.stop()
    }

    /// Ends the tracking at once: the mesh of the newest field, without a last round.
    pub fn stop(self) -> Reconstruction {
        let spacing = self.config.mesh.spacing;
        let mesh = self.field.as_ref().map(|field| field_surface(field, spacing));
        let keyframes = self.pool.keyframes().to_vec();
        Reconstruction { mesh, keyframes, field: self.summary }
    }
}

/// The settings of a training round of `steps`.
pub(super) fn field_config(config: &Config, steps: usize) -> FieldConfig {
    let settings = &config.field;
    let base = FieldConfig::realtime();
    FieldConfig {
        steps,
        seed: config.seed,
        max_translation: settings.max_translation,
        max_rotation_deg: settings.max_rotation_deg,
        ring_rays: if settings.hybrid { base.ring_rays } else { 0 },
        ..base
    }
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(0.0)
}
