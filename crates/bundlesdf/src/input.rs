//! Where a run's frames come from, as written into `run.json`: what works on results later opens the video again.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

use rgbd_io::{
    CustomFolder, CustomOptions, Error, FrameSource, MaskSource,
    datasets::{Dataset, DatasetOptions},
};
use rgbd_synth::{Masks, Sequence};
use serde::{Deserialize, Serialize};

/// A video that can be opened.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
pub enum VideoInput {
    /// A folder with `rgb/`, `depth/`, `masks/` and `cam_K.txt`.
    Folder {
        /// The folder.
        path: PathBuf,
        /// `first`, `all`, or a folder of masks.
        masks: String,
        /// The first frame's mask, when it isn't `masks/<first frame>.png`.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        first_mask: Option<PathBuf>,
        /// Every how many frames one is used.
        stride: usize,
        /// Metres per unit of the depth files.
        depth_scale: f64,
    },
    /// A sequence of a published dataset.
    Dataset {
        /// Name of the dataset, as in [`Dataset::name`].
        dataset: String,
        /// Folder of the dataset.
        root: PathBuf,
        /// Name of the sequence.
        video: String,
        /// `first`, `all`, or a folder of masks.
        masks: String,
        /// Every how many frames one is used.
        stride: usize,
    },
    /// A built-in synthetic sequence.
    Synthetic {
        /// `demo`, or a name of the suite.
        name: String,
        /// `first` or `all`.
        masks: String,
        /// How many of its frames.
        frames: usize,
    },
}

impl VideoInput {
    /// Opens the video.
    ///
    /// # Errors
    /// When it isn't there any more or can't be read; the message names the file.
    pub fn open(&self) -> Result<Arc<dyn FrameSource>, Error> {
        self.open_with(true)
    }

    /// Opens the video for work with the masks that a run has written: its own may be gone.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn open_without_masks(&self) -> Result<Arc<dyn FrameSource>, Error> {
        self.open_with(false)
    }

    fn open_with(&self, with_masks: bool) -> Result<Arc<dyn FrameSource>, Error> {
        let mask_source = |text: &str| if with_masks { mask_source(text) } else { MaskSource::None };
        Ok(match self {
            Self::Folder { path, masks, first_mask, stride, depth_scale } => {
                let options = CustomOptions {
                    masks: mask_source(masks),
                    depth_scale: *depth_scale,
                    stride: *stride,
                    first_mask: first_mask.clone().filter(|_| with_masks),
                };
                Arc::new(CustomFolder::open(path, &options)?)
            }
            Self::Dataset { dataset, root, video, masks, stride } => {
                let known = Dataset::from_name(dataset).ok_or_else(|| unknown(root, dataset))?;
                let options = DatasetOptions {
                    masks: mask_source(masks),
                    stride: *stride,
                    ..DatasetOptions::default()
                };
                Arc::new(known.open(root, video, &options)?)
            }
            Self::Synthetic { name, masks, frames } => {
                let masks = if masks == "all" { Masks::Every } else { Masks::First };
                let sequence = if name == "demo" { Some(Sequence::demo()) } else { Sequence::named(name) };
                let sequence = sequence.ok_or_else(|| {
                    Error::new(Path::new(name), "is no built-in sequence", "use demo, or a name of the suite")
                })?;
                Arc::new(sequence.with_masks(masks).truncated(*frames))
            }
        })
    }

    /// What to call the video in reports.
    #[must_use]
    pub fn name(&self) -> String {
        match self {
            Self::Folder { path, .. } => {
                path.file_name().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into())
            }
            Self::Dataset { dataset, video, .. } => format!("{dataset} {video}"),
            Self::Synthetic { name, .. } => name.clone(),
        }
    }
}

/// `first`, `all`, or a folder.
#[must_use]
pub fn mask_source(text: &str) -> MaskSource {
    match text {
        "first" => MaskSource::First,
        "all" => MaskSource::All,
        folder => MaskSource::Folder(PathBuf::from(folder)),
    }
}

fn unknown(root: &Path, dataset: &str) -> Error {
    let names: Vec<_> = Dataset::ALL.iter().map(|d| d.name()).collect();
    Error::new(root, format!("there is no dataset \"{dataset}\""), format!("use one of {}", names.join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_input_survives_json_and_opens_again() {
        let input = VideoInput::Synthetic { name: "demo".into(), masks: "first".into(), frames: 2 };
        let text = serde_json::to_string(&input).unwrap();
        let again: VideoInput = serde_json::from_str(&text).unwrap();
        assert_eq!(again, input);
        assert_eq!(again.open().unwrap().len(), 2);
    }

    #[test]
    fn what_cannot_be_opened_is_named() {
        let input = VideoInput::Dataset {
            dataset: "ho4d".into(),
            root: "somewhere".into(),
            video: "AP10".into(),
            masks: "first".into(),
            stride: 1,
        };
        let error = input.open().err().unwrap().to_string();
        assert!(error.contains("ho4d") && error.contains("ho3d"), "{error}");
    }
}
