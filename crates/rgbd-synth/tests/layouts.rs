//! What the writers of layouts write, the readers of `rgbd-io` read; and what is damaged ends in an error.
#![allow(clippy::unwrap_used, clippy::panic, missing_docs)]

use rgbd_io::datasets::{Dataset, DatasetOptions, DatasetSequence, SequenceTruth};
use rgbd_io::{Error, FrameSource, Mask, MaskSource};
use rgbd_synth::{Sequence, write_behave, write_bop, write_custom, write_ho3d, write_tum, write_ycbineoat};
use std::fs;
use std::path::{Path, PathBuf};

/// A dataset, what writes it, and half the quantum of its depth (metres).
struct Layout {
    dataset: Dataset,
    write: fn(&Sequence, &Path) -> Result<String, Error>,
    half_quantum: f64,
    lossless_color: bool,
}

const LAYOUTS: [Layout; 6] = [
    Layout {
        dataset: Dataset::Ho3d,
        write: |s, root| write_ho3d(s, root),
        half_quantum: 0.5 * 0.000_125,
        lossless_color: false,
    },
    Layout {
        dataset: Dataset::YcbInEoat,
        write: |s, root| write_ycbineoat(s, root),
        half_quantum: 0.0005,
        lossless_color: true,
    },
    Layout {
        dataset: Dataset::Behave,
        write: |s, root| write_behave(s, root),
        half_quantum: 0.0005,
        lossless_color: false,
    },
    Layout {
        dataset: Dataset::Bop,
        write: |s, root| write_bop(s, root),
        half_quantum: 0.000_05,
        lossless_color: true,
    },
    Layout {
        dataset: Dataset::Tum,
        write: |s, root| write_tum(s, root),
        half_quantum: 0.0001,
        lossless_color: true,
    },
    Layout {
        dataset: Dataset::Custom,
        write: |s, root| write_custom(s, root.join(s.name())).map(|()| s.name().to_owned()),
        half_quantum: 0.0005,
        lossless_color: true,
    },
];

fn all_masks() -> DatasetOptions {
    DatasetOptions { masks: MaskSource::All, ..DatasetOptions::default() }
}

fn check_frames(layout: &Layout, sequence: &Sequence, read: &DatasetSequence) {
    let name = layout.dataset.name();
    assert_eq!((read.len(), read.size()), (sequence.len(), (160, 120)), "{name}");
    for i in 0..sequence.len() {
        let (expected, frame) = (sequence.render(i), read.frame(i).unwrap());
        assert_eq!(frame.id, read.id(i));
        // The custom layout's text has nine digits, the others have them all.
        let (k, e) = (frame.intrinsics, sequence.intrinsics());
        if layout.dataset == Dataset::Custom {
            assert!((k.fx - e.fx).abs() < 1e-6 && (k.cy - e.cy).abs() < 1e-6);
        } else {
            assert_eq!(k, e, "{name}");
        }
        assert_eq!(frame.mask.unwrap(), expected.visible_mask, "{name}");
        for (z, t) in frame.depth.pixels().iter().zip(expected.frame.depth.pixels()) {
            let off = f64::from(z - t).abs();
            assert!(off <= layout.half_quantum * 1.001 + 1e-7, "{name}: depth {t} came back as {z}");
        }
        let colors = frame.color.pixels().iter().zip(expected.frame.color.pixels());
        if layout.lossless_color {
            assert_eq!(frame.color, expected.frame.color, "{name}");
        } else {
            let off: u64 = colors.flat_map(|(a, b)| (0..3).map(|k| u64::from(a[k].abs_diff(b[k])))).sum();
            assert!(off < 160 * 120 * 3 * 6, "{name}: colour is off by {off} in all");
        }
    }
}

fn check_truth(name: &str, sequence: &Sequence, truth: &SequenceTruth) {
    assert_eq!(truth.cam_from_obj.len(), sequence.len());
    for (i, pose) in truth.cam_from_obj.iter().enumerate() {
        let off = pose.unwrap().to_homogeneous() - sequence.cam_from_obj(i).to_homogeneous();
        assert!(off.amax() < 1e-6, "{name}: pose {i} is off by {}", off.amax());
    }
    let (model, mesh) = (truth.read_model().unwrap().unwrap(), sequence.mesh());
    assert_eq!((model.vertices.len(), model.triangles.len()), (mesh.vertices.len(), mesh.triangles.len()));
    assert_eq!(model.triangles, mesh.triangles);
    let off =
        model.vertices.iter().zip(&mesh.vertices).flat_map(|(a, b)| (0..3).map(|k| a[k] - f64::from(b[k])));
    assert!(off.fold(0.0, |m: f64, v| m.max(v.abs())) < 1e-6, "{name}");
}

