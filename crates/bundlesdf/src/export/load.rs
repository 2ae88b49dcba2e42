//! A run's mesh and views, read back.

use std::{fs, path::Path};

use marching_cubes::TriMesh;
use rgbd_io::Error;

use crate::{OutputFolder, texture::View};

/// Most views that are used; of more, every n-th.
const MOST_VIEWS: usize = 160;

/// Reads a finished run's mesh and keyframes (object frame, metres), refined ones if the run was refined, and the
/// keyframes' frames from the video.
///
/// # Errors
/// When a file is missing or broken, or the results don't say which video they are of.
pub fn load(folder: &OutputFolder) -> Result<(TriMesh, Vec<View>), Error> {
    let mesh = read_mesh(&folder.path().join("mesh.ply"))?;
    let keyframes = match folder.read_refined_keyframes()? {
        Some(refined) => refined,
        None => folder.read_keyframes()?,
    };
    let input = folder.read_report()?.input.ok_or_else(|| {
        let remedy = "export it from the program that fed the frames, with bundlesdf::export::build";
        Error::new(folder.path(), "doesn't say which video it was made from", remedy)
    })?;
    let source = input.open_without_masks()?;
    let step = keyframes.len().div_ceil(MOST_VIEWS).max(1);
    let views = keyframes.iter().step_by(step).map(|keyframe| {
        let frame = source.frame(keyframe.index)?;
        let obj_from_cam = keyframe.pose().map(|pose| pose.inverse()).ok_or_else(|| {
            let problem = format!("keyframe {} has a pose that isn't finite", keyframe.id);
            Error::new(folder.path(), problem, "run the video again")
        })?;
        let mask = folder.read_mask(&keyframe.id)?;
        if mask.size() != frame.color.size() {
            let path = folder.path().join("masks").join(format!("{}.png", keyframe.id));
            return Err(Error::new(&path, "hasn't the size of its frame", "run the video again"));
        }
        Ok(View { color: frame.color, depth: frame.depth, mask, intrinsics: frame.intrinsics, obj_from_cam })
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
