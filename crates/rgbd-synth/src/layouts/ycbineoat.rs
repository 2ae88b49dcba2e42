//! YCBInEOAT.

use super::{camera_matrix, each_frame, folder, mesh, text};
use crate::Sequence;
use rgbd_io::{Error, poses::format_pose, write_png_depth, write_png_mask, write_png_rgb};
use std::path::Path;

/// Writes `sequence` as the video `<name>` of a YCBInEOAT folder, with `models/<name>/textured_simple.obj`. As in the
/// published videos, images are named by time stamps and poses by numbers. Gives the name to open it by.
///
/// # Errors
/// When a file can't be written; the error names it.
pub fn write_ycbineoat(sequence: &Sequence, root: impl AsRef<Path>) -> Result<String, Error> {
    let (root, name) = (root.as_ref(), sequence.name());
    let dir = root.join(name);
    for part in ["rgb", "depth", "masks", "annotated_poses"] {
        folder(&dir.join(part))?;
    }
    text(&dir.join("cam_K.txt"), &camera_matrix(sequence, " "))?;
    each_frame(sequence, |i, f| {
        let stamp = 1_581_120_424_100_262_102_u64 + 33_333_333 * i as u64;
        write_png_rgb(&dir.join(format!("rgb/{stamp}.png")), &f.frame.color)?;
        write_png_depth(&dir.join(format!("depth/{stamp}.png")), &f.frame.depth)?;
        write_png_mask(&dir.join(format!("masks/{stamp}.png")), &f.visible_mask)?;
        text(&dir.join(format!("annotated_poses/{i:07}.txt")), &format_pose(&f.cam_from_obj))
    })?;
    let model = root.join("models").join(name).join("textured_simple.obj");
    mesh(&model, sequence.mesh(), marching_cubes::write_obj)?;
    Ok(name.to_owned())
}