#[test]
fn every_layout_round_trips() {
    let sequence = Sequence::tiny().truncated(3);
    for layout in &LAYOUTS {
        let name = layout.dataset.name();
        let root = tempfile::tempdir().unwrap();
        let written = (layout.write)(&sequence, root.path()).unwrap();
        assert_eq!(layout.dataset.sequences(root.path()).unwrap(), [written.as_str()], "{name}");
        let read = layout.dataset.open(root.path(), &written, &all_masks()).unwrap();
        check_frames(layout, &sequence, &read);
        check_truth(name, &sequence, &read.truth().unwrap());
        assert!(read.frame(3).is_err() && read.id(3).is_empty() && read.occluder_mask(0).unwrap().is_none());

        let options = DatasetOptions { stride: 2, ..DatasetOptions::default() };
        let every_other = layout.dataset.open(root.path(), &written, &options).unwrap();
        assert_eq!((every_other.len(), every_other.id(1)), (2, read.id(2)), "{name}");
        assert!(every_other.frame(0).unwrap().mask.is_some() && every_other.frame(1).unwrap().mask.is_none());
        assert_eq!(every_other.truth().unwrap().cam_from_obj[1], read.truth().unwrap().cam_from_obj[2]);
        let without = DatasetOptions { masks: MaskSource::None, ..DatasetOptions::default() };
        assert!(
            layout.dataset.open(root.path(), &written, &without).unwrap().frame(0).unwrap().mask.is_none()
        );
    }
}

#[test]
fn smaller_images_see_the_same_points() {
    let sequence = Sequence::tiny().truncated(1);
    let root = tempfile::tempdir().unwrap();
    let name = write_ycbineoat(&sequence, root.path()).unwrap();
    let open = |scale_divisor| {
        let options = DatasetOptions { scale_divisor, ..DatasetOptions::default() };
        Dataset::YcbInEoat.open(root.path(), &name, &options)
    };
    let (full, third) = (open(1).unwrap().frame(0).unwrap(), open(3).unwrap().frame(0).unwrap());
    assert_eq!(third.color.size(), (53, 40));
    let (k, s) = (full.intrinsics, third.intrinsics);
    for (x, y) in [(0, 0), (30, 22), (52, 39)] {
        assert_eq!(third.depth[(x, y)], full.depth[(3 * x + 1, 3 * y + 1)]);
        assert_eq!(third.mask.as_ref().unwrap()[(x, y)], full.mask.as_ref().unwrap()[(3 * x + 1, 3 * y + 1)]);
        let (a, b) = (
            s.unproject(x as f64, y as f64, 1.0),
            k.unproject(3.0 * x as f64 + 1.0, 3.0 * y as f64 + 1.0, 1.0),
        );
        assert!((0..3).all(|i| (a[i] - b[i]).abs() < 1e-9));
    }
    assert!(open(1000).unwrap_err().to_string().contains("below 1000"));
}

