//! Benchmarks in the layouts they are published in, with their truth.
//!
//! | module | dataset | depth | truth |
//! |---|---|---|---|
//! | [`ho3d`] | HO-3D version 3 | two channels of an 8-bit PNG | pickled axis-angle and translation, OpenGL camera |
//! | [`ycbineoat`] | YCBInEOAT | 16-bit, millimetres | text, 4x4 |
//! | [`behave`] | BEHAVE | 16-bit, millimetres, 4 cameras | pickled axis-angle and translation of the centred template |
//! | [`bop`] | BOP format | 16-bit, scale per image | JSON, millimetres |
//! | [`tum`] | TUM RGB-D | 16-bit, 5000 per metre | text, camera to world |
//! | [`custom`] | one's own folder | 16-bit, millimetres | `gt_poses/*.txt`, `mesh/*.obj` |
//!
//! Each has `sequences(root)`, which lists the names, and `open(root, name, options)`, which gives a
//! [`DatasetSequence`]: a [`crate::FrameSource`] that knows its [`SequenceTruth`].
//!
//! ```
//! use rgbd_io::datasets::{DatasetOptions, ho3d};
//!
//! let error = ho3d::open("no/such/HO3D_v3", "AP10", &DatasetOptions::default()).unwrap_err();
//! assert!(error.to_string().contains("evaluation/<SEQ>/rgb/0000.jpg"));
//! ```

#![warn(clippy::indexing_slicing)]

mod assemble;
pub mod behave;
pub mod bop;
pub mod custom;
pub mod ho3d;
mod mesh;
mod pickle;
mod sequence;
// Loops over pixels, which are none of a file's.
#[allow(clippy::indexing_slicing)]
mod shrink;
#[allow(clippy::indexing_slicing)]
mod silhouette;
pub mod tum;
pub mod ycbineoat;

use std::path::{Path, PathBuf};

use nalgebra::Isometry3;

use crate::{Error, Intrinsics, MaskSource, listing};

pub use mesh::ModelMesh;
pub use sequence::DatasetSequence;

/// How to read a sequence of a dataset.
#[derive(Clone, Debug, PartialEq)]
pub struct DatasetOptions {
    /// Which frames come with a mask, and from where. A relative folder is taken from the sequence's.
    pub masks: MaskSource,
    /// Every how many frames one is used, from the first on; 0 counts as 1.
    pub stride: usize,
    /// Images become this many times smaller: colour is averaged, depth and mask are those of the middle pixel, and
    /// the intrinsics follow. 0 counts as 1.
    pub scale_divisor: usize,
    /// The folder of the models, where it isn't in its usual place.
    pub models: Option<PathBuf>,
    /// BOP: number of the object to track, where the scene has several.
    pub object: Option<u32>,
    /// TUM: the camera, where neither `cam_K.txt` nor the sequence's name tells.
    pub intrinsics: Option<Intrinsics>,
}

impl Default for DatasetOptions {
    fn default() -> Self {
        Self {
            masks: MaskSource::First,
            stride: 1,
            scale_divisor: 1,
            models: None,
            object: None,
            intrinsics: None,
        }
    }
}

/// What is known about a sequence.
#[derive(Clone, Debug, PartialEq)]
pub struct SequenceTruth {
    /// Object to camera (OpenCV, metres) per frame; `None` where a frame isn't annotated.
    pub cam_from_obj: Vec<Option<Isometry3<f64>>>,
    /// The mesh file of the object, in whose frame the poses are; `None` where there is no such thing (a TUM
    /// sequence moves a camera through a room).
    pub model: Option<PathBuf>,
    /// Metres per unit of the mesh file: 1, or 0.001 for BOP.
    pub model_scale: f64,
    /// Only that part of the surface which is ever seen, where the dataset has it (`visible_mesh.ply` of HO-3D).
    pub visible_model: Option<PathBuf>,
    /// Diameter of the object, metres, where the dataset states it.
    pub diameter: Option<f64>,
}

impl SequenceTruth {
    /// Reads the model, in metres; `None` where there is none.
    ///
    /// # Errors
    /// As [`ModelMesh::read`].
    pub fn read_model(&self) -> Result<Option<ModelMesh>, Error> {
        let Some(path) = &self.model else { return Ok(None) };
        let mut mesh = ModelMesh::read(path)?;
        mesh.vertices.iter_mut().flatten().for_each(|v| *v *= self.model_scale);
        Ok(Some(mesh))
    }
}

/// A dataset, for those who learn which one it is at run time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Dataset {
    /// [`ho3d`].
    Ho3d,
    /// [`ycbineoat`].
    YcbInEoat,
    /// [`behave`].
    Behave,
    /// [`bop`].
    Bop,
    /// [`tum`].
    Tum,
    /// [`custom`].
    Custom,
}

impl Dataset {
    /// All of them.
    pub const ALL: [Self; 6] =
        [Self::Ho3d, Self::YcbInEoat, Self::Behave, Self::Bop, Self::Tum, Self::Custom];

