//! A sequence of any dataset: its files, and how a frame is made of them.

use std::path::{Path, PathBuf};

use nalgebra::Isometry3;

use super::{DatasetOptions, SequenceTruth, shrink};
use crate::{Error, FrameSource, Image, Intrinsics, Mask, RgbdFrame, codec, layout};

/// How depth is stored.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum DepthCode {
    /// 16 bits; metres per unit.
    Metres(f64),
    /// Two channels of a colour PNG; see [`super::ho3d::decode_depth`].
    Ho3d,
}

/// Where the pose of a frame comes from.
#[derive(Clone, Debug)]
pub(super) enum PoseSource {
    Unknown,
    Known(Isometry3<f64>),
    /// A file and what reads it; a file that isn't there means that the frame isn't annotated.
    File(PathBuf, fn(&Path) -> Result<Option<Isometry3<f64>>, Error>),
}

/// The files of one frame.
#[derive(Clone, Debug)]
pub(super) struct Frame {
    pub(super) id: String,
    pub(super) color: PathBuf,
    pub(super) depth: PathBuf,
    pub(super) depth_code: DepthCode,
    /// The object's mask; the file may be missing.
    pub(super) mask: Option<PathBuf>,
    /// Mask of what hides the object; the file may be missing.
    pub(super) occluder: Option<PathBuf>,
    /// Of the images as they are stored.
    pub(super) intrinsics: Intrinsics,
    pub(super) pose: PoseSource,
}

/// What is known about the object, apart from poses.
#[derive(Clone, Debug)]
pub(super) struct Model {
    /// `None` where the dataset knows no object.
    pub(super) file: Option<PathBuf>,
    pub(super) scale: f64,
    pub(super) visible: Option<PathBuf>,
    pub(super) diameter: Option<f64>,
    /// What to do when the file is missing.
    pub(super) remedy: String,
    /// `cam_from_obj = left * (what a pose source says) * right`.
    pub(super) left: Isometry3<f64>,
    pub(super) right: Isometry3<f64>,
}

impl Model {
    pub(super) fn new(file: Option<PathBuf>, remedy: impl Into<String>) -> Self {
        let identity = Isometry3::identity();
        let remedy = remedy.into();
        Self { file, scale: 1.0, visible: None, diameter: None, remedy, left: identity, right: identity }
    }
}

/// A sequence of a dataset: frames, and the truth about them.
#[derive(Clone, Debug)]
pub struct DatasetSequence {
    pub(super) name: String,
    pub(super) root: PathBuf,
    pub(super) frames: Vec<Frame>,
    pub(super) model: Model,
    pub(super) divisor: usize,
    /// Of the stored images.
    pub(super) stored_size: (usize, usize),
}

impl DatasetSequence {
    /// Name of the sequence; for BEHAVE with the number of the camera.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Folder of the sequence.
    pub fn path(&self) -> &Path {
        &self.root
    }

