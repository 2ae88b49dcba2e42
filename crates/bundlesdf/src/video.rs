//! Runs the tracker over a whole sequence.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use rgbd_io::{FrameSource, ReadAhead};

use crate::{
    config::{Config, ConfigError, Schedule},
    tracker::{FrameResult, Reconstruction, Tracker},
};

/// Decoded frames that wait for the tracker.
const READ_AHEAD: usize = 3;

/// Everything a run produced.
#[derive(Debug)]
pub struct VideoRun {
    /// One result per frame of the source, in order (fewer after an interruption).
    pub frames: Vec<FrameResult>,
    /// Mesh, keyframes and what the field did.
    pub reconstruction: Reconstruction,
    /// Frames that could not be read; the tracker saw an empty frame in their place.
    pub unreadable: Vec<rgbd_io::Error>,
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

    /// A frame could not be read and counts as lost.
    fn unreadable(&mut self, _error: &rgbd_io::Error) {}

    /// All frames are tracked; the final round and the mesh follow.
    fn finishing(&mut self) {}
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
    run_tracker(source, Tracker::new(config.clone(), schedule)?, stop, observer)
}

/// [`run_video`] with a tracker that was set up by the caller.
///
/// # Errors
/// When the first frame can't be read, or when the observer fails.
pub fn run_tracker(
    source: Arc<dyn FrameSource>,
    mut tracker: Tracker,
    stop: &AtomicBool,
    observer: &mut dyn Observer,
) -> Result<VideoRun, RunError> {
    let start = Instant::now();
    let mut frames = Vec::with_capacity(source.len());
    let mut unreadable = Vec::new();
    let mut interrupted = false;
    let count = source.len();
    for (index, read) in ReadAhead::new(source.clone(), 0..count, READ_AHEAD) {
        if stop.load(Ordering::Relaxed) {
            interrupted = true;
            break;
        }
        let result = match read {
            Ok(frame) => tracker.track(&frame),
            Err(error) if index == 0 => return Err(RunError::Input(error)),
            Err(error) => {
                observer.unreadable(&error);
                unreadable.push(error);
                tracker.skip(source.id(index))
            }
        };
        observer.frame(&result, &tracker).map_err(RunError::Output)?;
        frames.push(result);
    }
    observer.finishing();
    let reconstruction = if interrupted { tracker.stop() } else { tracker.finish() };
    Ok(VideoRun { frames, reconstruction, unreadable, interrupted, wall: start.elapsed() })
}
