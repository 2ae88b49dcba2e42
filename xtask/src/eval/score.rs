//! Scores the results of one run.

use super::ply;
use super::report::Row;
use super::truth::Truth;
use anyhow::Context;
use eval_metrics::{
    MeshProtocol, MeshRef, ModelPoints, alignment, keep_faces, score_mesh, score_poses, visible_faces,
};
use nalgebra::Isometry3;
use serde::Deserialize;
use std::path::Path;

/// Upper end of the areas under the recall curves, metres: the published range for hand-sized objects.
const MAX_ERROR: f64 = 0.1;

/// The part of `run.json` that is reported.
#[derive(Default, Deserialize)]
#[serde(default)]
struct RunFile {
    frames: Vec<FrameEntry>,
    field: FieldEntry,
    tracking_hz_median: Option<f64>,
}

#[derive(Deserialize)]
struct FrameEntry {
    status: String,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct FieldEntry {
    rounds: usize,
    ms_per_round_median: Option<f64>,
}

/// Scores the results in `out` (`ob_in_cam/`, `mesh.ply`, `run.json`).
pub(super) fn score(name: &str, truth: &Truth, out: &Path) -> anyhow::Result<Row> {
    let run_path = out.join("run.json");
    let text = std::fs::read_to_string(&run_path)
        .with_context(|| format!("{} can't be read; was the sequence run?", run_path.display()))?;
    let run: RunFile =
        serde_json::from_str(&text).with_context(|| format!("{} isn't a run report", run_path.display()))?;

    let poses = read_poses(truth, &out.join("ob_in_cam"));
    let model = ModelPoints::from_mesh(truth.mesh.by_ref()).context("the true mesh has no surface")?;
    let scores = score_poses(&poses, &truth.poses, &model, MAX_ERROR);
    let mut row = Row {
        video: name.to_owned(),
        add_s: scores.add_s_auc,
        add: scores.add_auc,
        hz: run.tracking_hz_median,
        round_s: run
            .field
            .ms_per_round_median
            .filter(|ms| run.field.rounds > 0 && *ms > 0.0)
            .map(|ms| ms / 1e3),
        lost: Some(run.frames.iter().filter(|f| f.status == "lost").count()),
        ..Row::default()
    };
    let mesh_path = out.join("mesh.ply");
    if mesh_path.exists() {
        let mesh = ply::read(&mesh_path)?;
        score_surface(&mut row, &mesh, truth, &poses);
    }
    Ok(row)
}

/// The predicted pose of each frame of the truth; a file that is missing or unusable is a missing pose.
fn read_poses(truth: &Truth, dir: &Path) -> Vec<Option<Isometry3<f64>>> {
    truth.ids.iter().map(|id| rgbd_io::poses::read_pose(&dir.join(format!("{id}.txt"))).ok()).collect()
}

fn score_surface(row: &mut Row, mesh: &ply::Mesh, truth: &Truth, poses: &[Option<Isometry3<f64>>]) {
    let Some(pred_from_gt) = alignment(poses, &truth.poses) else { return };
    let gt_from_pred = pred_from_gt.inverse();
    let views: Vec<_> = truth.poses.iter().flatten().copied().collect();

    let gt_seen =
        keep_faces(&truth.mesh.triangles, &visible_faces(truth.mesh.by_ref(), &views, &truth.camera));
    let gt = MeshRef::new(&truth.mesh.vertices, &gt_seen);
    let pred_views: Vec<_> = views.iter().map(|view| view * gt_from_pred).collect();
    let pred_seen = keep_faces(&mesh.triangles, &visible_faces(mesh.by_ref(), &pred_views, &truth.camera));

    let centimetres = |pred: MeshRef<'_>, protocol: MeshProtocol| {
        score_mesh(pred, gt, &gt_from_pred, &protocol).map(|chamfer| chamfer.distance() * 100.0)
    };
    row.cd_cm = centimetres(mesh.by_ref(), MeshProtocol::paper_text());
    row.cd_icp_cm = centimetres(mesh.by_ref(), MeshProtocol::authors_script());
    row.cd_seen_cm = centimetres(MeshRef::new(&mesh.vertices, &pred_seen), MeshProtocol::paper_text());
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Point3, Vector3};
    use rgbd_io::{CustomWriter, Image, Intrinsics, poses::format_pose};
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

    fn sequence(dir: &Path) {
        let camera = Intrinsics { fx: 300.0, fy: 320.0, cx: 79.5, cy: 59.5 };
        let writer = CustomWriter::create(dir, &camera).unwrap();
        for folder in ["gt_poses", "mesh"] {
            fs::create_dir_all(dir.join(folder)).unwrap();
        }
        for i in 0..FRAMES {
            let (color, depth) = (Image::filled(160, 120, [90; 3]), Image::filled(160, 120, 0.5));
            writer.write_frame(&format!("{i:04}"), &color, &depth, None).unwrap();
            fs::write(dir.join(format!("gt_poses/{i:04}.txt")), format_pose(&cam_from_obj(i))).unwrap();
        }
        let mut obj = String::new();
        corners().iter().for_each(|[x, y, z]| obj += &format!("v {x} {y} {z}\n"));
        FACES.iter().for_each(|f| obj += &format!("f {} {} {} {}\n", f[0] + 1, f[1] + 1, f[2] + 1, f[3] + 1));
        fs::write(dir.join("mesh/cube.obj"), obj).unwrap();
    }

    /// What a run leaves behind that tracked without error, in an object frame of its own.
    fn perfect_run(out: &Path) {
        fs::create_dir_all(out.join("ob_in_cam")).unwrap();
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
        sequence(dir.path());
        let truth = Truth::read(dir.path(), 1).unwrap();
        assert_eq!((truth.ids.len(), truth.camera.width), (FRAMES, 160));
        assert!(score("cube", &truth, &out).unwrap_err().to_string().contains("was the sequence run?"));

        perfect_run(&out);
        let row = score("cube", &truth, &out).unwrap();
        assert!(row.add > 99.99 && row.add_s > 99.99, "{row:?}");
        assert!((0.08..0.13).contains(&row.cd_seen_cm.unwrap()), "{row:?}");
        // The bottom was never seen, so a whole cube has surface that the truth lacks.
        assert!(row.cd_cm.unwrap() > row.cd_seen_cm.unwrap(), "{row:?}");
        assert_eq!((row.lost, row.hz, row.round_s), (Some(1), Some(7.5), Some(1.5)));

        // Two files gone or spoilt, one pose 4 cm off: 7 + 0.6 of 10 frames, and one staircase step at most.
        fs::remove_file(out.join("ob_in_cam/0003.txt")).unwrap();
        fs::write(out.join("ob_in_cam/0004.txt"), "nan ".repeat(16)).unwrap();
        let off = Isometry3::translation(0.0, 0.0, 0.04) * cam_from_obj(5) * gt_from_pred();
        fs::write(out.join("ob_in_cam/0005.txt"), format_pose(&off)).unwrap();
        fs::remove_file(out.join("mesh.ply")).unwrap();
        let row = score("cube", &truth, &out).unwrap();
        assert!((75.9..80.1).contains(&row.add), "{row:?}");
        assert_eq!((row.cd_cm, row.cd_icp_cm), (None, None));

        // With a stride only the frames that were used count.
        let every_third = Truth::read(dir.path(), 3).unwrap();
        assert_eq!(every_third.ids, ["0000", "0003", "0006", "0009"]);
        let row = score("cube", &every_third, &out).unwrap();
        assert!((row.add - 75.0).abs() < 0.01, "{row:?}");
    }
}