    /// Name in lower case, as in a command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ho3d => "ho3d",
            Self::YcbInEoat => "ycbineoat",
            Self::Behave => "behave",
            Self::Bop => "bop",
            Self::Tum => "tum",
            Self::Custom => "custom",
        }
    }

    /// The dataset of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|d| d.name().eq_ignore_ascii_case(name))
    }

    /// Names of the sequences below `root`, in natural order.
    ///
    /// # Errors
    /// When there is none; the message says where the dataset comes from and what belongs where.
    pub fn sequences(self, root: impl AsRef<Path>) -> Result<Vec<String>, Error> {
        match self {
            Self::Ho3d => ho3d::sequences(root),
            Self::YcbInEoat => ycbineoat::sequences(root),
            Self::Behave => behave::sequences(root),
            Self::Bop => bop::sequences(root),
            Self::Tum => tum::sequences(root),
            Self::Custom => custom::sequences(root),
        }
    }

    /// Opens the sequence `name`.
    ///
    /// # Errors
    /// When something that the whole sequence needs is missing or damaged.
    pub fn open(
        self,
        root: impl AsRef<Path>,
        name: &str,
        options: &DatasetOptions,
    ) -> Result<DatasetSequence, Error> {
        match self {
            Self::Ho3d => ho3d::open(root, name, options),
            Self::YcbInEoat => ycbineoat::open(root, name, options),
            Self::Behave => behave::open(root, name, options),
            Self::Bop => bop::open(root, name, options),
            Self::Tum => tum::open(root, name, options),
            Self::Custom => custom::open(root, name, options),
        }
    }
}

/// Reads a whole file of at most `max` bytes.
fn read_file(path: &Path, max: u64, remedy: &str) -> Result<Vec<u8>, Error> {
    let failed = |e: std::io::Error| match e.kind() {
        std::io::ErrorKind::NotFound => Error::new(path, "is missing", remedy),
        _ => Error::io(path, "reading", &e),
    };
    let meta = std::fs::metadata(path).map_err(failed)?;
    if !meta.is_file() {
        return Err(Error::new(path, "isn't a file", remedy));
    }
    if meta.len() > max {
        let problem = format!("has {} bytes, more than the {max} that such a file can need", meta.len());
        return Err(Error::new(path, problem, remedy));
    }
    std::fs::read(path).map_err(failed)
}

/// Metadata of tens of thousands of frames stays below this.
const MAX_JSON_BYTES: u64 = 128 << 20;

fn read_json<T: serde::de::DeserializeOwned>(path: &Path, remedy: &str) -> Result<T, Error> {
    let bytes = read_file(path, MAX_JSON_BYTES, remedy)?;
    parse_json(&bytes).map_err(|problem| Error::new(path, problem, remedy))
}

fn parse_json<T: serde::de::DeserializeOwned>(bytes: &[u8]) -> Result<T, String> {
    serde_json::from_slice(bytes).map_err(|e| format!("isn't the JSON that belongs there ({e})"))
}

/// The folders in `dir` that pass `wanted`, in natural order; empty when it can't be listed.
fn folders(dir: &Path, wanted: impl Fn(&Path) -> bool) -> Vec<String> {
    let Ok(entries) = std::fs::read_dir(dir) else { return Vec::new() };
    let mut names: Vec<String> = entries
        .filter_map(|entry| {
            let path = entry.ok()?.path();
            let name = path.file_name()?.to_str()?.to_owned();
            (path.is_dir() && !name.starts_with('.') && wanted(&path)).then_some(name)
        })
        .collect();
    names.sort_by(|a, b| listing::natural_cmp(a, b));
    names
}

/// Fails with `source` unless there are names.
fn some_sequences(names: Vec<String>, root: &Path, source: &str) -> Result<Vec<String>, Error> {
    if names.is_empty() {
        let problem = if root.is_dir() { "holds no sequence of this dataset" } else { "no such folder" };
        return Err(Error::new(root, problem, source));
    }
    Ok(names)
}

/// Fails unless `name` is one plain part of a path (or several, with `/` between them).
fn check_name(root: &Path, name: &str) -> Result<(), Error> {
    let plain = |part: &str| !part.is_empty() && !part.starts_with('.') && !part.contains(['\\', '\0', ':']);
    if name.split('/').all(plain) {
        return Ok(());
    }
    let problem = format!("holds no sequence called \"{}\"", name.escape_debug());
    Err(Error::new(root, problem, "give a name that the list of sequences has"))
}

/// The first of `candidates` that is a file, or the first of all.
fn first_file(candidates: Vec<PathBuf>) -> PathBuf {
    let found = candidates.iter().find(|p| p.is_file()).cloned();
    found.or_else(|| candidates.into_iter().next()).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn huge_files_are_refused_unread() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene_gt.json");
        // Sparse: it takes no space.
        std::fs::File::create(&path).unwrap().set_len(MAX_JSON_BYTES + 1).unwrap();
        let message = read_json::<Vec<u8>>(&path, "make it smaller").unwrap_err().to_string();
        assert!(message.contains("scene_gt.json") && message.contains("more than"), "{message}");
    }
}
