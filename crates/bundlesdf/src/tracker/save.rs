//! A tracker between two frames as bytes, and back.

use std::{
    collections::BTreeMap,
    sync::{Arc, atomic::AtomicBool},
};

use mask_tracker::{SurfacePoint, VideoSegmenter};
use nalgebra::Isometry3;
use neural_field::TrainedField;
use rgbd_io::FrameSource;

use super::{FieldSummary, Motion, Reference, Tracker, rounds::field_config};
use crate::{
    checkpoint::{
        CheckpointError, PackedMask, PoseBits, SavedKeyframe, SavedObservation, SavedRound, SavedSummary,
        TrackerState, bits, fingerprint, open, pose, seal,
    },
    config::{Config, Schedule},
    field_worker::{FieldWorker, Place, RoundError, RoundHook, train_field},
    observation::Observation,
    pool::{Keyframe, MemoryPool},
};

/// Where things came from that are too large to save and can be made again.
#[derive(Debug, Default)]
pub(super) struct Provenance {
    /// How each frame was observed that something still depends on.
    observed: BTreeMap<usize, SavedObservation>,
    /// Index of the last frame that came with its own mask, while masks are given.
    pub(super) given: Option<usize>,
    /// The round that the newest field came from.
    pub(super) round: Option<SavedRound>,
    /// The round that was asked for last.
    pub(super) asked: Option<SavedRound>,
}

impl Tracker {
    /// Remembers how the newest reference was observed, and forgets what nothing depends on any more.
    pub(super) fn note_observation(&mut self, observation: &Observation) {
        let Some(mask) = &self.mask else { return };
        let (pool, provenance) = (&self.pool, &mut self.provenance);
        let asked = [&provenance.round, &provenance.asked];
        let needed = |index: usize| {
            let in_round = |r: &SavedRound| r.frames.iter().any(|(i, _)| *i == index);
            pool.get(index).is_some() || asked.iter().any(|r| r.as_ref().is_some_and(in_round))
        };
        provenance.observed.retain(|index, _| needed(*index));
        let index = observation.index;
        let saved = SavedObservation { index, mask: PackedMask::new(mask), valid: observation.valid };
        provenance.observed.insert(index, saved);
    }

    /// Remembers what the round that starts now is asked.
    pub(super) fn note_round(&mut self, steps: usize) {
        let frames = self.pool.keyframes().iter().map(|k| (k.index, bits(&k.obj_from_cam))).collect();
        self.provenance.asked = Some(SavedRound { steps, frames });
    }

    /// A tracker whose field rounds suffer what `hook` does at their start, given their number from 0: an error
    /// stands for a lost device, a panic for a bug. For tests of what goes on without the field.
    ///
    /// # Errors
    /// When a value of the config is outside its range.
    #[doc(hidden)]
    pub fn with_round_hook(
        config: Config,
        schedule: Schedule,
        hook: impl Fn(usize) -> Result<(), String> + Send + Sync + 'static,
    ) -> Result<Self, crate::config::ConfigError> {
        let mut tracker = Self::new(config, schedule)?;
        let hook: RoundHook = Arc::new(hook);
        let device = tracker.config.field.device;
        tracker.worker = tracker.worker.map(|_| FieldWorker::new(device, Some(hook)));
        Ok(tracker)
    }

    /// Everything that [`Tracker::restore`] needs to go on after the frame tracked last; `None` when the
    /// segmentation can't tell what it remembers.
    pub fn save(&mut self) -> Option<Vec<u8>> {
        let segmenter = self.segmenter.save()?;
        // Every field is named: one that is added has to be saved, or made again, too.
        let Self {
            config,
            schedule,
            pool,
            descriptors: _,
            segmenter: _,
            given: _,
            surface,
            mask: _,
            reference,
            motion,
            worker,
            field: _,
            summary,
            new_keyframes,
            next_index,
            first_valid,
            adrift,
            provenance,
        } = self;
        let keyframe = |k: &Keyframe| SavedKeyframe {
            index: k.index,
            id: k.id.clone(),
            obj_from_cam: bits(&k.obj_from_cam),
            refined_by_field: k.refined_by_field,
        };
        let point = |p: &SurfacePoint| {
            let ([x, y, z], [a, b, c]) = (p.position, p.normal);
            [x, y, z, a, b, c]
        };
        // A round under way beside the tracker is lost with the process: its keyframes count as new again.
        let under_way = worker.as_ref().is_some_and(FieldWorker::is_busy);
        let state = TrackerState {
            keyframes: pool.keyframes().iter().map(keyframe).collect(),
            edges: pool.all_edges(),
            observed: provenance.observed.values().cloned().collect(),
            reference: reference.as_ref().map(|r| (r.index, bits(&r.pose))),
            motion: motion.history.map(|h| h.map(|(index, pose)| (index, bits(&pose)))),
            segmenter,
            given: provenance.given,
            surface: surface.iter().map(point).collect(),
            round: provenance.round.clone(),
            summary: SavedSummary {
                rounds: summary.rounds,
                steps: summary.steps,
                ms_per_round_median: summary.ms_per_round_median,
                failures: summary.failures.clone(),
                history: summary.history.clone(),
                device: summary.device.clone(),
                warnings: summary.warnings.clone(),
                times: summary.times.clone(),
            },
            new_keyframes: if under_way { pool.keyframes().len() } else { *new_keyframes },
            next_index: *next_index,
            first_valid: *first_valid,
            adrift: *adrift,
        };
        seal(&state, fingerprint(config, *schedule))
    }

