//! Runs the tracker over a whole sequence.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use mask_tracker::VideoSegmenter;
use rgbd_io::{FrameSource, ReadAhead};

use crate::{
    checkpoint::{CheckpointError, fingerprint, open, seal},
    config::{Config, ConfigError, Schedule},
    diagnostics::{Diagnostics, Warning},
    tracker::{FrameResult, Reconstruction, Tracker},
};

/// Decoded frames that wait for the tracker.
const READ_AHEAD: usize = 3;
/// Most frames between two checkpoints: what has to be tracked again after a kill.
const CHECKPOINT_EVERY: usize = 30;

/// Everything a run produced.
#[derive(Debug)]
pub struct VideoRun {
    /// One result per frame of the source, in order (fewer after an interruption).
    pub frames: Vec<FrameResult>,
    /// Mesh, keyframes and what the field did.
    pub reconstruction: Reconstruction,
    /// Frames that could not be read; the tracker saw an empty frame in their place.
    pub unreadable: Vec<rgbd_io::Error>,
    /// What is likely wrong with the input.
    pub warnings: Vec<Warning>,
    /// Whether the stop flag ended the run early.
    pub interrupted: bool,
    /// Wall-clock time.
    pub wall: Duration,
}

/// Why a run could not be done.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RunError {
    /// A value of the config is out of range.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The input can't be used.
    #[error(transparent)]
    Input(rgbd_io::Error),
    /// A result can't be written.
    #[error(transparent)]
    Output(rgbd_io::Error),
}

/// What a run tells while it goes on.
pub trait Observer {
    /// A frame was tracked; `tracker` shows the mask it used, the memory pool and the newest field.
    ///
    /// # Errors
    /// An error (say, of a disk that is full) ends the run.
    fn frame(&mut self, result: &FrameResult, tracker: &Tracker) -> Result<(), rgbd_io::Error>;

    /// A frame could not be read and counts as lost; [`Observer::frame`] follows.
    fn unreadable(&mut self, _error: &rgbd_io::Error) {}

    /// Something is likely wrong with the input; told once per kind.
    fn warning(&mut self, _warning: &Warning) {}

    /// Whether [`Observer::checkpoint`] is to be called.
    fn keeps_checkpoints(&self) -> bool {
        false
    }

    /// The run can go on from these bytes: [`RunSoFar::restore`].
    ///
    /// # Errors
    /// An error ends the run.
    fn checkpoint(&mut self, _saved: &[u8]) -> Result<(), rgbd_io::Error> {
        Ok(())
    }

    /// All frames are tracked; the final round and the mesh follow.
    fn finishing(&mut self) {}
}

/// A run between two frames.
#[derive(Debug)]
pub struct RunSoFar {
    /// The tracker, which has taken as many frames as there are results.
    pub tracker: Tracker,
    /// The results so far.
    pub frames: Vec<FrameResult>,
    /// Frames that could not be read.
    pub unreadable: Vec<rgbd_io::Error>,
    diagnostics: Diagnostics,
    wall: Duration,
}

impl RunSoFar {
    /// A run that begins with this tracker, which has seen nothing yet.
    #[must_use]
    pub fn new(tracker: Tracker) -> Self {
        Self {
            tracker,
            frames: Vec::new(),
            unreadable: Vec::new(),
            diagnostics: Diagnostics::default(),
            wall: Duration::ZERO,
        }
    }

    /// The bytes for [`Observer::checkpoint`].
    fn save(&mut self, wall: Duration) -> Option<Vec<u8>> {
        let tracker = self.tracker.save()?;
        let (config, schedule) = self.tracker.settings();
        seal(&(tracker, &self.diagnostics, wall), fingerprint(config, schedule))
    }

