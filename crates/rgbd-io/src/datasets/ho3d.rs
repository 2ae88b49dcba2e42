//! HO-3D version 3: hands that turn YCB objects in front of a depth camera.
//!
//! | path | what |
//! |---|---|
//! | `evaluation/<SEQ>/rgb/0000.jpg` | colour |
//! | `evaluation/<SEQ>/depth/0000.png` | depth in two channels of a colour image, see [`decode_depth`] |
//! | `evaluation/<SEQ>/meta/0000.pkl` | camera and pose, see [`parse_meta`] |
//! | `evaluation/<SEQ>/visible_mesh.ply` | the part of the surface that is ever seen; optional |
//! | `models/<object>/textured_simple.obj` | YCB-Video models |
//! | `masks_XMem/<SEQ>/00000.png` | masks of the object, five digits |
//! | `masks_XMem/<SEQ>_hand/0000.png` | masks of the hand, four digits; optional |
//!
//! S. Hampali et al., HOnnotate, CVPR 2020.

use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};

use super::pickle::Pickle;
use super::sequence::{DepthCode, Frame, Model, PoseSource, finish};
use super::{DatasetOptions, DatasetSequence, check_name, folders, read_file, some_sequences};
use crate::calibration::intrinsics_of;
use crate::{Error, Image, Intrinsics, listing};

const SOURCE: &str = "download HO3D_v3 (linked from github.com/shreyashampali/ho3d) and give the folder that holds \
    evaluation/<SEQ>/rgb/0000.jpg, .../depth/0000.png, .../meta/0000.pkl, models/<object>/textured_simple.obj (the \
    YCB-Video 3D models) and masks_XMem/<SEQ>/00000.png";
const META_REMEDY: &str = "download HO3D_v3 again, this annotation is damaged";
const MODEL_REMEDY: &str =
    "put the YCB-Video 3D models (linked from rse-lab.cs.washington.edu/projects/posecnn) into models/";

/// Metres per unit of depth.
const METRES_PER_UNIT: f64 = 0.00012498664727900177;

const MAX_META_BYTES: u64 = 4 << 20;

/// The evaluation sequences' objects, by the letters of their names.
const OBJECTS: [(&str, &str); 4] = [
    ("AP", "019_pitcher_base"),
    ("MPM", "010_potted_meat_can"),
    ("SB", "021_bleach_cleanser"),
    ("SM", "006_mustard_bottle"),
];

/// Names of the sequences in `evaluation/`.
///
/// # Errors
/// When there is none.
pub fn sequences(root: impl AsRef<Path>) -> Result<Vec<String>, Error> {
    let root = root.as_ref();
    let names =
        folders(&root.join("evaluation"), |dir| dir.join("rgb").is_dir() && dir.join("meta").is_dir());
    some_sequences(names, root, SOURCE)
}

/// Opens `evaluation/<name>`, or `train/<name>`. The camera is that of the first frame.
///
/// # Errors
/// When images, the first annotation or the first mask are missing or damaged.
pub fn open(root: impl AsRef<Path>, name: &str, options: &DatasetOptions) -> Result<DatasetSequence, Error> {
    let root = root.as_ref();
    check_name(root, name)?;
    let dir = ["evaluation", "train"].map(|split| root.join(split).join(name));
    let [evaluation, train] = dir;
    let dir = if !evaluation.is_dir() && train.is_dir() { train } else { evaluation };
    let colors = list(&dir.join("rgb"))?;
    let meta_path = |id: &str| dir.join("meta").join(format!("{id}.pkl"));
    let first = colors.first().map(|(id, _)| id.as_str()).unwrap_or_default();
    let meta = read_meta(&meta_path(first))?;
    let masks = root.join("masks_XMem");
    let frames = colors.iter().map(|(id, color)| Frame {
        id: id.clone(),
        color: color.clone(),
        depth: dir.join("depth").join(format!("{id}.png")),
        depth_code: DepthCode::Ho3d,
        mask: Some(masks.join(name).join(format!("{id:0>5}.png"))),
        occluder: Some(masks.join(format!("{name}_hand")).join(format!("{id}.png"))),
        intrinsics: meta.intrinsics,
        pose: PoseSource::File(meta_path(id), |path| Ok(read_meta(path)?.cam_from_obj)),
    });
    let object = object_of(name).map(str::to_owned).or(meta.object).unwrap_or_else(|| name.to_owned());
    let models = options.models.clone().unwrap_or_else(|| root.join("models"));
    let mut model = Model::new(Some(models.join(object).join("textured_simple.obj")), MODEL_REMEDY);
    model.visible = Some(dir.join("visible_mesh.ply")).filter(|p| p.is_file());
    finish(name, dir.clone(), frames.collect(), model, options, SOURCE)
}

