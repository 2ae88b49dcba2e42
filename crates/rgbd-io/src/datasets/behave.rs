//! BEHAVE: people who carry and move things, seen by four Kinects.
//!
//! | path | what |
//! |---|---|
//! | `sequences/<seq>/t0005.000/k1.color.jpg` | colour of camera 1 |
//! | `.../k1.depth.png` | 16-bit, millimetres, registered to colour |
//! | `.../k1.obj_rend_mask.jpg`, `.../k1.person_mask.jpg` | masks of the object and of the person |
//! | `.../<object>/fit01/<object>_fit.pkl` | `angle`, `trans`: from the centred template to the world |
//! | `sequences/<seq>/info.json` | object (`cat`) and folders of the calibration |
//! | `calibs/<Date>/config/1/config.json` | camera to world: `rotation`, `translation` |
//! | `calibs/intrinsics/1/calibration.json` | `color`: `fx`, `fy`, `cx`, `cy` |
//! | `objects/<object>/<object>_f1000.ply` | the template, whose vertices' mean is the centre |
//!
//! A sequence is opened as `<seq>.<camera>`, or as `<seq>` with the camera that sees most of the object: the mask's
//! area over the area that the template would cover, on average. The colour lens' distortion is ignored.
//! Images have 2048 x 1536 pixels; a `scale_divisor` of 3 is what trackers have been run at.
//!
//! B. L. Bhatnagar et al., BEHAVE, CVPR 2022.

use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Matrix3, Translation3};
use serde::Deserialize;

use super::pickle::Pickle;
use super::sequence::{DatasetSequence, DepthCode, Frame, Model, PoseSource, finish};
use super::silhouette;
use super::{
    DatasetOptions, ModelMesh, check_name, first_file, folders, ho3d, parse_json, read_file, read_json,
    some_sequences,
};
use crate::poses::nearest_rotation;
use crate::{Error, Intrinsics, codec, listing};

const SOURCE: &str = "download BEHAVE (virtualhumans.mpi-inf.mpg.de/behave) and give the folder that holds \
    sequences/<seq>/t0005.000/k1.color.jpg, .../k1.depth.png, .../k1.obj_rend_mask.jpg, \
    .../<object>/fit01/<object>_fit.pkl, calibs/ and objects/";
const CALIBRATION_REMEDY: &str = "put calibs/<Date>/config/<camera>/config.json and calibs/intrinsics/<camera>/calibration.json of BEHAVE there";
const MODEL_REMEDY: &str = "put the objects/ of BEHAVE beside its sequences/";

const CAMERAS: usize = 4;
const MAX_FIT_BYTES: u64 = 4 << 20;
const MAX_CALIBRATION_BYTES: u64 = 4 << 20;
/// Frames whose visibility is looked at, spread over the sequence.
const LOOKS: usize = 8;
/// Side of the blocks that count as one pixel where areas are compared.
const COARSE: usize = 4;

/// Names of the sequences, without a camera.
///
/// # Errors
/// When there is none.
pub fn sequences(root: impl AsRef<Path>) -> Result<Vec<String>, Error> {
    let root = root.as_ref();
    let has_frames =
        |dir: &Path| !folders(dir, |d| (0..CAMERAS).any(|k| color_path(d, k).is_file())).is_empty();
    some_sequences(folders(&root.join("sequences"), has_frames), root, SOURCE)
}

/// Opens `<seq>.<camera>`, or `<seq>` with the camera that sees most of the object.
///
/// # Errors
/// When images, calibration or the first mask are missing or damaged.
pub fn open(root: impl AsRef<Path>, name: &str, options: &DatasetOptions) -> Result<DatasetSequence, Error> {
    let root = root.as_ref();
    check_name(root, name)?;
    let (seq, camera) = split_name(name);
    let dir = root.join("sequences").join(seq);
    if !dir.is_dir() {
        return Err(Error::new(dir, "no such folder", SOURCE));
    }
    let info = Info::read(root, &dir, seq)?;
    let (model, mesh) = model(root, &info, options)?;
    let assemble = |camera: usize| -> Result<DatasetSequence, Error> {
        let (frames, left) = (frames(&dir, &info, camera)?, camera_from_world(&info, camera)?);
        let model = Model { left, ..model.clone() };
        let divisor = options.scale_divisor.max(1);
        let name = format!("{seq}.{camera}");
        Ok(DatasetSequence { name, root: dir.clone(), frames, model, divisor, stored_size: (0, 0) })
    };
    let chosen = match camera {
        Some(camera) => assemble(camera)?,
        None => {
            let has_images = |k: &usize| !folders(&dir, |d| color_path(d, *k).is_file()).is_empty();
            most_visible((0..CAMERAS).filter(has_images).map(assemble), mesh.as_ref(), &dir)?
        }
    };
    let DatasetSequence { name, frames, model, .. } = chosen;
    finish(&name, dir, frames, model, options, SOURCE)
}

