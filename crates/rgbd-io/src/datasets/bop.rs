//! The BOP format, in which a dozen datasets for 6-DoF pose are published.
//!
//! | path | what |
//! |---|---|
//! | `<split>/<scene>/rgb/000000.png` (or `.jpg`; or `gray/`) | colour |
//! | `<split>/<scene>/depth/000000.png` | 16-bit; `depth_scale` millimetres per unit |
//! | `<split>/<scene>/mask_visib/000000_000000.png` | visible part of an object: image, place in `scene_gt.json` |
//! | `<split>/<scene>/scene_camera.json` | `cam_K`, `depth_scale` per image |
//! | `<split>/<scene>/scene_gt.json` | `obj_id`, `cam_R_m2c`, `cam_t_m2c` (millimetres) per object of each image |
//! | `models/obj_000001.ply` | millimetres |
//! | `models/models_info.json` | `diameter`, millimetres; optional |
//!
//! Names are `<split>/<scene>`. [`DatasetOptions::object`] says which object is tracked where a scene has several;
//! of several alike the first in each image counts.
//!
//! T. Hodan et al., BOP: Benchmark for 6D Object Pose Estimation, ECCV 2018.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Matrix3, Translation3};
use serde::Deserialize;

use super::sequence::{DepthCode, Frame, Model, PoseSource, finish};
use super::{
    DatasetOptions, DatasetSequence, MAX_JSON_BYTES, check_name, first_file, folders, parse_json, read_file,
    read_json, some_sequences,
};
use crate::calibration::intrinsics_of;
use crate::poses::nearest_rotation;
use crate::{Error, Intrinsics, listing};

const SOURCE: &str = "download a dataset in BOP format (bop.felk.cvut.cz/datasets) and give the folder that holds \
    <split>/<scene>/{rgb,depth,mask_visib}/, <split>/<scene>/scene_camera.json, .../scene_gt.json and \
    models/obj_000001.ply";
const MODEL_REMEDY: &str =
    "download the dataset's models (bop.felk.cvut.cz/datasets) into models/ beside its splits";

/// The camera of one image.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct SceneCamera {
    /// The camera (`cam_K`).
    pub intrinsics: Intrinsics,
    /// Metres per unit of depth (`depth_scale`, there in millimetres).
    pub metres_per_unit: f64,
}

/// One object in one image.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct SceneObject {
    /// Number of the object (`obj_id`).
    pub object: u32,
    /// Object to camera, metres.
    pub cam_from_obj: Isometry3<f64>,
}

/// Names of the scenes, as `<split>/<scene>`.
///
/// # Errors
/// When there is none.
pub fn sequences(root: impl AsRef<Path>) -> Result<Vec<String>, Error> {
    let root = root.as_ref();
    let is_scene = |dir: &Path| dir.join("scene_camera.json").is_file();
    let mut names = folders(root, is_scene);
    for split in folders(root, |_| true) {
        names.extend(
            folders(&root.join(&split), is_scene).into_iter().map(|scene| format!("{split}/{scene}")),
        );
    }
    some_sequences(names, root, SOURCE)
}

/// Opens a scene.
///
/// # Errors
/// When images, metadata or the first mask are missing or damaged, or the scene has several objects and
/// `options.object` doesn't say which.
pub fn open(root: impl AsRef<Path>, name: &str, options: &DatasetOptions) -> Result<DatasetSequence, Error> {
    let root = root.as_ref();
    check_name(root, name)?;
    let dir = root.join(name);
    let camera_path = dir.join("scene_camera.json");
    let cameras = parse_at(&camera_path, parse_scene_camera)?;
    let gt_path = dir.join("scene_gt.json");
    let truth = parse_at(&gt_path, parse_scene_gt)?;
    let object = choose_object(&gt_path, &truth, options.object)?;
    let mut frames = Vec::new();
    for (id, color) in list_images(&dir)? {
        let number: Option<u32> = id.parse().ok();
        let camera = number.and_then(|n| cameras.get(&n)).ok_or_else(|| {
            Error::new(&camera_path, format!("has no camera for {}", color.display()), SOURCE)
        })?;
        let objects = number.and_then(|n| truth.get(&n)).map_or(&[] as &[SceneObject], Vec::as_slice);
        let place = objects.iter().enumerate().find(|(_, o)| o.object == object);
        frames.push(Frame {
            color,
            depth: dir.join("depth").join(format!("{id}.png")),
            depth_code: DepthCode::Metres(camera.metres_per_unit),
            mask: place.map(|(place, _)| dir.join("mask_visib").join(format!("{id}_{place:06}.png"))),
            occluder: None,
            intrinsics: camera.intrinsics,
            pose: place.map_or(PoseSource::Unknown, |(_, o)| PoseSource::Known(o.cam_from_obj)),
            id,
        });
    }
    let model = model(root, object, options)?;
    finish(name, dir, frames, model, options, SOURCE)
}