/// The YCB object of an evaluation sequence such as `AP10`.
pub fn object_of(sequence: &str) -> Option<&'static str> {
    let letters = sequence.trim_end_matches(|c: char| c.is_ascii_digit());
    let numbered = letters.len() < sequence.len();
    OBJECTS.iter().find(|(l, _)| numbered && *l == letters).map(|(_, object)| *object)
}

fn list(dir: &Path) -> Result<Vec<(String, PathBuf)>, Error> {
    if !dir.is_dir() {
        return Err(Error::new(dir, "no such folder", SOURCE));
    }
    let files = listing::files(dir, &["jpg", "jpeg", "png"])?;
    if files.is_empty() { Err(Error::new(dir, "holds no images", SOURCE)) } else { Ok(files) }
}

/// What an annotation says.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Meta {
    /// The camera (`camMat`).
    pub intrinsics: Intrinsics,
    /// Name of the YCB object (`objName`), if it is a plain name.
    pub object: Option<String>,
    /// Object to camera, OpenCV, metres (`objRot`, `objTrans`); `None` where a frame isn't annotated.
    pub cam_from_obj: Option<Isometry3<f64>>,
}

fn read_meta(path: &Path) -> Result<Meta, Error> {
    let bytes = read_file(path, MAX_META_BYTES, SOURCE)?;
    parse_meta(&bytes).map_err(|problem| Error::new(path, problem, META_REMEDY))
}

/// Parses an annotation: a pickled dictionary, of which no code is run.
///
/// # Errors
/// What is wrong with it.
pub fn parse_meta(bytes: &[u8]) -> Result<Meta, String> {
    let pickle = Pickle::parse(bytes)?;
    let matrix =
        pickle.get("camMat").ok_or("has no camMat")?.numbers::<9>().map_err(|e| format!("its camMat {e}"))?;
    let intrinsics = intrinsics_of(&matrix).map_err(|e| format!("its camMat {}", e.problem))?;
    let vector = |key: &str| match pickle.get(key) {
        None => Ok(None),
        Some(value) if value.is_none() => Ok(None),
        Some(value) => value.numbers::<3>().map(Some).map_err(|e| format!("its {key} {e}")),
    };
    let cam_from_obj = match (vector("objRot")?, vector("objTrans")?) {
        (Some(r), Some(t)) => {
            Some(flip_camera(&axis_angle_pose(r, t).map_err(|e| format!("its objRot {e}"))?))
        }
        _ => None,
    };
    let plain = |name: &String| {
        !name.is_empty()
            && name.len() < 100
            && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-')
    };
    let object = pickle.get("objName").and_then(|v| v.text()).filter(plain);
    Ok(Meta { intrinsics, object, cam_from_obj })
}

/// The pose of an axis-angle vector (radians) and a translation (metres).
pub(super) fn axis_angle_pose(r: [f64; 3], t: [f64; 3]) -> Result<Isometry3<f64>, String> {
    /// Radians. Annotations stay below one turn, or a few; the sine of a larger number is noise.
    const MOST: f64 = 1e6;
    if r.iter().any(|v| v.abs() > MOST) {
        return Err(format!("turns by more than {MOST} radians"));
    }
    let rotation = UnitQuaternion::from_scaled_axis(Vector3::from(r));
    Ok(Isometry3::from_parts(Translation3::from(t), rotation))
}

/// A pose in the other of the two usual cameras: OpenGL (y up, looking along -z) and OpenCV (y down, along +z).
/// Twice is once not at all.
pub fn flip_camera(cam_from_obj: &Isometry3<f64>) -> Isometry3<f64> {
    // Half a turn around x, exactly.
    let half_turn = UnitQuaternion::new_unchecked(Quaternion::new(0.0, 1.0, 0.0, 0.0));
    let t = cam_from_obj.translation.vector;
    Isometry3::from_parts(Translation3::new(t.x, -t.y, -t.z), half_turn * cam_from_obj.rotation)
}

/// Depth in metres from the RGB channels of a depth image: `(R + 256 G) * 0.000125`, nearly; `0` = missing.
pub fn decode_depth(rgb: &Image<[u8; 3]>) -> Image<f32> {
    rgb.map(|[r, g, _]| ((f64::from(*r) + 256.0 * f64::from(*g)) * METRES_PER_UNIT) as f32)
}