    /// A run that goes on from what [`Observer::checkpoint`] got, without the results so far: their number is
    /// [`Tracker::frames`]. `segmenter` is one like the run began with, which has seen nothing yet.
    ///
    /// # Errors
    /// When the bytes are damaged or belong to another run, or the video isn't what it was.
    pub fn restore(
        config: &Config,
        schedule: Schedule,
        saved: &[u8],
        source: &dyn FrameSource,
        segmenter: Box<dyn VideoSegmenter>,
    ) -> Result<Self, CheckpointError> {
        let (tracker, diagnostics, wall): (Vec<u8>, Diagnostics, Duration) =
            open(saved, fingerprint(config, schedule))?;
        let tracker = Tracker::restore(config.clone(), schedule, &tracker, source, segmenter)?;
        Ok(Self { tracker, frames: Vec::new(), unreadable: Vec::new(), diagnostics, wall })
    }
}

/// Tracks every frame of `source` in order and reconstructs the object.
///
/// A frame that can't be read in the middle of the video counts as lost and the run goes on; `stop` ends it after the
/// frame under way, with what there is by then.
///
/// # Errors
/// On an invalid config, when the first frame can't be read, or when the observer fails.
pub fn run_video(
    source: Arc<dyn FrameSource>,
    config: &Config,
    schedule: Schedule,
    stop: &AtomicBool,
    observer: &mut dyn Observer,
) -> Result<VideoRun, RunError> {
    continue_video(source, RunSoFar::new(Tracker::new(config.clone(), schedule)?), stop, observer)
}

/// The same from the frame after those that `run` has taken. In lockstep the result is that of a run without a stop,
/// bit for bit.
///
/// # Errors
/// When the first frame of all can't be read, or when the observer fails.
pub fn continue_video(
    source: Arc<dyn FrameSource>,
    mut run: RunSoFar,
    stop: &AtomicBool,
    observer: &mut dyn Observer,
) -> Result<VideoRun, RunError> {
    let start = Instant::now();
    let before = run.wall;
    let mut interrupted = false;
    let mut unsaved = 0;
    for (index, read) in ReadAhead::new(source.clone(), run.frames.len()..source.len(), READ_AHEAD) {
        if stop.load(Ordering::Relaxed) {
            interrupted = true;
            break;
        }
        let rounds = run.tracker.field_summary().rounds;
        let result = step(&mut run, index, read, &*source, observer)?;
        observer.frame(&result, &run.tracker).map_err(RunError::Output)?;
        unsaved += 1;
        let learnt = result.keyframe || run.tracker.field_summary().rounds != rounds;
        run.frames.push(result);
        if learnt || unsaved >= CHECKPOINT_EVERY {
            keep(&mut run, before + start.elapsed(), observer)?;
            unsaved = 0;
        }
    }
    if unsaved > 0 {
        keep(&mut run, before + start.elapsed(), observer)?;
    }
    observer.finishing();
    let RunSoFar { tracker, frames, unreadable, diagnostics, .. } = run;
    let reconstruction = if interrupted { tracker.stop() } else { tracker.finish_unless(stop) };
    // A stop in the last round leaves the mesh of the round before.
    interrupted |= stop.load(Ordering::Relaxed);
    let warnings = diagnostics.into_warnings();
    Ok(VideoRun { frames, reconstruction, unreadable, warnings, interrupted, wall: before + start.elapsed() })
}

/// Tracks one frame, or counts it as lost.
fn step(
    run: &mut RunSoFar,
    index: usize,
    read: Result<rgbd_io::RgbdFrame, rgbd_io::Error>,
    source: &dyn FrameSource,
    observer: &mut dyn Observer,
) -> Result<FrameResult, RunError> {
    let frame = match read {
        Ok(frame) => frame,
        Err(error) if index == 0 => return Err(RunError::Input(error)),
        Err(error) => {
            observer.unreadable(&error);
            run.unreadable.push(error);
            return Ok(run.tracker.skip(source.id(index)));
        }
    };
    let result = run.tracker.track(&frame);
    for warning in run.diagnostics.look(&frame, &result, &run.tracker) {
        tracing::warn!(frame = result.id, "{warning}");
        observer.warning(&warning);
    }
    Ok(result)
}

fn keep(run: &mut RunSoFar, wall: Duration, observer: &mut dyn Observer) -> Result<(), RunError> {
    if observer.keeps_checkpoints()
        && let Some(saved) = run.save(wall)
    {
        observer.checkpoint(&saved).map_err(RunError::Output)?;
    }
    Ok(())
}
