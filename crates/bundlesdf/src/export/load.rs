//! A run's mesh and views, read back.

use std::{fs, path::Path};

use marching_cubes::TriMesh;
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use rgbd_io::Error;

use crate::{KeyframeReport, OutputFolder, texture::View};

/// Most views that are used; of more, every n-th.
const MOST_VIEWS: usize = 160;

/// Reads a finished run's mesh and keyframes (object frame, metres), refined ones if the run was refined, and the
/// keyframes' frames from the video.
///
/// # Errors
/// When a file is missing or broken, or the results don't say which video they are of.
pub fn load(folder: &OutputFolder) -> Result<(TriMesh, Vec<View>), Error> {
    let mesh = read_mesh(&folder.path().join("mesh.ply"))?;
    let refined = folder.path().join("keyframes_refined.json");
    let keyframes = if refined.is_file() { read_keyframes(&refined)? } else { folder.read_keyframes()? };
    let input = folder.read_report()?.input.ok_or_else(|| {
        let remedy = "export it from the program that fed the frames, with bundlesdf::export::build";
        Error::new(folder.path(), "doesn't say which video it was made from", remedy)
    })?;
    let source = input.open()?;
    let step = keyframes.len().div_ceil(MOST_VIEWS).max(1);
    let views = keyframes.iter().step_by(step).map(|keyframe| {
        let frame = source.frame(keyframe.index)?;
        let mask = folder.read_mask(&keyframe.id)?;
        if mask.size() != frame.color.size() {
            let path = folder.path().join("masks").join(format!("{}.png", keyframe.id));
            return Err(Error::new(&path, "hasn't the size of its frame", "run the video again"));
        }
        Ok(View {
            color: frame.color,
            depth: frame.depth,
            mask,
            intrinsics: frame.intrinsics,
            obj_from_cam: pose(&keyframe.cam_from_obj).inverse(),
        })
    });
    Ok((mesh, views.collect::<Result<_, _>>()?))
}

fn read_mesh(path: &Path) -> Result<TriMesh, Error> {
    let bytes = fs::read(path).map_err(|e| {
        let remedy = "export a run that ended with a mesh; too few keyframes give none";
        Error::new(path, format!("can't be read ({e})"), remedy)
    })?;
    marching_cubes::read_ply(&bytes).map_err(|e| Error::new(path, e.to_string(), "run the video again"))
}

fn read_keyframes(path: &Path) -> Result<Vec<KeyframeReport>, Error> {
    let failed = |problem: String| Error::new(path, problem, "refine the run again with this version");
    let text = fs::read_to_string(path).map_err(|e| failed(format!("can't be read ({e})")))?;
    serde_json::from_str(&text).map_err(|e| failed(format!("isn't what this version writes ({e})")))
}

/// A pose from its 4x4 matrix; rounding in the file is taken out of the rotation.
fn pose(m: &[[f64; 4]; 4]) -> Isometry3<f64> {
    let rotation = Matrix3::from_fn(|r, c| m[r][c]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    Isometry3::from_parts(Translation3::from(Vector3::new(m[0][3], m[1][3], m[2][3])), rotation)
}
