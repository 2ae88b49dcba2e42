//! Writing the custom layout.

use std::path::{Path, PathBuf};

use nalgebra::Isometry3;

use crate::poses::{format_pose, nine_digits, write_atomic};
use crate::{Error, Image, Intrinsics, Mask, codec};

/// Writes a sequence in the layout that [`crate::CustomFolder`] reads. Every file is written whole or not at all;
/// frames may be written from several threads.
#[derive(Clone, Debug)]
pub struct CustomWriter {
    root: PathBuf,
}

impl CustomWriter {
    /// Creates the folders `rgb/`, `depth/`, `masks/` in `dir` and writes `cam_K.txt`. Files that are there
    /// already stay unless a frame of the same name is written.
    ///
    /// # Errors
    /// When a folder can't be created or the camera isn't valid.
    pub fn create(dir: impl AsRef<Path>, intrinsics: &Intrinsics) -> Result<Self, Error> {
        let root = dir.as_ref().to_path_buf();
        if !intrinsics.is_valid() {
            let remedy = "give finite numbers and positive focal lengths";
            return Err(Error::new(root.join("cam_K.txt"), format!("can't hold {intrinsics:?}"), remedy));
        }
        for name in ["rgb", "depth", "masks"] {
            create_folder(&root.join(name))?;
        }
        let [fx, fy, cx, cy] = [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy].map(nine_digits);
        let text = format!("{fx} 0 {cx}\n0 {fy} {cy}\n0 0 1\n");
        write_atomic(&root.join("cam_K.txt"), text.as_bytes())?;
        Ok(Self { root })
    }

    /// Writes one frame as `<id>.png`: RGB colour, depth in metres (stored in millimetres, see
    /// [`crate::write_png_depth`]), and the mask where there is one.
    ///
    /// # Errors
    /// When a file can't be written, the sizes differ, or `id` isn't a plain file name.
    pub fn write_frame(
        &self,
        id: &str,
        color: &Image<[u8; 3]>,
        depth: &Image<f32>,
        mask: Option<&Mask>,
    ) -> Result<(), Error> {
        let path = |folder: &str| self.file(folder, id, "png");
        if depth.size() != color.size() || mask.is_some_and(|m| m.size() != color.size()) {
            let problem = "depth or mask differ from colour in size".to_owned();
            return Err(Error::new(path("depth")?, problem, "write images of one size"));
        }
        codec::write_png_rgb(&path("rgb")?, color)?;
        codec::write_png_depth(&path("depth")?, depth)?;
        match mask {
            Some(mask) => codec::write_png_mask(&path("masks")?, mask),
            None => Ok(()),
        }
    }

    /// Writes the true pose of a frame to `gt_poses/<id>.txt`.
    ///
    /// # Errors
    /// When the file can't be written or `id` isn't a plain file name.
    pub fn write_truth_pose(&self, id: &str, cam_from_obj: &Isometry3<f64>) -> Result<(), Error> {
        let path = self.file("gt_poses", id, "txt")?;
        create_folder(&self.root.join("gt_poses"))?;
        write_atomic(&path, format_pose(cam_from_obj).as_bytes())
    }

    fn file(&self, folder: &str, id: &str, extension: &str) -> Result<PathBuf, Error> {
        let path = self.root.join(folder);
        // A leading dot would hide the frame from the reader.
        if id.is_empty() || id.starts_with('.') || id.contains(['/', '\\', '\0']) {
            let problem = format!("can't hold a frame called \"{}\"", id.escape_debug());
            return Err(Error::new(path, problem, "name frames by plain file names such as 0000"));
        }
        Ok(path.join(format!("{id}.{extension}")))
    }
}

fn create_folder(dir: &Path) -> Result<(), Error> {
    std::fs::create_dir_all(dir).map_err(|e| Error::io(dir, "creating the folder", &e))
}
