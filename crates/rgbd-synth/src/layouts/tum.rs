//! TUM RGB-D.

use super::{camera_matrix, each_frame, folder, mesh, text, units};
use crate::Sequence;
use rgbd_io::{Error, write_png_mask, write_png_rgb, write_png_u16};
use std::fmt::Write as _;
use std::path::Path;

const START: f64 = 1_305_031_102.175_304;

/// Writes `sequence` as `<name>` of a folder of TUM RGB-D sequences: the object is the world in which the camera moves.
/// Beyond the dataset's own files there are `masks/`, `cam_K.txt` and `mesh/model.obj`. Gives the name to open it by.
///
/// # Errors
/// When a file can't be written; the error names it.
pub fn write_tum(sequence: &Sequence, root: impl AsRef<Path>) -> Result<String, Error> {
    let name = sequence.name();
    let dir = root.as_ref().join(name);
    for part in ["rgb", "depth", "masks"] {
        folder(&dir.join(part))?;
    }
    let color_time = |i: usize| format!("{:.6}", START + i as f64 / 30.0);
    let depth_time = |i: usize| format!("{:.6}", START + i as f64 / 30.0 + 0.004);
    each_frame(sequence, |i, f| {
        write_png_rgb(&dir.join(format!("rgb/{}.png", color_time(i))), &f.frame.color)?;
        write_png_u16(&dir.join(format!("depth/{}.png", depth_time(i))), &units(&f.frame.depth, 5000.0))?;
        write_png_mask(&dir.join(format!("masks/{}.png", color_time(i))), &f.visible_mask)
    })?;
    let list = |title: &str, folder: &str, time: &dyn Fn(usize) -> String| {
        let head = format!("# {title}\n# file: '{name}'\n# timestamp filename\n");
        (0..sequence.len()).fold(head, |list, i| format!("{list}{0} {folder}/{0}.png\n", time(i)))
    };
    text(&dir.join("rgb.txt"), &list("color images", "rgb", &color_time))?;
    text(&dir.join("depth.txt"), &list("depth maps", "depth", &depth_time))?;
    text(&dir.join("groundtruth.txt"), &trajectory(sequence))?;
    text(&dir.join("cam_K.txt"), &camera_matrix(sequence, " "))?;
    mesh(&dir.join("mesh/model.obj"), sequence.mesh(), marching_cubes::write_obj)?;
    Ok(name.to_owned())
}

fn trajectory(sequence: &Sequence) -> String {
    let mut lines = "# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n".to_owned();
    for i in 0..sequence.len() {
        let pose = sequence.cam_from_obj(i).inverse();
        let (t, q) = (pose.translation.vector, pose.rotation.coords);
        let time = START + i as f64 / 30.0 + 0.001;
        // Writing to a string can't fail.
        let _ = writeln!(lines, "{time:.4} {} {} {} {} {} {} {}", t.x, t.y, t.z, q.x, q.y, q.z, q.w);
    }
    lines
}
