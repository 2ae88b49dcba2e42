//! A sequence of any dataset with the masks that were asked for.

use super::benchmark::Benchmark;
use super::synth;
use rgbd_io::datasets::{DatasetOptions, DatasetSequence};
use rgbd_io::{Error, FrameSource, Mask, MaskSource, RgbdFrame};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Which masks a method gets.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Masks {
    /// The first frame's alone.
    First,
    /// One per frame, as the dataset gives them.
    Given,
    /// One per frame, from `<folder>/<sequence>/` or `<folder>/<sequence>/masks/`, or from a folder of that name in
    /// the sequence's own, or from this folder itself.
    Folder(PathBuf),
}

impl Masks {
    pub(super) fn parse(word: &str) -> Self {
        match word {
            "first" => Self::First,
            "gt" | "all" => Self::Given,
            folder => {
                // Absolute where it exists: each job looks from its sequence's folder.
                let path = PathBuf::from(folder);
                Self::Folder(path.canonicalize().unwrap_or(path))
            }
        }
    }

    pub(super) fn describe(&self) -> String {
        match self {
            Self::First => "first frame only".into(),
            Self::Given => "given, every frame".into(),
            Self::Folder(folder) => format!("from {}", folder.display()),
        }
    }
}

/// Where a sequence is and how it is read.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Place {
    pub(super) benchmark: Benchmark,
    /// Absolute.
    pub(super) root: PathBuf,
    pub(super) name: String,
    pub(super) models: Option<PathBuf>,
    /// BOP: which object of the scene.
    pub(super) object: Option<u32>,
    pub(super) stride: usize,
}

/// Folders of one's own may have derived masks beside the original ones.
const ORIGINAL: &str = "masks";
const DERIVED: &str = "masks_derived";

impl Place {
    /// Opens it without masks, for its truth.
    pub(super) fn open_unmasked(&self) -> Result<DatasetSequence, Error> {
        self.open_with(MaskSource::None)
    }

    fn open_with(&self, masks: MaskSource) -> Result<DatasetSequence, Error> {
        let options = DatasetOptions {
            masks,
            stride: self.stride,
            scale_divisor: self.benchmark.scale_divisor(),
            models: self.models.clone(),
            object: self.object,
            intrinsics: None,
        };
        self.benchmark.dataset().open(&self.root, &self.name, &options)
    }

    /// Opens it for tracking.
    pub(super) fn open(&self, masks: &Masks) -> anyhow::Result<Video> {
        let source = match masks {
            Masks::Folder(folder) => MaskSource::Folder(self.folder(folder)),
            Masks::Given if self.is_folder() => MaskSource::Folder(self.complete_masks(synth::GIVEN)?),
            Masks::Given => MaskSource::All,
            Masks::First => {
                let source = if self.is_folder() { self.first_masks()? } else { MaskSource::First };
                let first_mask = self.open_with(source)?.frame(0)?.mask;
                return Ok(Video { frames: self.open_unmasked()?, first_mask });
            }
        };
        Ok(Video { frames: self.open_with(source)?, first_mask: None })
    }

    /// Opens it with the true masks of every frame.
    pub(super) fn open_true_masks(&self) -> anyhow::Result<DatasetSequence> {
        let masks = if self.is_folder() {
            MaskSource::Folder(self.complete_masks(ORIGINAL)?)
        } else {
            MaskSource::All
        };
        Ok(self.open_with(masks)?)
    }

    fn is_folder(&self) -> bool {
        matches!(self.benchmark, Benchmark::Synth | Benchmark::Custom)
    }

    fn folder(&self, folder: &Path) -> PathBuf {
        let own = folder.join(&self.name);
        let candidates = [own.join("masks"), own];
        candidates.into_iter().find(|p| p.is_dir()).unwrap_or_else(|| folder.to_owned())
    }

    /// The folder with a mask for every frame: `preferred`, else the original masks, else the derived ones.
    fn complete_masks(&self, preferred: &str) -> anyhow::Result<PathBuf> {
        let frames = self.open_unmasked()?;
        let mut found = Vec::new();
        for name in [preferred, ORIGINAL, DERIVED] {
            let dir = frames.path().join(name);
            let count =
                (0..frames.len()).filter(|i| dir.join(format!("{}.png", frames.id(*i))).is_file()).count();
            if count == frames.len() {
                return Ok(PathBuf::from(name));
            }
            found.push(format!("{} has masks of {count} of {} frames", dir.display(), frames.len()));
        }
        anyhow::bail!("{}; give the folder of a complete set with --masks FOLDER", found[1..].join(", "))
    }

