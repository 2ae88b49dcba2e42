//! A look over a folder before a run: what is there, and what is likely to go wrong.

mod camera;
mod findings;
mod report;
mod samples;

use std::path::{Path, PathBuf};

use crate::layout::{self, CustomOptions, Layout, MaskSource};
use crate::{Error, Intrinsics, read_intrinsics};

use samples::Samples;

/// Frames looked at, evenly over the sequence.
const SAMPLES: usize = 12;

/// How serious a [`Finding`] is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// Worth knowing.
    Info,
    /// A run starts, but its result is in doubt.
    Warning,
    /// A run fails.
    Error,
}

/// One thing noticed, and what to do about it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding {
    /// How serious it is.
    pub severity: Severity,
    /// What was noticed; names the file where it is about one.
    pub message: String,
    /// What to do.
    pub remedy: String,
}

impl Finding {
    fn new(severity: Severity, message: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { severity, message: message.into(), remedy: remedy.into() }
    }

    fn from_error(error: &Error) -> Self {
        Self::new(Severity::Error, format!("{}: {}", error.path.display(), error.problem), &error.remedy)
    }
}

/// 5th, 50th and 95th percentile of depth, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthRange {
    /// 5th percentile, metres.
    pub p05: f64,
    /// Median, metres.
    pub p50: f64,
    /// 95th percentile, metres.
    pub p95: f64,
}

/// What [`inspect`] saw. `None` where it could not be measured; `findings` then says why. Prints as one screen.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Inspection {
    /// The folder.
    pub path: PathBuf,
    /// Colour images, after the stride.
    pub frames: usize,
    /// Colour images in `rgb/`.
    pub color_files: usize,
    /// Depth images in `depth/`.
    pub depth_files: usize,
    /// Mask images in the folder the options name.
    pub mask_files: usize,
    /// Frames that have a mask under the options.
    pub frames_with_mask: usize,
    /// Frames without a depth file.
    pub frames_without_depth: usize,
    /// Frames whose images were decoded for this inspection.
    pub sampled: usize,
    /// `(width, height)` of colour, pixels.
    pub size: Option<(usize, usize)>,
    /// The camera.
    pub intrinsics: Option<Intrinsics>,
    /// Full horizontal and vertical angle of view, degrees.
    pub fov_degrees: Option<[f64; 2]>,
    /// Metres per depth unit, as given.
    pub depth_scale: f64,
    /// What the raw values look like: the name of the unit.
    pub depth_units: Option<&'static str>,
    /// Depth over all pixels of the sampled frames.
    pub depth: Option<DepthRange>,
    /// Depth inside the first frame's mask.
    pub depth_in_mask: Option<DepthRange>,
    /// Part of all sampled pixels without depth, 0 to 1.
    pub missing_depth: Option<f64>,
    /// Part of the first mask's pixels without depth, 0 to 1.
    pub missing_depth_in_mask: Option<f64>,
    /// Part of the first frame covered by its mask, 0 to 1.
    pub mask_coverage: Option<f64>,
    /// Everything noticed, the most serious first.
    pub findings: Vec<Finding>,
}

impl Inspection {
    /// Whether something was found with which a run fails.
    pub fn has_errors(&self) -> bool {
        self.findings.iter().any(|f| f.severity == Severity::Error)
    }

    fn empty(path: &Path, depth_scale: f64) -> Self {
        Self {
            path: path.to_path_buf(),
            frames: 0,
            color_files: 0,
            depth_files: 0,
            mask_files: 0,
            frames_with_mask: 0,
            frames_without_depth: 0,
            sampled: 0,
            size: None,
            intrinsics: None,
            fov_degrees: None,
            depth_scale,
            depth_units: None,
            depth: None,
            depth_in_mask: None,
            missing_depth: None,
            missing_depth_in_mask: None,
            mask_coverage: None,
            findings: Vec::new(),
        }
    }
}

/// Looks over a custom folder: lists it and decodes up to twelve frames. Never fails: what prevents a run is a
/// finding of [`Severity::Error`], and everything that can still be looked at is.
pub fn inspect(path: impl AsRef<Path>, options: &CustomOptions) -> Inspection {
    let root = path.as_ref();
    let mut seen = Inspection::empty(root, options.depth_scale);
    match Layout::scan(root, options) {
        Ok(layout) => look(&layout, options, &mut seen),
        Err(e) => seen.findings.push(Finding::from_error(&e)),
    }
    // Stable, so findings of one kind stay in the order of the checks.
    seen.findings.sort_by_key(|f| std::cmp::Reverse(f.severity));
    seen
}

fn look(layout: &Layout, options: &CustomOptions, seen: &mut Inspection) {
    seen.frames = layout.entries.len();
    (seen.color_files, seen.depth_files, seen.mask_files) =
        (layout.color_files, layout.depth_files, layout.mask_files);
    seen.frames_with_mask = layout.entries.iter().filter(|e| e.mask.is_some()).count();
    seen.frames_without_depth = layout.entries.iter().filter(|e| e.depth.is_none()).count();
    seen.findings.extend(layout.problems.iter().map(Finding::from_error));
    findings::counts(layout, options.masks == MaskSource::None, seen);

    let samples = Samples::read(layout, SAMPLES);
    samples.report_into(seen);

    let k_path = layout.root.join("cam_K.txt");
    match (read_intrinsics(&k_path), seen.size) {
        (Err(e), _) => seen.findings.push(Finding::from_error(&e)),
        (Ok(k), size) => {
            seen.intrinsics = Some(k);
            if let Some(size) = size {
                seen.fov_degrees = Some(camera::fov_degrees(&k, size));
                match layout::check_principal_point(&k, &k_path, size) {
                    Err(e) => seen.findings.push(Finding::from_error(&e)),
                    Ok(()) => seen.findings.extend(camera::plausibility(&k, size)),
                }
            }
        }
    }
}