    /// The camera of the first frame, at the size that frames come in.
    pub fn intrinsics(&self) -> Intrinsics {
        let none = Intrinsics { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
        self.frames.first().map_or(none, |f| self.scaled(&f.intrinsics))
    }

    /// `(width, height)` of all frames, pixels.
    pub fn size(&self) -> (usize, usize) {
        (self.stored_size.0 / self.divisor, self.stored_size.1 / self.divisor)
    }

    /// Reads the true poses of all frames and finds the model.
    ///
    /// # Errors
    /// When an annotation is damaged or the model's file is missing.
    pub fn truth(&self) -> Result<SequenceTruth, Error> {
        if let Some(file) = self.model.file.as_ref().filter(|f| !f.is_file()) {
            return Err(Error::new(file, "is missing: the object's model", self.model.remedy.as_str()));
        }
        let poses: Result<Vec<_>, Error> = self.frames.iter().map(|f| self.pose(f)).collect();
        Ok(SequenceTruth {
            cam_from_obj: poses?,
            model: self.model.file.clone(),
            model_scale: self.model.scale,
            visible_model: self.model.visible.clone(),
            diameter: self.model.diameter,
        })
    }

    pub(super) fn pose(&self, frame: &Frame) -> Result<Option<Isometry3<f64>>, Error> {
        let pose = match &frame.pose {
            PoseSource::Unknown => None,
            PoseSource::Known(pose) => Some(*pose),
            PoseSource::File(path, _) if !path.exists() => None,
            PoseSource::File(path, read) => read(path)?,
        };
        Ok(pose.map(|pose| self.model.left * pose * self.model.right))
    }

    /// Mask of what hides the object (the hand of HO-3D, the person of BEHAVE); `None` where there is none.
    ///
    /// # Errors
    /// When the file is damaged or of another shape than the image.
    pub fn occluder_mask(&self, index: usize) -> Result<Option<Mask>, Error> {
        let path = self.entry(index)?.occluder.as_ref().filter(|p| p.is_file());
        path.map(|path| self.read_mask(path)).transpose()
    }

    pub(super) fn entry(&self, index: usize) -> Result<&Frame, Error> {
        self.frames.get(index).ok_or_else(|| {
            let problem = format!("has {} frames, so none with index {index}", self.frames.len());
            Error::new(&self.root, problem, "ask for a smaller index")
        })
    }

    fn scaled(&self, k: &Intrinsics) -> Intrinsics {
        let s = 1.0 / self.divisor as f64;
        if self.divisor == 1 { *k } else { k.scaled(s, s) }
    }

    fn read_mask(&self, path: &Path) -> Result<Mask, Error> {
        let mask = layout::fit_mask(codec::read_mask_thresholded(path)?, path, self.stored_size)?;
        Ok(shrink::nearest(mask, self.divisor))
    }

    fn read_depth(&self, frame: &Frame) -> Result<Image<f32>, Error> {
        let depth = match frame.depth_code {
            DepthCode::Metres(scale) => {
                codec::read_depth_u16(&frame.depth)?.map(|raw| (f64::from(*raw) * scale) as f32)
            }
            DepthCode::Ho3d => super::ho3d::decode_depth(&codec::read_png_rgb(&frame.depth)?),
        };
        if depth.size() != self.stored_size {
            let ((w, h), (cw, ch)) = (depth.size(), self.stored_size);
            let problem = format!("has {w}x{h} pixels but its colour image {cw}x{ch}");
            return Err(Error::new(&frame.depth, problem, "use the depth that is registered to colour"));
        }
        Ok(shrink::nearest(depth, self.divisor))
    }
}

impl FrameSource for DatasetSequence {
    fn len(&self) -> usize {
        self.frames.len()
    }

    fn id(&self, index: usize) -> &str {
        self.frames.get(index).map_or("", |f| f.id.as_str())
    }

    fn frame(&self, index: usize) -> Result<RgbdFrame, Error> {
        let frame = self.entry(index)?;
        let color = codec::read_color(&frame.color)?;
        if color.size() != self.stored_size {
            let ((w, h), (fw, fh)) = (color.size(), self.stored_size);
            let problem = format!("has {w}x{h} pixels but the first image {fw}x{fh}");
            return Err(Error::new(&frame.color, problem, "download this image again"));
        }
        Ok(RgbdFrame {
            id: frame.id.clone(),
            color: shrink::average(color, self.divisor),
            depth: self.read_depth(frame)?,
            mask: frame.mask.as_deref().map(|path| self.read_mask(path)).transpose()?,
            intrinsics: self.scaled(&frame.intrinsics),
        })
    }
}

/// Applies stride and choice of masks, and checks the first frame.
pub(super) fn finish(
    name: &str,
    root: PathBuf,
    frames: Vec<Frame>,
    model: Model,
    options: &DatasetOptions,
    source: &str,
) -> Result<DatasetSequence, Error> {
    let mut frames: Vec<Frame> = frames.into_iter().step_by(options.stride.max(1)).collect();
    let Some(first) = frames.first() else {
        return Err(Error::new(root, "holds no frames", source));
    };
    super::assemble::check_camera(first, source)?;
    let stored_size = codec::read_color(&first.color)?.size();
    layout::check_principal_point(&first.intrinsics, &root, stored_size)?;
    super::assemble::choose_masks(&mut frames, &root, &options.masks)?;
    let divisor = options.scale_divisor.max(1);
    if stored_size.0 < divisor || stored_size.1 < divisor {
        let problem =
            format!("has images of {}x{} pixels, too small to divide", stored_size.0, stored_size.1);
        return Err(Error::new(root, problem, format!("use a scale divisor below {divisor}")));
    }
    let sequence = DatasetSequence { name: name.to_owned(), root, frames, model, divisor, stored_size };
    // A first frame that can't be read ends the run before it starts.
    sequence.frame(0)?;
    Ok(sequence)
}