    /// A tracker that goes on where [`Tracker::save`] was called: in lockstep all that follows is the same bit for
    /// bit. `source` is the video the tracker was fed with, from its first frame; it is read again for the keyframes,
    /// and the newest field is trained again. `segmenter` is one like the tracker began with (by default
    /// [`Propagate`](mask_tracker::Propagate)), which has seen nothing yet.
    ///
    /// # Errors
    /// When the bytes are damaged or belong to another run, or the video isn't what it was.
    pub fn restore(
        config: Config,
        schedule: Schedule,
        saved: &[u8],
        source: &dyn FrameSource,
        segmenter: Box<dyn VideoSegmenter>,
    ) -> Result<Self, CheckpointError> {
        let state: TrackerState = open(saved, fingerprint(&config, schedule))?;
        let mut tracker = Self::new(config, schedule).map_err(|_| CheckpointError::OtherRun)?;
        tracker.segmenter = segmenter;
        if !tracker.segmenter.restore(&state.segmenter) {
            return Err(CheckpointError::Damaged);
        }
        let observations = observe_again(&state, source, &tracker.config)?;
        let seen = |index: usize| observations.get(&index).cloned().ok_or(CheckpointError::Damaged);
        tracker.given = match state.given {
            None => None,
            Some(index) => {
                let mut frame = source.frame(index).map_err(CheckpointError::Frame)?;
                let mask = frame.mask.take().ok_or(CheckpointError::Changed { id: frame.id.clone() })?;
                Some((frame, mask))
            }
        };
        tracker.reference = match state.reference {
            None => None,
            Some((index, at)) => Some(Reference { index, observation: seen(index)?, pose: pose(at) }),
        };
        let keyframe = |k: SavedKeyframe| {
            Ok(Keyframe {
                index: k.index,
                observation: seen(k.index)?,
                id: k.id,
                obj_from_cam: pose(k.obj_from_cam),
                refined_by_field: k.refined_by_field,
            })
        };
        let keyframes: Result<Vec<_>, CheckpointError> = state.keyframes.into_iter().map(keyframe).collect();
        tracker.pool = MemoryPool::from_parts(keyframes?, state.edges);
        tracker.motion = Motion { history: state.motion.map(|h| h.map(|(index, at)| (index, pose(at)))) };
        tracker.field = match &state.round {
            None => None,
            Some(asked) => Some(train_again(asked, seen, &tracker.config)?),
        };
        tracker.surface = state
            .surface
            .iter()
            .map(|[x, y, z, a, b, c]| SurfacePoint { position: [*x, *y, *z], normal: [*a, *b, *c] })
            .collect();
        let SavedSummary { rounds, steps, ms_per_round_median, failures, history, device, warnings, times } =
            state.summary;
        tracker.summary =
            FieldSummary { rounds, ms_per_round_median, steps, failures, history, device, warnings, times };
        tracker.new_keyframes = state.new_keyframes;
        tracker.next_index = state.next_index;
        tracker.first_valid = state.first_valid;
        tracker.adrift = state.adrift;
        tracker.provenance = Provenance {
            observed: state.observed.into_iter().map(|o| (o.index, o)).collect(),
            given: state.given,
            round: state.round,
            asked: None,
        };
        Ok(tracker)
    }

    pub(crate) fn settings(&self) -> (&Config, Schedule) {
        (&self.config, self.schedule)
    }

    /// Number of frames taken so far.
    pub fn frames(&self) -> usize {
        self.next_index
    }
}

impl std::fmt::Debug for Tracker {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Tracker")
            .field("frames", &self.next_index)
            .field("keyframes", &self.pool.keyframes().len())
            .finish_non_exhaustive()
    }
}

/// The observations of the frames that something depends on, from the video and the masks of that time.
fn observe_again(
    state: &TrackerState,
    source: &dyn FrameSource,
    config: &Config,
) -> Result<BTreeMap<usize, Arc<Observation>>, CheckpointError> {
    let mut observations = BTreeMap::new();
    for saved in &state.observed {
        let frame = source.frame(saved.index).map_err(CheckpointError::Frame)?;
        let mask = saved.mask.unpack().ok_or(CheckpointError::Damaged)?;
        let observation = Observation::new(saved.index, &frame, &mask, config).ok();
        let Some(observation) = observation.filter(|o| o.valid == saved.valid) else {
            return Err(CheckpointError::Changed { id: frame.id });
        };
        observations.insert(saved.index, Arc::new(observation));
    }
    Ok(observations)
}

fn train_again(
    asked: &SavedRound,
    seen: impl Fn(usize) -> Result<Arc<Observation>, CheckpointError>,
    config: &Config,
) -> Result<Arc<TrainedField>, CheckpointError> {
    let frame = |(index, at): &(usize, PoseBits)| -> Result<(usize, Arc<Observation>, Isometry3<f64>), _> {
        Ok::<_, CheckpointError>((*index, seen(*index)?, pose(*at)))
    };
    let frames: Result<Vec<_>, _> = asked.frames.iter().map(frame).collect();
    let mut place = Place::new(config.field.device);
    match train_field(&mut place, &field_config(config, asked.steps), &frames?, &AtomicBool::new(false)) {
        Ok((field, _, _)) => Ok(field),
        Err(RoundError::Failed(reason)) => Err(CheckpointError::Field(reason)),
        Err(RoundError::Stopped) => Err(CheckpointError::Field("stopped".into())),
    }
}
