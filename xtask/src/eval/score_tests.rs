use super::super::benchmark::Benchmark;
use super::super::method::Method;
use super::*;
use nalgebra::{Point3, Vector3};
use rgbd_io::{CustomWriter, Image, Intrinsics, poses::format_pose, write_png_mask};
use std::fs;

const FRAMES: usize = 10;
/// A cube of 8 cm edge, counter-clockwise squares.
const FACES: [[usize; 4]; 6] =
    [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];

fn corners() -> [[f64; 3]; 8] {
    std::array::from_fn(|i| [4, 2, 1].map(|bit| if i & bit == 0 { -0.04 } else { 0.04 }))
}

fn cam_from_obj(i: usize) -> Isometry3<f64> {
    Isometry3::new(Vector3::new(0.0, 0.0, 0.5), Vector3::new(0.6, 0.25 * i as f64, 0.0))
}

/// Somewhere the tracker could have put its object frame.
fn gt_from_pred() -> Isometry3<f64> {
    Isometry3::new(Vector3::new(0.1, -0.05, 0.02), Vector3::new(0.3, 1.0, -0.5))
}

/// The left `columns` of an image.
fn mask(columns: usize) -> Image<u8> {
    Image::from_fn(160, 120, |x, _| if x < columns { 255 } else { 0 })
}

fn sequence(root: &Path) -> Asked {
    let dir = root.join("cube");
    let camera = Intrinsics { fx: 300.0, fy: 320.0, cx: 79.5, cy: 59.5 };
    let writer = CustomWriter::create(&dir, &camera).unwrap();
    for folder in ["gt_poses", "mesh"] {
        fs::create_dir_all(dir.join(folder)).unwrap();
    }
    for i in 0..FRAMES {
        let (color, depth) = (Image::filled(160, 120, [90; 3]), Image::filled(160, 120, 0.5));
        writer.write_frame(&format!("{i:04}"), &color, &depth, Some(&mask(80))).unwrap();
        fs::write(dir.join(format!("gt_poses/{i:04}.txt")), format_pose(&cam_from_obj(i))).unwrap();
    }
    let mut obj = String::new();
    corners().iter().for_each(|[x, y, z]| obj += &format!("v {x} {y} {z}\n"));
    FACES.iter().for_each(|f| obj += &format!("f {} {} {} {}\n", f[0] + 1, f[1] + 1, f[2] + 1, f[3] + 1));
    fs::write(dir.join("mesh/cube.obj"), obj).unwrap();
    let place = Place {
        benchmark: Benchmark::Custom,
        root: root.to_owned(),
        name: "cube".into(),
        models: None,
        object: None,
        stride: 1,
    };
    let (masks, schedule, config) = (Masks::Given, None, None);
    Asked { method: Method::Ours, place, repeat: 0, masks, schedule, config, python: None }
}

/// What a run leaves behind that tracked without error, in an object frame of its own.
fn perfect_run(out: &Path) {
    for folder in ["ob_in_cam", "masks"] {
        fs::create_dir_all(out.join(folder)).unwrap();
    }
    let pred_from_gt = gt_from_pred().inverse();
    for i in 0..FRAMES {
        let pose = cam_from_obj(i) * gt_from_pred();
        fs::write(out.join(format!("ob_in_cam/{i:04}.txt")), format_pose(&pose)).unwrap();
    }
    let mut ply = String::from(
        "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n\
         element face 6\nproperty list uchar int vertex_indices\nend_header\n",
    );
    for c in corners() {
        let p = pred_from_gt * Point3::from(c);
        ply += &format!("{} {} {}\n", p.x, p.y, p.z);
    }
    FACES.iter().for_each(|f| ply += &format!("4 {} {} {} {}\n", f[0], f[1], f[2], f[3]));
    fs::write(out.join("mesh.ply"), ply).unwrap();
    let run = r#"{"version": "0", "frames": [{"id": "0000", "status": "tracked"}, {"id": "0001", "status": "lost"}],
        "field": {"rounds": 2, "ms_per_round_median": 1500.0, "steps": 300}, "tracking_hz_median": 7.5}"#;
    fs::write(out.join("run.json"), run).unwrap();
}

#[test]
fn perfect_damaged_and_absent_results() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("results");
    let asked = sequence(dir.path());
    assert!(score(&asked, &out).unwrap_err().to_string().contains("run.json"));

    perfect_run(&out);
    let perfect = score(&asked, &out).unwrap();
    assert!(perfect.add > 99.99 && perfect.add_s > 99.99, "{perfect:?}");
    assert!((0.08..0.13).contains(&perfect.cd_seen_cm.unwrap()), "{perfect:?}");
    assert!(perfect.normals_deg.unwrap() < 1e-3, "{perfect:?}");
    // The bottom was never seen, so a whole cube has surface that the truth lacks.
    assert!(perfect.cd_cm.unwrap() > perfect.cd_seen_cm.unwrap(), "{perfect:?}");
    assert_eq!((perfect.lost, perfect.hz, perfect.round_s), (1, Some(7.5), Some(1.5)));
    assert_eq!((perfect.region_j, perfect.errors.frames.len()), (None, FRAMES));

    // Two files gone or spoilt, one pose 4 cm off: 7 + 0.6 of 10 frames, and one staircase step at most.
    fs::remove_file(out.join("ob_in_cam/0003.txt")).unwrap();
    fs::write(out.join("ob_in_cam/0004.txt"), "nan ".repeat(16)).unwrap();
    let off = Isometry3::translation(0.0, 0.0, 0.04) * cam_from_obj(5) * gt_from_pred();
    fs::write(out.join("ob_in_cam/0005.txt"), format_pose(&off)).unwrap();
    fs::remove_file(out.join("mesh.ply")).unwrap();
    let damaged = score(&asked, &out).unwrap();
    assert!((75.9..80.1).contains(&damaged.add), "{damaged:?}");
    assert_eq!((damaged.cd_cm, damaged.cd_icp_cm), (None, None));
    assert_eq!((damaged.errors.add[3], damaged.errors.rotation[4]), (None, None));
    assert!((damaged.errors.translation[5].unwrap() - 0.04).abs() < 1e-6);

    // With a stride only the frames that were used count.
    let every_third = Asked { place: Place { stride: 3, ..asked.place.clone() }, ..asked.clone() };
    let strided = score(&every_third, &out).unwrap();
    assert_eq!(strided.errors.frames.len(), 4);
    assert!((strided.add - 75.0).abs() < 0.01, "{strided:?}");
}

#[test]
fn masks_are_scored_when_they_were_found() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("results");
    let asked = Asked { masks: Masks::First, ..sequence(dir.path()) };
    perfect_run(&out);
    // Half of each mask, and of one frame none: eight frames at 1/2 and one at 0 after the first.
    for i in (0..FRAMES).filter(|i| *i != 4) {
        write_png_mask(&out.join(format!("masks/{i:04}.png")), &mask(40)).unwrap();
    }
    let found = score(&asked, &out).unwrap();
    assert!((found.region_j.unwrap() - 100.0 * 4.0 / 9.0).abs() < 1e-9, "{found:?}");
    // The only boundary is a column, which is in the wrong place.
    assert_eq!(found.boundary_f, Some(0.0));
}

#[test]
fn a_score_survives_its_file() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("score.json");
    let errors = Errors { frames: vec![0, 2], add: vec![Some(0.1), None], ..Errors::default() };
    let score = Score { add: 12.5, cd_cm: None, errors, ..Score::default() };
    super::super::job::write_json(&path, &score).unwrap();
    assert_eq!(read_json::<Score>(&path).unwrap(), score);
}