fn parse_at<T>(path: &Path, parse: fn(&[u8]) -> Result<T, String>) -> Result<T, Error> {
    let bytes = read_file(path, MAX_JSON_BYTES, SOURCE)?;
    parse(&bytes).map_err(|problem| Error::new(path, problem, SOURCE))
}

fn list_images(dir: &Path) -> Result<Vec<(String, PathBuf)>, Error> {
    let folder = if dir.join("rgb").is_dir() { dir.join("rgb") } else { dir.join("gray") };
    if !folder.is_dir() {
        return Err(Error::new(dir.join("rgb"), "no such folder", SOURCE));
    }
    listing::files(&folder, &["png", "jpg", "jpeg"])
}

fn choose_object(
    path: &Path,
    truth: &BTreeMap<u32, Vec<SceneObject>>,
    wanted: Option<u32>,
) -> Result<u32, Error> {
    let objects: BTreeSet<u32> = truth.values().flatten().map(|o| o.object).collect();
    let numbers: Vec<String> = objects.iter().take(50).map(u32::to_string).collect();
    let choose = |problem: String| {
        Err(Error::new(path, problem, format!("choose one of the objects {}", numbers.join(", "))))
    };
    match (wanted, objects.first(), objects.len()) {
        (_, None, _) => Err(Error::new(path, "lists no object", SOURCE)),
        (Some(wanted), ..) if objects.contains(&wanted) => Ok(wanted),
        (Some(wanted), ..) => choose(format!("has no object {wanted}")),
        (None, Some(only), 1) => Ok(*only),
        (None, _, n) => choose(format!("has {n} objects")),
    }
}

fn model(root: &Path, object: u32, options: &DatasetOptions) -> Result<Model, Error> {
    #[derive(Deserialize)]
    struct ModelInfo {
        diameter: Option<f64>,
    }
    let file = format!("obj_{object:06}.ply");
    let path = match &options.models {
        Some(models) => models.join(file),
        None => first_file(["models", "models_eval", "../models"].map(|m| root.join(m).join(&file)).into()),
    };
    let info = path.with_file_name("models_info.json");
    let mut model = Model { scale: 0.001, ..Model::new(Some(path), MODEL_REMEDY) };
    if info.is_file() {
        let models: BTreeMap<u32, ModelInfo> = read_json(&info, MODEL_REMEDY)?;
        model.diameter = models.get(&object).and_then(|m| m.diameter).map(|mm| 0.001 * mm);
    }
    Ok(model)
}

/// Parses `scene_camera.json`: the cameras by the images' numbers.
///
/// # Errors
/// What is wrong with it.
pub fn parse_scene_camera(bytes: &[u8]) -> Result<BTreeMap<u32, SceneCamera>, String> {
    #[derive(Deserialize)]
    #[allow(non_snake_case)]
    struct Entry {
        cam_K: [f64; 9],
        #[serde(default = "millimetres")]
        depth_scale: f64,
    }
    fn millimetres() -> f64 {
        1.0
    }
    let entries: BTreeMap<u32, Entry> = parse_json(bytes)?;
    let camera = |(image, entry): (u32, Entry)| {
        let intrinsics =
            intrinsics_of(&entry.cam_K).map_err(|e| format!("its cam_K of image {image} {}", e.problem))?;
        if !(entry.depth_scale.is_finite() && entry.depth_scale > 0.0) {
            return Err(format!("has a depth_scale of {} for image {image}", entry.depth_scale));
        }
        Ok((image, SceneCamera { intrinsics, metres_per_unit: 0.001 * entry.depth_scale }))
    };
    entries.into_iter().map(camera).collect()
}

