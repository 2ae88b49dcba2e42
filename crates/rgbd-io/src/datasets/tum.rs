//! TUM RGB-D: a hand-held camera in rooms, with its motion measured.
//!
//! | path | what |
//! |---|---|
//! | `<seq>/rgb.txt`, `<seq>/depth.txt` | lines of `timestamp filename`, each list with times of its own |
//! | `<seq>/groundtruth.txt` | lines of `timestamp tx ty tz qx qy qz qw`: camera to world; optional |
//! | `<seq>/masks/<name of the colour image>.png` | optional; not part of the dataset |
//! | `<seq>/cam_K.txt` | optional; otherwise by the freiburg number in the name, or from the options |
//! | `<seq>/mesh/*.obj` | optional, in the world's frame; not part of the dataset |
//!
//! Depth has 5000 units per metre. A colour image goes with the depth image and with the pose nearest in time, at
//! most 0.02 s away, each used once; colour without depth is left out. The truth takes the world for the object.
//! Lens distortion is ignored.
//!
//! J. Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012.

use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

use super::sequence::{DepthCode, Frame, Model, PoseSource, finish};
use super::{DatasetOptions, DatasetSequence, check_name, custom, folders, read_file, some_sequences};
use crate::{Error, Intrinsics, MaskSource, read_intrinsics};

const SOURCE: &str = "download a sequence of TUM RGB-D (cvg.cit.tum.de/data/datasets/rgbd-dataset) and give the folder \
    that holds <seq>/rgb.txt, <seq>/depth.txt, <seq>/rgb/ and <seq>/depth/";

/// Furthest that two files of one frame may be apart, seconds.
pub const MAX_TIME_DIFFERENCE: f64 = 0.02;

const UNITS_PER_METRE: f64 = 5000.0;
const MAX_LIST_BYTES: u64 = 64 << 20;
/// Longer than any recording; keeps the association short.
const MAX_LINES: usize = 1 << 20;

/// Names of the sequences.
///
/// # Errors
/// When there is none.
pub fn sequences(root: impl AsRef<Path>) -> Result<Vec<String>, Error> {
    let root = root.as_ref();
    some_sequences(
        folders(root, |d| d.join("rgb.txt").is_file() && d.join("depth.txt").is_file()),
        root,
        SOURCE,
    )
}

/// Opens a sequence. Ids are the names of the colour images.
///
/// # Errors
/// When lists, images or the camera are missing or damaged, or no depth goes with any colour.
pub fn open(root: impl AsRef<Path>, name: &str, options: &DatasetOptions) -> Result<DatasetSequence, Error> {
    let root = root.as_ref();
    check_name(root, name)?;
    let dir = root.join(name);
    if !dir.is_dir() {
        return Err(Error::new(dir, "no such folder", SOURCE));
    }
    let intrinsics = camera(&dir, name, options)?;
    let (colors, depths) = (read_list(&dir.join("rgb.txt"))?, read_list(&dir.join("depth.txt"))?);
    let times = |list: &[(f64, String)]| -> Vec<f64> { list.iter().map(|(t, _)| *t).collect() };
    let color_times = times(&colors);
    let pairs = associate(&color_times, &times(&depths), MAX_TIME_DIFFERENCE);
    if pairs.is_empty() {
        let problem = format!("has no time within {MAX_TIME_DIFFERENCE} s of one in rgb.txt");
        return Err(Error::new(dir.join("depth.txt"), problem, SOURCE));
    }
    let mut poses = truth(&dir, &color_times)?;
    let has_masks =
        dir.join("masks").is_dir() || matches!(options.masks, MaskSource::Folder(_) | MaskSource::All);
    let frames = pairs.into_iter().filter_map(|(c, d)| {
        let color = PathBuf::from(&colors.get(c)?.1);
        let id = color.file_stem().map_or_else(String::new, |s| s.to_string_lossy().into_owned());
        Some(Frame {
            color: dir.join(color),
            depth: dir.join(&depths.get(d)?.1),
            depth_code: DepthCode::Metres(1.0 / UNITS_PER_METRE),
            mask: has_masks.then(|| dir.join("masks").join(format!("{id}.png"))),
            occluder: None,
            intrinsics,
            pose: poses.get_mut(c).and_then(Option::take).map_or(PoseSource::Unknown, PoseSource::Known),
            id,
        })
    });
    let frames: Vec<Frame> = frames.collect();
    let model = Model::new(custom::mesh_file(&dir), SOURCE);
    finish(name, dir, frames, model, options, SOURCE)
}

/// The published camera of a sequence whose name has a freiburg number, as in `rgbd_dataset_freiburg1_xyz`.
pub fn camera_of(name: &str) -> Option<Intrinsics> {
    let at = name.find("freiburg")? + "freiburg".len();
    let [fx, fy, cx, cy] = match name.get(at..at + 1)? {
        "1" => [517.3, 516.5, 318.6, 255.3],
        "2" => [520.9, 521.0, 325.1, 249.7],
        "3" => [535.4, 539.2, 320.1, 247.6],
        _ => return None,
    };
    Some(Intrinsics { fx, fy, cx, cy })
}