fn split_name(name: &str) -> (&str, Option<usize>) {
    match name.rsplit_once('.').map(|(seq, camera)| (seq, camera.parse::<usize>())) {
        Some((seq, Ok(camera))) if camera < CAMERAS => (seq, Some(camera)),
        _ => (name, None),
    }
}

fn color_path(dir: &Path, camera: usize) -> PathBuf {
    dir.join(format!("k{camera}.color.jpg"))
}

/// Which object, and where its sequence's calibration lies.
struct Info {
    object: String,
    config: PathBuf,
    intrinsics: PathBuf,
}

impl Info {
    fn read(root: &Path, dir: &Path, seq: &str) -> Result<Self, Error> {
        #[derive(Deserialize, Default)]
        struct File {
            cat: Option<String>,
            config: Option<String>,
            intrinsic: Option<String>,
        }
        let path = dir.join("info.json");
        let file: File = if path.is_file() { read_json(&path, SOURCE)? } else { File::default() };
        let mut parts = seq.split('_');
        let date = parts.next().unwrap_or_default();
        // Date01_Sub01_backpack_back.
        let object = file.cat.or_else(|| parts.nth(1).map(str::to_owned)).unwrap_or_default();
        check_name(&path, &object)?;
        let calibs = root.join("calibs");
        let given = |folder: Option<String>, usual: PathBuf| {
            folder.map(|f| dir.join(f)).filter(|f| f.is_dir()).unwrap_or(usual)
        };
        Ok(Self {
            config: given(file.config, calibs.join(date).join("config")),
            intrinsics: given(file.intrinsic, calibs.join("intrinsics")),
            object,
        })
    }
}

/// The frames that `camera` has.
fn frames(dir: &Path, info: &Info, camera: usize) -> Result<Vec<Frame>, Error> {
    let names = folders(dir, |d| color_path(d, camera).is_file());
    if names.is_empty() {
        return Err(Error::new(dir, format!("holds no t*/k{camera}.color.jpg"), SOURCE));
    }
    let path = info.intrinsics.join(camera.to_string()).join("calibration.json");
    let intrinsics = read_intrinsics(&path)?;
    // Some fits are named by the detector's class.
    let class = match info.object.as_str() {
        o if o.contains("chair") => "chair",
        o if o.contains("ball") => "sports ball",
        o => o,
    };
    let frame = |id: String| {
        let d = dir.join(&id);
        let mask = |kinds: &[&str]| {
            let names = kinds.iter().flat_map(|kind| ["jpg", "png"].map(|e| format!("k{camera}.{kind}.{e}")));
            first_file(names.map(|n| d.join(n)).collect())
        };
        let fits = [&info.object, class].map(|n| d.join(n).join("fit01").join(format!("{n}_fit.pkl")));
        Frame {
            color: color_path(&d, camera),
            depth: d.join(format!("k{camera}.depth.png")),
            depth_code: DepthCode::Metres(0.001),
            mask: Some(mask(&["obj_rend_mask", "obj_mask"])),
            occluder: Some(mask(&["person_mask"])),
            intrinsics,
            pose: PoseSource::File(first_file(fits.into()), |path| read_fit(path).map(Some)),
            id,
        }
    };
    Ok(names.into_iter().map(frame).collect())
}

fn read_intrinsics(path: &Path) -> Result<Intrinsics, Error> {
    let bytes = read_file(path, MAX_CALIBRATION_BYTES, CALIBRATION_REMEDY)?;
    parse_color_camera(&bytes).map_err(|problem| Error::new(path, problem, CALIBRATION_REMEDY))
}

/// Parses `calibration.json` of a Kinect: its colour camera.
///
/// # Errors
/// What is wrong with it.
pub fn parse_color_camera(bytes: &[u8]) -> Result<Intrinsics, String> {
    #[derive(Deserialize)]
    struct Color {
        fx: f64,
        fy: f64,
        cx: f64,
        cy: f64,
    }
    #[derive(Deserialize)]
    struct Calibration {
        color: Color,
    }
    let Color { fx, fy, cx, cy } = parse_json::<Calibration>(bytes)?.color;
    let camera = Intrinsics { fx, fy, cx, cy };
    if camera.is_valid() { Ok(camera) } else { Err(format!("has an unusable camera {camera:?}")) }
}

fn camera_from_world(info: &Info, camera: usize) -> Result<Isometry3<f64>, Error> {
    let path = info.config.join(camera.to_string()).join("config.json");
    let bytes = read_file(&path, MAX_CALIBRATION_BYTES, CALIBRATION_REMEDY)?;
    let pose = parse_camera_pose(&bytes).map_err(|problem| Error::new(&path, problem, CALIBRATION_REMEDY))?;
    Ok(pose.inverse())
}

