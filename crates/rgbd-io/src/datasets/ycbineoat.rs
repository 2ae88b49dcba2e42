//! YCBInEOAT: YCB objects in a robot's end effector.
//!
//! | path | what |
//! |---|---|
//! | `<video>/rgb/*.png` | colour |
//! | `<video>/depth/<same name>.png` | 16-bit, millimetres |
//! | `<video>/masks/<same name>.png` | the object; `gt_mask/` is accepted too |
//! | `<video>/annotated_poses/*.txt` | object to camera, 4x4, metres; in the order of the images |
//! | `<video>/cam_K.txt` | camera matrix; `fx` and `fy` differ |
//! | `models/<object>/textured_simple.obj` | YCB models; `textured.obj`, `points.xyz` and `CADmodels/` are accepted too |
//!
//! B. Wen et al., se(3)-TrackNet, IROS 2020.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::sequence::{DepthCode, Frame, Model, PoseSource, finish};
use super::{DatasetOptions, DatasetSequence, check_name, first_file, folders, some_sequences};
use crate::{Error, listing, poses, read_intrinsics};

const SOURCE: &str = "download YCBInEOAT (linked from github.com/wenbowen123/iros20-6d-pose-tracking) and give the \
    folder that holds <video>/rgb/*.png, <video>/depth/*.png, <video>/masks/*.png (or gt_mask/), \
    <video>/annotated_poses/*.txt and <video>/cam_K.txt";
const MODEL_REMEDY: &str = "put the YCB-Video 3D models (linked from rse-lab.cs.washington.edu/projects/posecnn) into \
    models/ beside the videos, or name their folder";

/// The videos' objects, by the beginnings of their names.
const OBJECTS: [(&str, &str); 5] = [
    ("bleach", "021_bleach_cleanser"),
    ("cracker", "003_cracker_box"),
    ("mustard", "006_mustard_bottle"),
    ("sugar", "004_sugar_box"),
    ("tomato", "005_tomato_soup_can"),
];

/// Names of the videos.
///
/// # Errors
/// When there is none.
pub fn sequences(root: impl AsRef<Path>) -> Result<Vec<String>, Error> {
    let root = root.as_ref();
    let names = folders(root, |dir| dir.join("rgb").is_dir() && dir.join("annotated_poses").is_dir());
    some_sequences(names, root, SOURCE)
}

/// The YCB object of a video such as `mustard0`.
pub fn object_of(video: &str) -> Option<&'static str> {
    OBJECTS.iter().find(|(start, _)| video.starts_with(start)).map(|(_, object)| *object)
}

/// Opens a video.
///
/// # Errors
/// When images, the camera or the first mask are missing or damaged.
pub fn open(root: impl AsRef<Path>, name: &str, options: &DatasetOptions) -> Result<DatasetSequence, Error> {
    let root = root.as_ref();
    check_name(root, name)?;
    let dir = root.join(name);
    let rgb = dir.join("rgb");
    if !rgb.is_dir() {
        return Err(Error::new(rgb, "no such folder", SOURCE));
    }
    let colors = listing::files(&rgb, &["png", "jpg", "jpeg"])?;
    let intrinsics = read_intrinsics(&dir.join("cam_K.txt"))?;
    let mut poses = annotations(&dir, &colors)?;
    let masks = if dir.join("masks").is_dir() { dir.join("masks") } else { dir.join("gt_mask") };
    let frames = colors.into_iter().enumerate().map(|(index, (id, color))| Frame {
        color,
        depth: dir.join("depth").join(format!("{id}.png")),
        depth_code: DepthCode::Metres(0.001),
        mask: Some(masks.join(format!("{id}.png"))),
        occluder: None,
        intrinsics,
        pose: poses.remove(&index).map_or(PoseSource::Unknown, |path| {
            PoseSource::File(path, |path| poses::read_pose(path).map(Some))
        }),
        id,
    });
    let frames: Vec<Frame> = frames.collect();
    let model = Model::new(Some(model_file(root, name, options)), MODEL_REMEDY);
    finish(name, dir, frames, model, options, SOURCE)
}

/// The pose file of each image: that of its name, or, where no name agrees, the one at its place in the order.
fn annotations(dir: &Path, colors: &[(String, PathBuf)]) -> Result<HashMap<usize, PathBuf>, Error> {
    let dir = dir.join("annotated_poses");
    if !dir.is_dir() {
        return Ok(HashMap::new());
    }
    let files = listing::files(&dir, &["txt"])?;
    let index_of: HashMap<&str, usize> =
        colors.iter().enumerate().map(|(i, (id, _))| (id.as_str(), i)).collect();
    if files.iter().any(|(stem, _)| index_of.contains_key(stem.as_str())) {
        return Ok(files
            .into_iter()
            .filter_map(|(stem, path)| Some((*index_of.get(stem.as_str())?, path)))
            .collect());
    }
    Ok(files.into_iter().map(|(_, path)| path).enumerate().collect())
}

fn model_file(root: &Path, name: &str, options: &DatasetOptions) -> PathBuf {
    let object = object_of(name).unwrap_or(name);
    let folders = match &options.models {
        Some(models) => vec![models.clone()],
        None => vec![root.join("models"), root.join("CADmodels"), root.join("../models")],
    };
    let files = ["textured_simple.obj", "textured.obj", "points.xyz"];
    first_file(folders.iter().flat_map(|f| files.map(|file| f.join(object).join(file))).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_tell_objects() {
        for (video, object) in [
            ("bleach_hard_00_03_chaitanya", "021_bleach_cleanser"),
            ("cracker_box_yalehand0", "003_cracker_box"),
            ("mustard_easy_00_02", "006_mustard_bottle"),
            ("sugar_box1", "004_sugar_box"),
            ("tomato_soup_can_yalehand0", "005_tomato_soup_can"),
        ] {
            assert_eq!(object_of(video), Some(object));
        }
        assert_eq!(object_of("tiny"), None);
    }

    /// Images are named by time stamps and annotations by numbers in the published videos.
    #[test]
    fn poses_go_by_name_or_by_order() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("annotated_poses");
        std::fs::create_dir(&folder).unwrap();
        for name in ["0000000.txt", "0000001.txt"] {
            std::fs::write(folder.join(name), "").unwrap();
        }
        let color = |id: &str| (id.to_owned(), PathBuf::new());
        let by_order =
            annotations(dir.path(), &[color("1581120424100262102"), color("1581120424148532296")]).unwrap();
        assert!(by_order[&0].ends_with("0000000.txt") && by_order[&1].ends_with("0000001.txt"));
        let by_name = annotations(dir.path(), &[color("0000001"), color("0000002")]).unwrap();
        assert!(by_name[&0].ends_with("0000001.txt") && !by_name.contains_key(&1));
    }
}
