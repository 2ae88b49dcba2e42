//! The BOP format.

use super::{camera_matrix, each_frame, folder, mesh, numbers, text, units};
use crate::Sequence;
use rgbd_io::{Error, write_png_mask, write_png_rgb, write_png_u16};
use std::path::Path;

/// Millimetres per unit of depth.
const DEPTH_SCALE: f64 = 0.1;

/// Writes `sequence` as the scene `test/000001` of a BOP dataset with one object. Gives the name to open it by.
///
/// # Errors
/// When a file can't be written; the error names it.
pub fn write_bop(sequence: &Sequence, root: impl AsRef<Path>) -> Result<String, Error> {
    let (root, name) = (root.as_ref(), "test/000001");
    let dir = root.join(name);
    for part in ["rgb", "depth", "mask_visib"] {
        folder(&dir.join(part))?;
    }
    each_frame(sequence, |i, f| {
        write_png_rgb(&dir.join(format!("rgb/{i:06}.png")), &f.frame.color)?;
        write_png_u16(&dir.join(format!("depth/{i:06}.png")), &units(&f.frame.depth, 1000.0 / DEPTH_SCALE))?;
        write_png_mask(&dir.join(format!("mask_visib/{i:06}_000000.png")), &f.visible_mask)
    })?;
    let by_image = |entry: &dyn Fn(usize) -> String| {
        let lines: Vec<String> = (0..sequence.len()).map(|i| format!("  \"{i}\": {}", entry(i))).collect();
        format!("{{\n{}\n}}\n", lines.join(",\n"))
    };
    let k = camera_matrix(sequence, ", ");
    let camera = by_image(&|_| format!(r#"{{"cam_K": [{k}], "depth_scale": {DEPTH_SCALE}}}"#));
    text(&dir.join("scene_camera.json"), &camera)?;
    let truth = by_image(&|i| {
        let pose = sequence.cam_from_obj(i);
        let rotation = pose.rotation.to_rotation_matrix();
        // nalgebra stores columns.
        let rotation = numbers(rotation.matrix().transpose().iter());
        let translation = numbers((pose.translation.vector * 1000.0).iter());
        format!(r#"[{{"cam_R_m2c": [{rotation}], "cam_t_m2c": [{translation}], "obj_id": 1}}]"#)
    });
    text(&dir.join("scene_gt.json"), &truth)?;
    models(sequence, &root.join("models"))?;
    Ok(name.to_owned())
}

fn models(sequence: &Sequence, dir: &Path) -> Result<(), Error> {
    let millimetres = sequence.mesh().transformed(|v| v.map(|c| c * 1000.0));
    mesh(&dir.join("obj_000001.ply"), &millimetres, marching_cubes::write_ply)?;
    let (low, high) = millimetres.bounds().unwrap_or_default();
    let size: [f64; 3] = std::array::from_fn(|k| f64::from(high[k]) - f64::from(low[k]));
    // That of the box: the farthest two vertices would take a hull.
    let diameter = size.iter().map(|s| s * s).sum::<f64>().sqrt();
    let info = format!(
        r#"{{"1": {{"diameter": {diameter}, "min_x": {}, "min_y": {}, "min_z": {}, "size_x": {}, "size_y": {}, "size_z": {}}}}}"#,
        low[0], low[1], low[2], size[0], size[1], size[2]
    );
    text(&dir.join("models_info.json"), &info)
}
