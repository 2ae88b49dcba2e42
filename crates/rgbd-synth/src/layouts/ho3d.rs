//! HO-3D version 3.

use super::pickle::{Value, dictionary};
use super::{JPEG_QUALITY, each_frame, folder, mesh};
use crate::Sequence;
use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use rgbd_io::{Error, Image, poses::write_atomic, write_jpeg_rgb, write_png_mask, write_png_rgb};
use std::path::Path;

const METRES_PER_UNIT: f64 = 0.00012498664727900177;

/// Writes `sequence` as `evaluation/<name>` of a HO-3D folder, with `models/<name>/textured_simple.obj` and
/// `masks_XMem/<name>`. Gives the name to open it by.
///
/// # Errors
/// When a file can't be written; the error names it.
pub fn write_ho3d(sequence: &Sequence, root: impl AsRef<Path>) -> Result<String, Error> {
    let (root, name) = (root.as_ref(), sequence.name());
    let dir = root.join("evaluation").join(name);
    let masks = root.join("masks_XMem").join(name);
    for path in [dir.join("rgb"), dir.join("depth"), dir.join("meta"), masks.clone()] {
        folder(&path)?;
    }
    each_frame(sequence, |i, f| {
        write_jpeg_rgb(&dir.join(format!("rgb/{i:04}.jpg")), &f.frame.color, JPEG_QUALITY)?;
        write_png_rgb(&dir.join(format!("depth/{i:04}.png")), &two_channels(&f.frame.depth))?;
        write_atomic(&dir.join(format!("meta/{i:04}.pkl")), &meta(sequence, &f.cam_from_obj))?;
        write_png_mask(&masks.join(format!("{i:05}.png")), &f.visible_mask)
    })?;
    let model = root.join("models").join(name).join("textured_simple.obj");
    mesh(&model, sequence.mesh(), marching_cubes::write_obj)?;
    Ok(name.to_owned())
}

/// Red holds the low byte, green the high one.
fn two_channels(depth: &Image<f32>) -> Image<[u8; 3]> {
    super::units(depth, 1.0 / METRES_PER_UNIT).map(|v| [(v & 255) as u8, (v >> 8) as u8, 0])
}

fn meta(sequence: &Sequence, cam_from_obj: &Isometry3<f64>) -> Vec<u8> {
    let k = sequence.intrinsics();
    let matrix = [k.fx, 0.0, k.cx, 0.0, k.fy, k.cy, 0.0, 0.0, 1.0];
    // The annotations' camera is that of OpenGL: y up, looking along -z.
    let flip = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    let gl = flip * cam_from_obj;
    let rotation: [f64; 3] = gl.rotation.scaled_axis().into();
    let translation: [f64; 3] = gl.translation.vector.into();
    dictionary(&[
        ("camMat", Value::Array(&[3, 3], &matrix)),
        ("objRot", Value::Array(&[3, 1], &rotation)),
        ("objTrans", Value::Array(&[3], &translation)),
        ("objName", Value::Text(sequence.name())),
        ("objLabel", Value::Int(1)),
    ])
}