    /// The folder that has the first frame's mask; without one, the place where it belongs.
    fn first_masks(&self) -> anyhow::Result<MaskSource> {
        let frames = self.open_unmasked()?;
        let has_first = |d: &&str| frames.path().join(d).join(format!("{}.png", frames.id(0))).is_file();
        let folder = [ORIGINAL, DERIVED].into_iter().find(has_first);
        Ok(folder.map_or(MaskSource::First, |folder| MaskSource::Folder(folder.into())))
    }
}

/// Frames as a method sees them.
#[derive(Debug)]
pub(super) struct Video {
    frames: DatasetSequence,
    /// The only mask, where one alone was asked for.
    first_mask: Option<Mask>,
}

impl FrameSource for Video {
    fn len(&self) -> usize {
        self.frames.len()
    }

    fn id(&self, index: usize) -> &str {
        self.frames.id(index)
    }

    fn frame(&self, index: usize) -> Result<RgbdFrame, Error> {
        let mut frame = self.frames.frame(index)?;
        if let Some(mask) = self.first_mask.as_ref().filter(|_| index == 0) {
            frame.mask = Some(mask.clone());
        }
        Ok(frame)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rgbd_io::{CustomWriter, Image, Intrinsics, write_png_mask};
    use std::fs;

    /// A sequence of two frames with these masks, whose areas tell them apart.
    fn place(dir: &Path, original: &[&str], derived: &[&str]) -> Place {
        let camera = Intrinsics { fx: 60.0, fy: 60.0, cx: 15.5, cy: 11.5 };
        let folder = dir.join("seq");
        let writer = CustomWriter::create(&folder, &camera).unwrap();
        let (color, depth) = (Image::filled(32, 24, [90; 3]), Image::filled(32, 24, 0.5));
        for id in ["0000", "0001"] {
            writer.write_frame(id, &color, &depth, None).unwrap();
        }
        for (name, ids, columns) in [(ORIGINAL, original, 4), (DERIVED, derived, 8)] {
            fs::create_dir_all(folder.join(name)).unwrap();
            let mask = Image::from_fn(32, 24, |x, _| if x < columns { 255 } else { 0 });
            ids.iter()
                .for_each(|id| write_png_mask(&folder.join(name).join(format!("{id}.png")), &mask).unwrap());
        }
        let (root, name) = (dir.to_owned(), "seq".to_owned());
        Place { benchmark: Benchmark::Custom, root, name, models: None, object: None, stride: 1 }
    }

    /// Columns of the masks that a method gets.
    fn columns(place: &Place, masks: &str) -> anyhow::Result<Vec<Option<usize>>> {
        let video = place.open(&Masks::parse(masks))?;
        let columns = |i| -> anyhow::Result<_> {
            let mask = video.frame(i)?.mask;
            Ok(mask.map(|m| m.pixels().iter().filter(|v| **v > 0).count() / 24))
        };
        (0..video.len()).map(columns).collect()
    }

    #[test]
    fn given_masks_are_those_of_the_complete_folder() {
        let dir = tempfile::tempdir().unwrap();
        let both = ["0000", "0001"];
        assert_eq!(columns(&place(dir.path(), &both, &both), "gt").unwrap(), [Some(4), Some(4)]);
        let dir = tempfile::tempdir().unwrap();
        let place = place(dir.path(), &["0000"], &both);
        assert_eq!(columns(&place, "all").unwrap(), [Some(8), Some(8)]);
        assert_eq!(columns(&place, "first").unwrap(), [Some(4), None]);
        fs::remove_file(dir.path().join("seq/masks/0000.png")).unwrap();
        assert_eq!(columns(&place, "first").unwrap(), [Some(8), None]);
        fs::remove_file(dir.path().join("seq/masks_derived/0001.png")).unwrap();
        let error = columns(&place, "gt").unwrap_err().to_string();
        assert!(error.contains("masks_derived has masks of 1 of 2 frames"), "{error}");
    }

    #[test]
    fn masks_of_another_folder() {
        let dir = tempfile::tempdir().unwrap();
        let place = place(dir.path(), &["0000", "0001"], &["0000", "0001"]);
        assert_eq!(columns(&place, "masks_derived").unwrap(), [Some(8), Some(8)]);
        // The masks that another run used.
        let run = dir.path().join("run");
        fs::create_dir_all(run.join("seq/masks")).unwrap();
        let mask = Image::from_fn(32, 24, |x, _| if x < 6 { 255 } else { 0 });
        ["0000", "0001"]
            .iter()
            .for_each(|id| write_png_mask(&run.join(format!("seq/masks/{id}.png")), &mask).unwrap());
        assert_eq!(columns(&place, run.to_str().unwrap()).unwrap(), [Some(6), Some(6)]);
    }
}