fn camera(dir: &Path, name: &str, options: &DatasetOptions) -> Result<Intrinsics, Error> {
    let file = dir.join("cam_K.txt");
    if let Some(given) = options.intrinsics {
        return Ok(given);
    }
    if file.is_file() {
        return read_intrinsics(&file);
    }
    let remedy = "give the intrinsics, write cam_K.txt into the sequence's folder, or keep the dataset's folder names, \
                  which hold freiburg1, 2 or 3";
    camera_of(name).ok_or_else(|| Error::new(file, "is missing, and the name tells no camera", remedy))
}

fn read_list(path: &Path) -> Result<Vec<(f64, String)>, Error> {
    let text = read_lines(path)?;
    parse_list(&text).map_err(|problem| Error::new(path, problem, SOURCE))
}

fn read_lines(path: &Path) -> Result<String, Error> {
    let bytes = read_file(path, MAX_LIST_BYTES, SOURCE)?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

/// Parses a list of files: timestamp and name on every line, `#` before comments; sorted by time.
///
/// # Errors
/// On a line of another kind, a name that leads out of the folder, or more than a million lines.
pub fn parse_list(text: &str) -> Result<Vec<(f64, String)>, String> {
    let mut list = Vec::new();
    for (number, line) in data_lines(text)? {
        let mut words = line.split_whitespace();
        let time = words.next().and_then(|w| w.parse().ok()).filter(|t: &f64| t.is_finite());
        let (Some(time), Some(name)) = (time, words.next()) else {
            return Err(format!("has a line {number} that isn't a timestamp and a filename"));
        };
        let inside = |part| matches!(part, std::path::Component::Normal(_) | std::path::Component::CurDir);
        if !Path::new(name).components().all(inside) {
            return Err(format!("names a file outside of its folder in line {number}"));
        }
        list.push((time, name.to_owned()));
    }
    list.sort_by(|a, b| a.0.total_cmp(&b.0));
    Ok(list)
}

/// Parses a trajectory: `timestamp tx ty tz qx qy qz qw` (metres) on every line, `#` before comments; sorted by time.
///
/// # Errors
/// On a line of another kind, or more than a million lines.
pub fn parse_trajectory(text: &str) -> Result<Vec<(f64, Isometry3<f64>)>, String> {
    let mut poses = Vec::new();
    for (number, line) in data_lines(text)? {
        let wrong = || format!("has a line {number} that isn't timestamp tx ty tz qx qy qz qw");
        let words: Option<Vec<f64>> = line.split_whitespace().map(|w| w.parse().ok()).collect();
        let words = words.filter(|w| w.iter().all(|v| v.is_finite())).ok_or_else(wrong)?;
        let &[time, tx, ty, tz, qx, qy, qz, qw] = words.as_slice() else { return Err(wrong()) };
        let q = Quaternion::new(qw, qx, qy, qz);
        // A length whose square overflows is no rotation that was rounded.
        let rotation = UnitQuaternion::try_new(q, 1e-6).filter(|_| q.norm().is_finite()).ok_or_else(wrong)?;
        poses.push((time, Isometry3::from_parts(Translation3::new(tx, ty, tz), rotation)));
    }
    poses.sort_by(|a, b| a.0.total_cmp(&b.0));
    Ok(poses)
}

/// Numbered lines with something on them.
fn data_lines(text: &str) -> Result<Vec<(usize, &str)>, String> {
    let lines = text.trim_start_matches('\u{feff}').lines().enumerate();
    let lines = lines.map(|(i, l)| (i + 1, l.trim())).filter(|(_, l)| !l.is_empty() && !l.starts_with('#'));
    let lines: Vec<_> = lines.take(MAX_LINES + 1).collect();
    if lines.len() > MAX_LINES { Err(format!("has more than {MAX_LINES} lines")) } else { Ok(lines) }
}

/// Pairs of indices whose times differ by less than `max`, the nearest first and each index in one pair only; in
/// the order of `a`. Both lists are sorted.
pub fn associate(a: &[f64], b: &[f64], max: f64) -> Vec<(usize, usize)> {
    /// Candidates on each side; a camera has no more images within 0.02 s.
    const NEAR: usize = 4;
    let mut candidates = Vec::new();
    for (i, t) in a.iter().enumerate() {
        let middle = b.partition_point(|s| s < t);
        for (j, s) in b.iter().enumerate().take(middle + NEAR).skip(middle.saturating_sub(NEAR)) {
            let difference = (t - s).abs();
            if difference < max {
                candidates.push((difference, i, j));
            }
        }
    }
    candidates.sort_by(|x, y| x.0.total_cmp(&y.0).then((x.1, x.2).cmp(&(y.1, y.2))));
    let (mut used_a, mut used_b) = (vec![false; a.len()], vec![false; b.len()]);
    let mut pairs = Vec::new();
    for (_, i, j) in candidates {
        if let (Some(a @ false), Some(b @ false)) = (used_a.get_mut(i), used_b.get_mut(j)) {
            (*a, *b) = (true, true);
            pairs.push((i, j));
        }
    }
    pairs.sort_unstable();
    pairs
}

/// World to camera at each colour image, where it is known.
fn truth(dir: &Path, times: &[f64]) -> Result<Vec<Option<Isometry3<f64>>>, Error> {
    let path = dir.join("groundtruth.txt");
    let mut poses = vec![None; times.len()];
    if !path.is_file() {
        return Ok(poses);
    }
    let trajectory =
        parse_trajectory(&read_lines(&path)?).map_err(|problem| Error::new(&path, problem, SOURCE))?;
    let pose_times: Vec<f64> = trajectory.iter().map(|(t, _)| *t).collect();
    for (i, j) in associate(times, &pose_times, MAX_TIME_DIFFERENCE) {
        if let (Some(pose), Some((_, world_from_cam))) = (poses.get_mut(i), trajectory.get(j)) {
            *pose = Some(world_from_cam.inverse());
        }
    }
    Ok(poses)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn names_tell_cameras() {
        assert_eq!(camera_of("rgbd_dataset_freiburg3_long_office_household").unwrap().fy, 539.2);
        assert_eq!((camera_of("freiburg9"), camera_of("freiburg"), camera_of("x")), (None, None, None));
    }

    #[test]
    fn lists_are_read_and_checked() {
        let text = "# color images\n# timestamp filename\n2.5 rgb/2.5.png\n1.25 ./rgb/1.25.png\r\n\n";
        let list = parse_list(text).unwrap();
        assert_eq!(list, [(1.25, "./rgb/1.25.png".to_owned()), (2.5, "rgb/2.5.png".to_owned())]);
        for (text, word) in [
            ("1.0", "line 1"),
            ("1.0 a\nx b", "line 2"),
            ("nan a", "line 1"),
            ("1 ../../etc/x.png", "outside"),
            ("1 /etc/x.png", "outside"),
        ] {
            assert!(parse_list(text).unwrap_err().contains(word), "{text}");
        }
        let pose = parse_trajectory("1 0.5 0 -1 0 0 0.7071 0.7071").unwrap()[0].1;
        assert!(
            (pose * nalgebra::Point3::new(1.0, 0.0, 0.0) - nalgebra::Point3::new(0.5, 1.0, -1.0)).norm()
                < 1e-9
        );
        for text in [
            "1 0 0 0 0 0 0 0",
            "1 0 0 0 0 0 0",
            "1 0 0 0 0 0 0 1 1",
            "1 0 0 inf 0 0 0 1",
            "a",
            "1 0 0 0 1e200 0 0 1",
        ] {
            assert!(parse_trajectory(text).is_err(), "{text}");
        }
    }

    #[test]
    fn a_list_without_end_is_refused() {
        let endless = "1 a\n".repeat(MAX_LINES + 1);
        assert!(parse_list(&endless).unwrap_err().contains("more than"));
        assert!(parse_trajectory(&endless).unwrap_err().contains("more than"));
    }

    #[test]
    fn the_nearest_pairs_win() {
        // 0.030 is nearer to 0.028 than 0.010 is, and 0.100 has no partner.
        let pairs = associate(&[0.010, 0.030, 0.100], &[0.000, 0.028, 0.075], 0.02);
        assert_eq!(pairs, [(0, 0), (1, 1)]);
        assert_eq!(associate(&[0.0, 0.001], &[0.002], 0.02), [(1, 0)]);
        assert_eq!(associate(&[], &[1.0], 0.02), []);
        // Many equal times don't make it slow.
        assert!(associate(&vec![1.0; 50_000], &vec![1.0; 50_000], 0.02).len() >= 4);
    }

    proptest! {
        #[test]
        fn pairs_are_near_and_unique(
            mut a in prop::collection::vec(0.0..1.0, 0..40),
            mut b in prop::collection::vec(0.0..1.0, 0..40),
        ) {
            a.sort_by(f64::total_cmp);
            b.sort_by(f64::total_cmp);
            let pairs = associate(&a, &b, 0.02);
            prop_assert!(pairs.windows(2).all(|w| w[0].0 < w[1].0));
            let mut second: Vec<usize> = pairs.iter().map(|p| p.1).collect();
            second.sort_unstable();
            second.dedup();
            prop_assert_eq!(second.len(), pairs.len());
            prop_assert!(pairs.iter().all(|(i, j)| (a[*i] - b[*j]).abs() < 0.02));
        }

        #[test]
        fn noise_is_survived(text in "[-0-9.e/ a\n#]{0,80}") {
            let _ = (parse_list(&text), parse_trajectory(&text));
        }
    }
}