/// Two cameras see the same images in worlds that differ; the second has half of the mask.
#[test]
fn behave_takes_the_camera_that_sees_most() {
    let sequence = Sequence::tiny().truncated(2);
    let root = tempfile::tempdir().unwrap();
    let name = write_behave(&sequence, root.path()).unwrap();
    let (dir, calibs) = (root.path().join("sequences").join(&name), root.path().join("calibs"));
    for frame in ["t0005.000", "t0006.000"].map(|f| dir.join(f)) {
        for file in ["color.jpg", "depth.png", "obj_rend_mask.jpg"] {
            fs::copy(frame.join(format!("k1.{file}")), frame.join(format!("k2.{file}"))).unwrap();
        }
        let mask = Mask::from_fn(160, 120, |x, _| if x < 80 { 255 } else { 0 });
        let grey = mask.map(|v| [*v; 3]);
        rgbd_io::write_jpeg_rgb(&frame.join("k1.person_mask.jpg"), &grey, 100).unwrap();
        let half = sequence.render(0).visible_mask;
        let half = rgbd_io::Image::from_fn(160, 120, |x, y| if x < 80 { [half[(x, y)]; 3] } else { [0; 3] });
        rgbd_io::write_jpeg_rgb(&frame.join("k2.obj_rend_mask.jpg"), &half, 100).unwrap();
    }
    fs::create_dir_all(calibs.join("Date01/config/2")).unwrap();
    fs::create_dir_all(calibs.join("intrinsics/2")).unwrap();
    fs::copy(calibs.join("intrinsics/1/calibration.json"), calibs.join("intrinsics/2/calibration.json"))
        .unwrap();
    // A quarter turn around y and a metre to the side.
    let config = r#"{"rotation": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], "translation": [1, 0, 0]}"#;
    fs::write(calibs.join("Date01/config/2/config.json"), config).unwrap();

    let chosen = Dataset::Behave.open(root.path(), &name, &all_masks()).unwrap();
    assert_eq!(chosen.name(), format!("{name}.1"));
    let person = chosen.occluder_mask(1).unwrap().unwrap();
    assert!(person[(79, 5)] == 255 && person[(80, 5)] == 0);
    let second = Dataset::Behave.open(root.path(), &format!("{name}.2"), &all_masks()).unwrap();
    let (a, b) =
        (chosen.truth().unwrap().cam_from_obj[1].unwrap(), second.truth().unwrap().cam_from_obj[1].unwrap());
    let p = nalgebra::Point3::new(0.01, 0.02, -0.03);
    let (world, local) = (a * p, b * p);
    // world = R local + t.
    assert!((world - nalgebra::Point3::new(local.z + 1.0, local.y, -local.x)).norm() < 1e-9);
}

#[test]
fn ho3d_frames_without_annotation_have_no_pose() {
    let sequence = Sequence::tiny().truncated(3);
    let root = tempfile::tempdir().unwrap();
    let name = write_ho3d(&sequence, root.path()).unwrap();
    let meta = root.path().join("evaluation").join(&name).join("meta");
    fs::remove_file(meta.join("0001.pkl")).unwrap();
    // {"camMat": <as it was>, "objRot": None, ...}: None takes the place of the arrays' keys.
    let bytes = fs::read(meta.join("0002.pkl")).unwrap();
    let at = bytes.windows(8).position(|w| w == b"objTrans").unwrap();
    let mut other = bytes.clone();
    other[at..at + 8].copy_from_slice(b"objOther");
    other.truncate(other.len() - 2);
    other.extend(b"X\x08\0\0\0objTransNu.");
    fs::write(meta.join("0002.pkl"), other).unwrap();
    let visible = root.path().join("evaluation").join(&name).join("visible_mesh.ply");
    fs::write(&visible, "ply").unwrap();
    let truth = Dataset::Ho3d.open(root.path(), &name, &all_masks()).unwrap().truth().unwrap();
    assert_eq!(truth.cam_from_obj.iter().map(Option::is_some).collect::<Vec<_>>(), [true, false, false]);
    assert_eq!(truth.visible_model, Some(visible));
}

#[test]
fn missing_data_says_where_it_comes_from() {
    let root = tempfile::tempdir().unwrap();
    for dataset in Dataset::ALL {
        for error in [
            dataset.sequences(root.path()).unwrap_err(),
            dataset.sequences(root.path().join("no")).unwrap_err(),
            dataset.open(root.path(), "x", &all_masks()).unwrap_err(),
        ] {
            let message = error.to_string();
            let says =
                message.contains("download") || message.contains("give the") || message.contains("write the");
            assert!(says && !message.contains('\n'), "{message}");
        }
        for name in ["", "..", "../x", "/etc", "a/../b", "a\\b"] {
            let message = dataset.open(root.path(), name, &all_masks()).unwrap_err().to_string();
            assert!(message.contains("no sequence called"), "{message}");
        }
    }
}

fn files_below(dir: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() { files.extend(files_below(&path)) } else { files.push(path) }
    }
    files.sort();
    files
}

