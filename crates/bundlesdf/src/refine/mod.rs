//! Refinement of a run that has ended: one long training of the field over all keyframes, then every frame's pose
//! against the refined keyframes and the field.
//!
//! While the video runs a frame's pose can only be as good as what was known by then. Afterwards the keyframes have
//! seen everything, and an early frame profits from a late loop.

mod frames;
mod keyframes;

use std::{
    sync::{Arc, atomic::AtomicBool},
    time::{Duration, Instant},
};

use marching_cubes::TriMesh;
use nalgebra::Isometry3;
use neural_field::{Control, FieldConfig, FieldError, FieldImages, StepLosses, TrainedField};

use rgbd_io::FrameSource;

use crate::{config::Config, observation::Observation, output::OutputFolder, surface::field_surface};

/// What a refinement does.
#[derive(Clone, Debug)]
pub struct RefineOptions {
    /// Training of the field.
    pub field: FieldConfig,
    /// Bridge the holes of the mesh where the object was never seen.
    pub close: bool,
    /// Marching-cubes spacing (metres).
    pub spacing: f32,
}

impl RefineOptions {
    /// What the config of a run asks for; the mesh is a little finer than the run's.
    pub fn of(config: &Config) -> Self {
        /// Edge of a marching-cubes cell over that of the run's mesh.
        const FINER: f32 = 0.8;
        let field = FieldConfig { steps: config.field.refine_steps, ..FieldConfig::refine() };
        Self { field, close: false, spacing: FINER * config.mesh.spacing }
    }
}

impl Default for RefineOptions {
    fn default() -> Self {
        Self::of(&Config::default())
    }
}

/// How far a refinement has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Progress {
    /// Keyframes read again from the video, of all.
    Reading(usize, usize),
    /// Training steps done, of all: first those that move keyframes, then those on where they ended up.
    Training(usize, usize),
    /// Frames placed, of all.
    Frames(usize, usize),
}

/// A keyframe after refinement.
#[derive(Clone, Debug)]
pub struct RefinedKeyframe {
    /// Number of the frame in the video.
    pub index: usize,
    /// Name of the frame.
    pub id: String,
    /// Refined pose.
    pub obj_from_cam: Isometry3<f64>,
    /// Colour, depth and mask of the object's crop.
    pub images: Arc<FieldImages>,
    /// Median distance of its depth points to the field's surface (metres); far above the others' for a frame with a
    /// wrong pose or mask. NaN without usable depth.
    pub residual: f32,
}

/// A frame after refinement.
#[derive(Clone, Debug, PartialEq)]
pub struct RefinedFrame {
    /// Number of the frame in the video.
    pub index: usize,
    /// Name of the frame.
    pub id: String,
    /// Maps object coordinates to camera coordinates (metres).
    pub cam_from_obj: Isometry3<f64>,
    /// Whether the frame itself had a say in its pose; otherwise it is interpolated between its neighbours.
    pub measured: bool,
}

/// The refined object.
#[derive(Debug)]
pub struct Refined {
    /// Metric mesh in the object frame.
    pub mesh: TriMesh,
    /// The field it was taken from.
    pub field: Arc<TrainedField>,
    /// Keyframes, in the order of the video.
    pub keyframes: Vec<RefinedKeyframe>,
    /// All frames of the run, in the order of the video.
    pub frames: Vec<RefinedFrame>,
    /// Time of the training alone.
    pub training: Duration,
    /// Wall-clock time of everything.
    pub wall: Duration,
}

/// Why a run could not be refined.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RefineError {
    /// A file of the run or of its video is missing or can't be used.
    #[error(transparent)]
    File(#[from] rgbd_io::Error),
    /// No keyframe can be read again.
    #[error(
        "{0}: none of the run's keyframes shows the object; give the folder of a run that tracked something"
    )]
    NoKeyframes(String),
    /// The field could not be trained.
    #[error("the field can't be trained: {0}")]
    Field(#[from] FieldError),
    /// The stop flag was set.
    #[error("stopped before the end; nothing was written")]
    Stopped,
}

/// Refines the results in `folder` of a run on the video `source`; writes nothing (see [`OutputFolder::write_refined`]).
///
/// `progress` is called from several threads. Runs on the current rayon pool, on the CPU.
///
/// # Errors
/// When the run or its video can't be read again, when the field can't be trained, or when `stop` is set.
pub fn refine(
    folder: &OutputFolder,
    source: &dyn FrameSource,
    options: &RefineOptions,
    stop: &AtomicBool,
    progress: &(dyn Fn(Progress) + Sync),
) -> Result<Refined, RefineError> {
    let start = Instant::now();
    let report = folder.read_report()?;
    let run = Run { folder, config: &report.config, source };

    let mut keyframes = keyframes::read(&run, stop, progress)?;
    if keyframes.is_empty() {
        return Err(RefineError::NoKeyframes(folder.path().display().to_string()));
    }
    let edges = keyframes::matches(&keyframes, run.config);
    keyframes::align(&mut keyframes, &edges, run.config, None, stop);
    let begin = Instant::now();
    let field = train(&keyframes, &options.field, 0, stop, progress)?;
    let weight = keyframes::align(&mut keyframes, &edges, run.config, Some(&field), stop);
    // The field left the keyframes a little elsewhere: the surface is to be that of the poses that are given out.
    let still = FieldConfig { pose_learning_rate: 0.0, ..options.field.clone() };
    let field = train(&keyframes, &still, options.field.steps, stop, progress)?;
    let training = begin.elapsed();
    let frames = frames::place_all(&run, &report.frames, &keyframes, (&field, weight), stop, progress)?;

    let mesh = if options.close {
        field.extract_closed_mesh(options.spacing)
    } else {
        field_surface(&field, options.spacing)
    };
    let keyframes = keyframes
        .into_iter()
        .zip(field.frame_residuals())
        .map(|(k, residual)| RefinedKeyframe {
            index: k.observation.index,
            id: k.id,
            obj_from_cam: k.refined,
            images: k.observation.images.clone(),
            residual: *residual,
        })
        .collect();
    Ok(Refined { mesh, field, keyframes, frames, training, wall: start.elapsed() })
}

/// The run that is refined.
struct Run<'a> {
    folder: &'a OutputFolder,
    config: &'a crate::Config,
    source: &'a dyn FrameSource,
}

impl Run<'_> {
    /// What frame `index` showed under the mask that it was tracked with; `None` when it shows too little.
    fn observe(&self, index: usize, id: &str) -> Result<Option<Observation>, rgbd_io::Error> {
        let frame = self.source.frame(index)?;
        let mask = self.folder.read_mask(id)?;
        Ok(Observation::new(index, &frame, &mask, self.config).ok())
    }
}

/// One of the two rounds, `before` steps into them.
fn train(
    keyframes: &[keyframes::Keyframe],
    config: &FieldConfig,
    before: usize,
    stop: &AtomicBool,
    progress: &(dyn Fn(Progress) + Sync),
) -> Result<Arc<TrainedField>, RefineError> {
    let images: Vec<_> = keyframes.iter().map(|k| k.observation.images.clone()).collect();
    let poses: Vec<_> = keyframes.iter().map(|k| k.refined).collect();
    let each =
        |step: usize, _: &StepLosses| progress(Progress::Training(before + step + 1, 2 * config.steps));
    let control = Control { stop: Some(stop), progress: Some(&each) };
    match neural_field::train(config, &images, &poses, &control) {
        Ok(field) => Ok(Arc::new(field)),
        Err(FieldError::Stopped) => Err(RefineError::Stopped),
        Err(error) => Err(error.into()),
    }
}
