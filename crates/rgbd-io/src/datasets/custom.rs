//! One's own folders (see [`crate::CustomFolder`]), with truth beside the images.
//!
//! | path | what |
//! |---|---|
//! | `<seq>/rgb/`, `depth/`, `masks/`, `cam_K.txt` | see [`crate::CustomFolder`] |
//! | `<seq>/gt_poses/<same name>.txt` | object to camera, 4x4, metres; optional for each frame |
//! | `<seq>/mesh/*.obj` | the object, metres; the first by name |

use std::path::{Path, PathBuf};

use super::sequence::{DepthCode, Frame, Model, PoseSource, finish};
use super::{DatasetOptions, DatasetSequence, SequenceTruth, check_name, folders, some_sequences};
use crate::{CustomFolder, Error, FrameSource, listing, poses, read_intrinsics};

const SOURCE: &str = "give the folder that holds <seq>/rgb/0000.png, <seq>/depth/0000.png, <seq>/masks/0000.png and \
    <seq>/cam_K.txt";
const MODEL_REMEDY: &str = "put the object's mesh there as an .obj in metres, in the frame of the true poses";

/// Names of the folders with images and a camera.
///
/// # Errors
/// When there is none.
pub fn sequences(root: impl AsRef<Path>) -> Result<Vec<String>, Error> {
    let root = root.as_ref();
    some_sequences(folders(root, |d| d.join("rgb").is_dir() && d.join("cam_K.txt").is_file()), root, SOURCE)
}

/// Opens the folder `name`.
///
/// # Errors
/// When images, the camera or the first mask are missing or damaged.
pub fn open(root: impl AsRef<Path>, name: &str, options: &DatasetOptions) -> Result<DatasetSequence, Error> {
    let root = root.as_ref();
    check_name(root, name)?;
    let dir = root.join(name);
    if !dir.join("rgb").is_dir() {
        return Err(Error::new(dir.join("rgb"), "no such folder", SOURCE));
    }
    let intrinsics = read_intrinsics(&dir.join("cam_K.txt"))?;
    let frames =
        listing::files(&dir.join("rgb"), &["png", "jpg", "jpeg"])?.into_iter().map(|(id, color)| Frame {
            color,
            depth: dir.join("depth").join(format!("{id}.png")),
            depth_code: DepthCode::Metres(0.001),
            mask: Some(dir.join("masks").join(format!("{id}.png"))),
            occluder: None,
            intrinsics,
            pose: PoseSource::File(pose_file(&dir, &id), |path| poses::read_pose(path).map(Some)),
            id,
        });
    let frames: Vec<Frame> = frames.collect();
    let model = Model::new(Some(model_file(&dir)), MODEL_REMEDY);
    finish(name, dir, frames, model, options, SOURCE)
}

/// The truth beside an open folder, for its frames.
///
/// # Errors
/// When a pose is damaged or there is no mesh.
pub fn truth(folder: &CustomFolder) -> Result<SequenceTruth, Error> {
    let dir = folder.path();
    let pose = |id: &str| {
        let path = pose_file(dir, id);
        path.exists().then(|| poses::read_pose(&path)).transpose()
    };
    let model = model_file(dir);
    if !model.is_file() {
        return Err(Error::new(model, "is missing: the object's model", MODEL_REMEDY));
    }
    let cam_from_obj: Result<Vec<_>, Error> = (0..folder.len()).map(|i| pose(folder.id(i))).collect();
    Ok(SequenceTruth {
        cam_from_obj: cam_from_obj?,
        model: Some(model),
        model_scale: 1.0,
        visible_model: None,
        diameter: None,
    })
}

fn pose_file(dir: &Path, id: &str) -> PathBuf {
    dir.join("gt_poses").join(format!("{id}.txt"))
}

fn model_file(dir: &Path) -> PathBuf {
    mesh_file(dir).unwrap_or_else(|| dir.join("mesh").join("model.obj"))
}

/// The first `mesh/*.obj`.
pub(super) fn mesh_file(dir: &Path) -> Option<PathBuf> {
    listing::files(&dir.join("mesh"), &["obj"]).ok()?.into_iter().next().map(|(_, path)| path)
}