/// Opens and reads everything; gives the errors.
fn read_all(dataset: Dataset, root: &Path, name: &str) -> Vec<Error> {
    let mut errors = Vec::new();
    match dataset.open(root, name, &all_masks()) {
        Err(e) => errors.push(e),
        Ok(sequence) => {
            errors.extend((0..sequence.len()).filter_map(|i| sequence.frame(i).err()));
            match sequence.truth() {
                Err(e) => errors.push(e),
                Ok(truth) => errors.extend(truth.read_model().err()),
            }
        }
    }
    errors
}

/// Truncates, empties, removes, renames and overwrites every file in turn.
#[test]
fn damaged_files_are_errors_of_one_line() {
    let sequence = Sequence::tiny().truncated(2);
    for layout in &LAYOUTS {
        let root = tempfile::tempdir().unwrap();
        let name = (layout.write)(&sequence, root.path()).unwrap();
        assert!(read_all(layout.dataset, root.path(), &name).is_empty());
        for path in files_below(root.path()) {
            let bytes = fs::read(&path).unwrap();
            let mut damaged = vec![Some(bytes[..bytes.len() / 2].to_vec()), Some(Vec::new()), None];
            let mut noise = bytes.clone();
            let mut state = 0x2545_f491_u32;
            for _ in 0..8 {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let at = (state >> 8) as usize % noise.len();
                noise[at] = state as u8;
            }
            damaged.push(Some(noise));
            for (kind, content) in damaged.into_iter().enumerate() {
                match content {
                    Some(content) => fs::write(&path, content).unwrap(),
                    None => fs::remove_file(&path).unwrap(),
                }
                let errors = read_all(layout.dataset, root.path(), &name);
                for error in &errors {
                    let message = error.to_string();
                    assert!(!message.contains('\n') && !error.remedy.is_empty(), "{message}");
                }
                // Half an image or an empty one can't go unnoticed.
                let image = path.extension().is_some_and(|e| e == "png" || e == "jpg");
                assert!(!image || kind > 1 || !errors.is_empty(), "{kind}: {}", path.display());
                fs::write(&path, &bytes).unwrap();
            }
        }
    }
}

/// Files that only claim to be large (they are sparse) are refused before they are read.
#[test]
fn oversized_files_are_refused() {
    let sequence = Sequence::tiny().truncated(1);
    for layout in &LAYOUTS {
        let root = tempfile::tempdir().unwrap();
        let name = (layout.write)(&sequence, root.path()).unwrap();
        for path in files_below(root.path()) {
            let bytes = fs::read(&path).unwrap();
            fs::OpenOptions::new().write(true).open(&path).unwrap().set_len(600 << 20).unwrap();
            let errors = read_all(layout.dataset, root.path(), &name);
            assert!(errors.iter().any(|e| e.path.ends_with(path.file_name().unwrap())), "{}", path.display());
            fs::write(&path, bytes).unwrap();
        }
    }
}

/// Set `BUNDLESDF_PYTHON` to a Python with numpy to have it load what is written.
#[test]
fn python_loads_the_pickles() {
    let Some(python) = std::env::var_os("BUNDLESDF_PYTHON") else { return };
    let sequence = Sequence::tiny().truncated(1);
    let root = tempfile::tempdir().unwrap();
    let name = write_ho3d(&sequence, root.path()).unwrap();
    let script = "import pickle, sys\nm = pickle.load(open(sys.argv[1], 'rb'))\n\
        assert m['camMat'].shape == (3, 3) and m['objRot'].shape == (3, 1) and m['objTrans'].dtype == 'float64'\n\
        print(m['camMat'][0, 0], m['objTrans'][2], m['objName'])";
    let path = root.path().join("evaluation").join(&name).join("meta/0000.pkl");
    let out = std::process::Command::new(python).args(["-c", script]).arg(path).output().unwrap();
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let words = String::from_utf8(out.stdout).unwrap();
    let words: Vec<&str> = words.split_whitespace().collect();
    assert_eq!(words[0].parse::<f64>().unwrap(), sequence.intrinsics().fx);
    let z: f64 = words[1].parse().unwrap();
    assert!((z + sequence.cam_from_obj(0).translation.z).abs() < 1e-12 && words[2] == "tiny");
}
