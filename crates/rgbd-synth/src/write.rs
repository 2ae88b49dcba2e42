//! Sequences as folders.

use crate::Sequence;
use rayon::prelude::*;
use rgbd_io::{CustomWriter, Error};
use std::path::Path;

/// Writes `sequence` to the folder `dir` in the custom layout that [`rgbd_io::CustomFolder`] reads: `rgb/`, `depth/`
/// (millimetres), `masks/` (true visible masks, whatever [`crate::Masks`] says), `cam_K.txt`, and the truth in
/// `gt_poses/` (`cam_from_obj`) and `mesh/model.obj` (object frame, metres).
///
/// # Errors
/// When a file can't be written; the error names it.
pub fn write_custom(sequence: &Sequence, dir: impl AsRef<Path>) -> Result<(), Error> {
    let dir = dir.as_ref();
    let writer = CustomWriter::create(dir, &sequence.intrinsics())?;
    (0..sequence.len()).into_par_iter().try_for_each(|index| {
        let f = sequence.render(index);
        writer.write_frame(&f.frame.id, &f.frame.color, &f.frame.depth, Some(&f.visible_mask))?;
        writer.write_truth_pose(&f.frame.id, &f.cam_from_obj)
    })?;
    let folder = dir.join("mesh");
    let failed = |e: std::io::Error| {
        Error::new(&folder, format!("writing the mesh failed ({e})"), "check the disk and its permissions")
    };
    std::fs::create_dir_all(&folder).map_err(failed)?;
    let mut text = Vec::new();
    marching_cubes::write_obj(sequence.mesh(), &mut text).map_err(failed)?;
    rgbd_io::poses::write_atomic(&folder.join("model.obj"), &text)
}
