//! Poses as text, and files written whole.
#![allow(clippy::unwrap_used)]

use std::path::Path;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use proptest::prelude::*;
use rgbd_io::poses::{format_pose, parse_pose, read_pose, read_pose_folder, write_atomic};

fn pose() -> impl Strategy<Value = Isometry3<f64>> {
    (prop::array::uniform3(-3.0..3.0), prop::array::uniform3(-1e3..1e3)).prop_map(|(r, t)| {
        Isometry3::from_parts(
            Translation3::from(Vector3::from(t)),
            UnitQuaternion::from_scaled_axis(Vector3::from(r)),
        )
    })
}

proptest! {
    #[test]
    fn text_keeps_a_pose(pose in pose()) {
        let text = format_pose(&pose);
        prop_assert_eq!(text.lines().count(), 4);
        let back = parse_pose(&text).unwrap();
        prop_assert!(back.rotation.angle_to(&pose.rotation) < 1e-8);
        prop_assert!((back.translation.vector - pose.translation.vector).amax() <= 1e-6);
        let m = back.rotation.to_rotation_matrix().into_inner();
        prop_assert!((m.transpose() * m - nalgebra::Matrix3::identity()).amax() < 1e-12);
        // Writing what was read changes nothing any more, up to a unit in the last digit.
        let again = parse_pose(&format_pose(&back)).unwrap();
        prop_assert!((again.to_homogeneous() - back.to_homogeneous()).amax() < 1e-6);
    }

    /// Rounded to three digits, as some tools write, the rotation is repaired.
    #[test]
    fn coarse_text_is_orthonormalised(pose in pose()) {
        let m = pose.to_homogeneous();
        let text: String = (0..4).map(|r| (0..4).map(|c| format!("{:.3} ", m[(r, c)])).collect::<String>() + "\n").collect();
        let back = parse_pose(&text).unwrap();
        prop_assert!(back.rotation.angle_to(&pose.rotation) < 3e-3);
        prop_assert!((back.rotation.norm() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn any_text_is_parsed_or_refused(text in "[-0-9einfa. ,#\\n\\[]{0,200}", bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let _ = parse_pose(&text);
        let _ = parse_pose(&String::from_utf8_lossy(&bytes));
        let _ = rgbd_io::parse_intrinsics(&text);
        let _ = rgbd_io::parse_intrinsics(&String::from_utf8_lossy(&bytes));
    }

    /// A valid file with a few bytes changed gives a rigid pose or an error, never anything else.
    #[test]
    fn a_damaged_pose_is_rigid_or_refused(pose in pose(), at in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6)) {
        let mut bytes = format_pose(&pose).into_bytes();
        for (index, value) in at {
            let i = index.index(bytes.len());
            bytes[i] = value;
        }
        if let Ok(back) = parse_pose(&String::from_utf8_lossy(&bytes)) {
            prop_assert!(back.to_homogeneous().iter().all(|v| v.is_finite()));
            prop_assert!((back.rotation.norm() - 1.0).abs() < 1e-9);
        }
    }
}

#[test]
fn wrong_poses_say_why() {
    for (text, word) in [
        ("", "0 numbers"),
        ("1 0 0 0 0 1 0 0 0 0 1 0", "12 numbers"),
        ("1 0 0 0 0 1 0 0 0 0 1 nan 0 0 0 1", "finite"),
        ("2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1", "orthonormal"),
        ("0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 1", "orthonormal"),
        ("1e200 0 0 0 0 1e200 0 0 0 0 1e200 0 0 0 0 1", "orthonormal"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0 0 0 0 1", "mirrors"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 0.1 0.2 0.5 1", "transposed"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 2", "last row"),
        ("1 0 0 zero 0 1 0 0 0 0 1 0 0 0 0 1", "\"zero\""),
    ] {
        let message = parse_pose(text).unwrap_err().to_string();
        assert!(message.contains(word) && message.contains("4 rows of 4"), "{text}: {message}");
    }
}

#[test]
fn extreme_translations_survive_text() {
    for v in [0.0, -0.0, 1e-12, 1.234_567_89e-7, 123_456.789, 1e20] {
        let pose = Isometry3::translation(v, -v, 0.5);
        let back = parse_pose(&format_pose(&pose)).unwrap();
        assert!((back.translation.x - v).abs() <= 1e-8 * v.abs(), "{v}");
        assert_eq!(back.translation.z, 0.5);
    }
    assert_eq!(
        format_pose(&Isometry3::translation(-0.0, 0.1, 2.0)),
        "1 0 0 0\n0 1 0 0.1\n0 0 1 2\n0 0 0 1\n"
    );
}

#[test]
fn a_folder_is_read_in_natural_order() {
    let dir = tempfile::tempdir().unwrap();
    for i in [10, 2, 1] {
        let pose = Isometry3::translation(f64::from(i), 0.0, 0.0);
        write_atomic(&dir.path().join(format!("{i}.txt")), format_pose(&pose).as_bytes()).unwrap();
    }
    std::fs::write(dir.path().join("notes.md"), "no pose").unwrap();
    let poses = read_pose_folder(dir.path()).unwrap();
    let seen: Vec<(&str, f64)> = poses.iter().map(|(id, p)| (id.as_str(), p.translation.x)).collect();
    assert_eq!(seen, [("1", 1.0), ("2", 2.0), ("10", 10.0)]);

    std::fs::write(dir.path().join("3.txt"), "1 2 3").unwrap();
    let message = read_pose_folder(dir.path()).unwrap_err().to_string();
    assert!(message.contains("3.txt") && message.contains("3 numbers"), "{message}");
    for missing in [
        read_pose(&dir.path().join("4.txt")).unwrap_err(),
        read_pose_folder(Path::new("/no/such")).unwrap_err(),
    ] {
        assert!(!missing.remedy.is_empty() && missing.to_string().lines().count() == 1, "{missing}");
    }
}

#[test]
fn a_failed_write_leaves_the_old_file_and_no_other() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("a.txt");
    write_atomic(&file, b"old").unwrap();
    write_atomic(&file, b"new").unwrap();
    assert_eq!(std::fs::read(&file).unwrap(), b"new");

    // A folder is in the way: the rename fails after the temporary was written.
    let blocked = dir.path().join("blocked");
    std::fs::create_dir_all(blocked.join("full")).unwrap();
    let message = write_atomic(&blocked, b"x").unwrap_err().to_string();
    assert!(message.contains("blocked") && message.contains("remove it"), "{message}");
    let message = write_atomic(&dir.path().join("none/b.txt"), b"x").unwrap_err().to_string();
    assert!(message.contains("b.txt") && message.contains("folder exists"), "{message}");
    assert!(write_atomic(Path::new("/"), b"x").is_err());

    let mut names: Vec<_> = std::fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    names.sort();
    assert_eq!(names, ["a.txt", "blocked"]);
}
