//! BEHAVE.

use super::pickle::{Value, dictionary};
use super::{JPEG_QUALITY, each_frame, folder, grey, mesh, text};
use crate::{Sequence, SynthFrame};
use nalgebra::{Point3, Vector3};
use rgbd_io::{Error, poses::write_atomic, write_jpeg_rgb, write_png_depth};
use std::path::Path;

/// Writes `sequence` as what camera 1 saw in `sequences/Date01_Sub01_<name>` of a BEHAVE folder, with calibration and
/// template. Gives the name to open it by, without a camera.
///
/// # Errors
/// When a file can't be written; the error names it.
pub fn write_behave(sequence: &Sequence, root: impl AsRef<Path>) -> Result<String, Error> {
    let (root, object) = (root.as_ref(), sequence.name());
    let name = format!("Date01_Sub01_{object}");
    let dir = root.join("sequences").join(&name);
    calibration(sequence, root)?;
    let centre = centroid(sequence);
    each_frame(sequence, |i, f| {
        // One frame a second.
        let frame = dir.join(format!("t{:04}.000", i + 5));
        let fit = frame.join(object).join("fit01");
        folder(&fit)?;
        write_jpeg_rgb(&frame.join("k1.color.jpg"), &f.frame.color, JPEG_QUALITY)?;
        write_png_depth(&frame.join("k1.depth.png"), &f.frame.depth)?;
        // At full quality, so that half is still the mask's edge.
        write_jpeg_rgb(&frame.join("k1.obj_rend_mask.jpg"), &grey(&f.visible_mask), 100)?;
        write_atomic(&fit.join(format!("{object}_fit.pkl")), &parameters(f, &centre))
    })?;
    let info = format!(
        r#"{{"config": "../../calibs/Date01/config", "intrinsic": "../../calibs/intrinsics", "cat": "{object}",
"gender": "female", "empty": null, "kinects": [0, 1, 2, 3], "beta": null}}"#
    );
    text(&dir.join("info.json"), &info)?;
    let template = root.join("objects").join(object).join(format!("{object}_f1000.ply"));
    mesh(&template, sequence.mesh(), marching_cubes::write_ply)?;
    Ok(name)
}

/// Camera 1 is the world.
fn calibration(sequence: &Sequence, root: &Path) -> Result<(), Error> {
    let (config, intrinsics) = (root.join("calibs/Date01/config/1"), root.join("calibs/intrinsics/1"));
    folder(&config)?;
    folder(&intrinsics)?;
    let identity =
        r#"{"rotation": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], "translation": [0.0, 0.0, 0.0]}"#;
    text(&config.join("config.json"), identity)?;
    let (k, spec) = (sequence.intrinsics(), sequence.spec());
    let color = format!(
        r#"{{"color": {{"fx": {}, "fy": {}, "cx": {}, "cy": {}, "width": {}, "height": {}}}}}"#,
        k.fx, k.fy, k.cx, k.cy, spec.width, spec.height
    );
    text(&intrinsics.join("calibration.json"), &color)
}

fn centroid(sequence: &Sequence) -> Point3<f64> {
    let vertices = &sequence.mesh().vertices;
    let sum = vertices.iter().fold(Vector3::zeros(), |s, v| s + Vector3::from(v.map(f64::from)));
    Point3::from(sum / vertices.len().max(1) as f64)
}

/// From the centred template to the camera.
fn parameters(frame: &SynthFrame, centre: &Point3<f64>) -> Vec<u8> {
    let angle: [f64; 3] = frame.cam_from_obj.rotation.scaled_axis().into();
    let translation: [f64; 3] = (frame.cam_from_obj * centre).coords.into();
    dictionary(&[("angle", Value::Array(&[3], &angle)), ("trans", Value::Array(&[3], &translation))])
}