/// Parses `config.json` of a Kinect: camera to world, metres; the world is the colour camera of Kinect 1.
///
/// # Errors
/// What is wrong with it.
pub fn parse_camera_pose(bytes: &[u8]) -> Result<Isometry3<f64>, String> {
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Rotation {
        Flat([f64; 9]),
        Rows([[f64; 3]; 3]),
    }
    #[derive(Deserialize)]
    struct Config {
        rotation: Rotation,
        translation: [f64; 3],
    }
    let config: Config = parse_json(bytes)?;
    let rows = match config.rotation {
        Rotation::Flat(flat) => flat,
        Rotation::Rows([[a, b, c], [d, e, f], [g, h, i]]) => [a, b, c, d, e, f, g, h, i],
    };
    let rotation = nearest_rotation(&Matrix3::from_row_slice(&rows))?;
    Ok(Isometry3::from_parts(Translation3::from(config.translation), rotation))
}

fn read_fit(path: &Path) -> Result<Isometry3<f64>, Error> {
    let bytes = read_file(path, MAX_FIT_BYTES, SOURCE)?;
    parse_fit(&bytes).map_err(|problem| Error::new(path, problem, "download this annotation of BEHAVE again"))
}

/// Parses a fit: a pickled dictionary with `angle` (axis-angle, radians) and `trans` (metres), of which no code is
/// run. Maps the centred template to the world, which is the colour camera of Kinect 1.
///
/// # Errors
/// What is wrong with it.
pub fn parse_fit(bytes: &[u8]) -> Result<Isometry3<f64>, String> {
    let pickle = Pickle::parse(bytes)?;
    let vector = |key: &str| {
        let value = pickle.get(key).ok_or_else(|| format!("has no {key}"))?;
        value.numbers::<3>().map_err(|e| format!("its {key} {e}"))
    };
    ho3d::axis_angle_pose(vector("angle")?, vector("trans")?).map_err(|e| format!("its angle {e}"))
}

/// The template, with the translation that centres it.
fn model(root: &Path, info: &Info, options: &DatasetOptions) -> Result<(Model, Option<ModelMesh>), Error> {
    let dir = options.models.clone().unwrap_or_else(|| root.join("objects")).join(&info.object);
    let simplified = if dir.is_dir() { listing::files(&dir, &["ply"])? } else { Vec::new() };
    let simplified = simplified.into_iter().find(|(stem, _)| stem.contains("_f")).map(|(_, path)| path);
    let scan = dir.join(format!("{}.obj", info.object));
    let default = if scan.is_file() { scan } else { dir.join(format!("{}_f1000.ply", info.object)) };
    let path = simplified.unwrap_or(default);
    let mut model = Model::new(Some(path.clone()), MODEL_REMEDY);
    if !path.is_file() {
        return Ok((model, None));
    }
    let mesh = ModelMesh::read(&path)?;
    if let Some([x, y, z]) = mesh.centroid() {
        model.right = Isometry3::translation(-x, -y, -z);
    }
    Ok((model, Some(mesh)))
}

/// The camera with the highest mean visibility; the first of equals. Cameras that can't be used are left out.
fn most_visible(
    cameras: impl Iterator<Item = Result<DatasetSequence, Error>>,
    mesh: Option<&ModelMesh>,
    dir: &Path,
) -> Result<DatasetSequence, Error> {
    let (mut best, mut problem) = (None::<(f64, DatasetSequence)>, None::<Error>);
    for camera in cameras {
        match camera {
            Ok(camera) => {
                let visibility = mean_visibility(&camera, mesh);
                if best.as_ref().is_none_or(|(v, _)| visibility > *v) {
                    best = Some((visibility, camera));
                }
            }
            Err(e) => {
                problem.get_or_insert(e);
            }
        }
    }
    let none = || problem.unwrap_or_else(|| Error::new(dir, "holds no frames", SOURCE));
    best.map(|(_, camera)| camera).ok_or_else(none)
}

/// Area of the mask over that of the template, on average; without a template, of the image.
fn mean_visibility(camera: &DatasetSequence, mesh: Option<&ModelMesh>) -> f64 {
    let step = camera.frames.len().div_ceil(LOOKS).max(1);
    let looked: Vec<f64> =
        camera.frames.iter().step_by(step).filter_map(|f| visibility(camera, f, mesh)).collect();
    if looked.is_empty() { 0.0 } else { looked.iter().sum::<f64>() / looked.len() as f64 }
}

/// `None` where nothing is known; 0 where a mask can't be read.
fn visibility(camera: &DatasetSequence, frame: &Frame, mesh: Option<&ModelMesh>) -> Option<f64> {
    let Ok(mask) = codec::read_mask_thresholded(frame.mask.as_ref()?) else { return Some(0.0) };
    let seen = mask.pixels().iter().filter(|v| **v != 0).count() as f64;
    let Some(mesh) = mesh else { return Some(seen / mask.pixels().len() as f64) };
    let cam_from_obj = camera.pose(frame).ok()??;
    let s = 1.0 / COARSE as f64;
    let size = (mask.width() / COARSE, mask.height() / COARSE);
    let all = silhouette::area(mesh, &cam_from_obj, &frame.intrinsics.scaled(s, s), size) * COARSE * COARSE;
    Some(if all == 0 { 0.0 } else { (seen / all as f64).min(1.0) })
}