/// The inverse of [`decode_depth`], up to rounding; what isn't finite, positive or within 8.19 m becomes missing.
pub fn encode_depth(depth: &Image<f32>) -> Image<[u8; 3]> {
    depth.map(|z| {
        let units = (f64::from(*z) / METRES_PER_UNIT).round();
        let units = if (1.0..=65535.0).contains(&units) { units as u16 } else { 0 };
        let [r, g] = units.to_le_bytes();
        [r, g, 0]
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn depth_is_decoded_without_overflow() {
        let rgb = Image::from_vec(3, 1, vec![[0, 0, 9], [200, 15, 0], [255, 255, 255]]).unwrap();
        let expected = [0.0, 4040.0 * 0.00012498664727900177, 65535.0 * 0.00012498664727900177];
        for (z, e) in decode_depth(&rgb).pixels().iter().zip(expected) {
            assert_eq!(*z, e as f32);
        }
        assert_eq!(encode_depth(&decode_depth(&rgb)).pixels()[1], [200, 15, 0]);
        let odd = Image::from_vec(4, 1, vec![f32::NAN, -1.0, f32::INFINITY, 9.0]).unwrap();
        assert!(encode_depth(&odd).pixels().iter().all(|p| *p == [0; 3]));
    }

    #[test]
    fn reads_an_annotation() {
        let meta = parse_meta(include_bytes!("../../tests/data/py2_protocol2.pkl")).unwrap();
        assert_eq!(meta.intrinsics, Intrinsics { fx: 614.627, fy: 614.101, cx: 320.262, cy: 238.469 });
        assert_eq!(meta.object.as_deref(), Some("019_pitcher_base"));
        // Rodrigues' formula for (0.5, -1.25, 2), the last two rows and translations negated.
        let pose = meta.cam_from_obj.unwrap();
        assert_eq!(pose.translation.vector, Vector3::new(0.0625, 0.03125, 0.5));
        let axis = Vector3::new(0.5_f64, -1.25, 2.0);
        let angle = axis.norm();
        let k = (axis / angle).cross_matrix();
        let gl = nalgebra::Matrix3::identity() + k * angle.sin() + k * k * (1.0 - angle.cos());
        let cv = nalgebra::Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, -1.0)) * gl;
        assert!((pose.rotation.to_rotation_matrix().matrix() - cv).amax() < 1e-12);
    }

    #[test]
    fn unusable_annotations_are_errors() {
        for (bytes, word) in [
            (&b"}."[..], "camMat"),
            (b"}U\x06camMatK\x01s.", "1 numbers"),
            (b"]", "truncated"),
            (b"].", "dictionary"),
        ] {
            let message = parse_meta(bytes).unwrap_err();
            assert!(message.contains(word), "{message}");
        }
    }

    #[test]
    fn a_turn_beyond_all_numbers_is_an_error() {
        let meta = |turn: &str| {
            let text = format!(
                "(dS'camMat'\n(lF9\naF0\naF3\naF0\naF9\naF3\naF0\naF0\naF1\nasS'objRot'\n(lF{turn}\naF0\naF0\nasS'objTrans'\n(lF0\naF0\naF0\nas."
            );
            parse_meta(text.as_bytes())
        };
        assert!(meta("0.5").unwrap().cam_from_obj.is_some());
        for turn in ["1e200", "-1e308", "1e7"] {
            assert!(meta(turn).unwrap_err().contains("objRot"), "{turn}");
        }
    }

    #[test]
    fn names_tell_objects() {
        assert_eq!(object_of("AP10"), Some("019_pitcher_base"));
        assert_eq!(object_of("MPM14"), Some("010_potted_meat_can"));
        assert_eq!(object_of("SB11"), Some("021_bleach_cleanser"));
        assert_eq!(object_of("SM1"), Some("006_mustard_bottle"));
        assert_eq!((object_of("AP"), object_of("tiny"), object_of("")), (None, None, None));
    }

    proptest! {
        #[test]
        fn flipping_twice_is_the_identity(r in prop::array::uniform3(-3.0..3.0), t in prop::array::uniform3(-2.0..2.0)) {
            let pose = axis_angle_pose(r, t).unwrap();
            let flipped = flip_camera(&pose);
            let m = flipped.to_homogeneous();
            let expected = nalgebra::Matrix4::from_diagonal(&nalgebra::Vector4::new(1.0, -1.0, -1.0, 1.0))
                * pose.to_homogeneous();
            prop_assert!((m - expected).amax() < 1e-12);
            prop_assert!((flip_camera(&flipped).to_homogeneous() - pose.to_homogeneous()).amax() < 1e-15);
        }

        #[test]
        fn depth_survives_to_its_quantum(z in 0.001_f32..8.0) {
            let image = Image::filled(1, 1, z);
            let back = decode_depth(&encode_depth(&image))[(0, 0)];
            prop_assert!((back - z).abs() <= 0.5001 * METRES_PER_UNIT as f32);
        }
    }
}