/// Parses `scene_gt.json`: the objects in each image, by the images' numbers.
///
/// # Errors
/// What is wrong with it.
pub fn parse_scene_gt(bytes: &[u8]) -> Result<BTreeMap<u32, Vec<SceneObject>>, String> {
    #[derive(Deserialize)]
    #[allow(non_snake_case)]
    struct Entry {
        cam_R_m2c: [f64; 9],
        cam_t_m2c: [f64; 3],
        obj_id: u32,
    }
    let entries: BTreeMap<u32, Vec<Entry>> = parse_json(bytes)?;
    let object = |image: u32, e: &Entry| {
        let rotation = nearest_rotation(&Matrix3::from_row_slice(&e.cam_R_m2c))
            .map_err(|problem| format!("{problem} for object {} of image {image}", e.obj_id))?;
        let translation = Translation3::from(e.cam_t_m2c.map(|mm| 0.001 * mm));
        Ok(SceneObject { object: e.obj_id, cam_from_obj: Isometry3::from_parts(translation, rotation) })
    };
    let scene = |(image, list): (u32, Vec<Entry>)| {
        let objects: Result<Vec<SceneObject>, String> = list.iter().map(|e| object(image, e)).collect();
        Ok((image, objects?))
    };
    entries.into_iter().map(scene).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const CAMERA: &str =
        r#"{"3": {"cam_K": [572.4, 0, 325.3, 0, 573.6, 242.0, 0, 0, 1], "depth_scale": 0.1, "view": 1}}"#;
    const TRUTH: &str = r#"{"0": [{"cam_R_m2c": [0, -1, 0, 1, 0, 0, 0, 0, 1], "cam_t_m2c": [100, -20, 800], "obj_id": 5},
        {"cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, 1], "cam_t_m2c": [0, 0, 1], "obj_id": 7}], "12": []}"#;

    #[test]
    fn json_that_is_nested_without_end_is_an_error() {
        for text in
            ["[".repeat(1 << 20), "{\"0\":".repeat(1 << 18), format!("{{\"0\": {}", "[".repeat(1 << 20))]
        {
            assert!(parse_scene_camera(text.as_bytes()).is_err() && parse_scene_gt(text.as_bytes()).is_err());
        }
    }

    #[test]
    fn metadata_is_converted_to_metres() {
        let cameras = parse_scene_camera(CAMERA.as_bytes()).unwrap();
        assert_eq!(cameras[&3].intrinsics, Intrinsics { fx: 572.4, fy: 573.6, cx: 325.3, cy: 242.0 });
        assert!((cameras[&3].metres_per_unit - 1e-4).abs() < 1e-18);
        let truth = parse_scene_gt(TRUTH.as_bytes()).unwrap();
        let first = truth[&0][0];
        assert_eq!((first.object, truth[&0].len(), truth[&12].len()), (5, 2, 0));
        // A quarter turn around z.
        let p = first.cam_from_obj * nalgebra::Point3::new(1.0, 0.0, 0.0);
        assert!((p - nalgebra::Point3::new(0.1, 0.98, 0.8)).norm() < 1e-12);
    }

    #[test]
    fn the_object_must_be_chosen_among_several() {
        let truth = parse_scene_gt(TRUTH.as_bytes()).unwrap();
        let path = Path::new("scene_gt.json");
        assert_eq!(choose_object(path, &truth, Some(7)).unwrap(), 7);
        for wanted in [None, Some(6)] {
            let message = choose_object(path, &truth, wanted).unwrap_err().to_string();
            assert!(message.contains("choose one of the objects 5, 7"), "{message}");
        }
        let one = BTreeMap::from([(0, vec![truth[&0][1]])]);
        assert_eq!(choose_object(path, &one, None).unwrap(), 7);
    }

    #[test]
    fn damaged_metadata_is_an_error() {
        let deep = "[".repeat(1 << 20);
        for text in [
            "",
            "{",
            "[]",
            r#"{"x": {}}"#,
            r#"{"0": {"cam_K": [1, 2]}}"#,
            &deep,
            &CAMERA.replace("0.1", "-1"),
        ] {
            assert!(parse_scene_camera(text.as_bytes()).is_err());
        }
        for text in [
            &deep,
            &TRUTH.replace("-1", "-2"),
            &TRUTH.replace("800", "1e999"),
            &TRUTH.replace("800]", "8, 8]"),
        ] {
            assert!(parse_scene_gt(text.as_bytes()).is_err());
        }
    }

    proptest! {
        #[test]
        fn mutations_are_survived(at: prop::sample::Index, value: u8) {
            for text in [CAMERA, TRUTH] {
                let mut bytes = text.as_bytes().to_vec();
                let at = at.index(bytes.len());
                bytes[at] = value;
                let _ = (parse_scene_camera(&bytes), parse_scene_gt(&bytes));
            }
        }
    }
}
