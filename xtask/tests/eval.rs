//! `cargo xtask eval` from end to end: a sequence whose truth is exact, written in the layout of each dataset, comes out
//! with the score that the method has on the sequence itself.
#![allow(clippy::unwrap_used)]

use baselines::{Baseline, BaselineConfig};
use eval_metrics::{ModelPoints, score_poses};
use rgbd_synth::{Sensor, Sequence};
use serde_json::Value;
use std::path::Path;
use std::process::{Command, Output};

const FRAMES: usize = 8;

/// A short sequence, `scale` times as large as the tiny one.
fn sequence(scale: usize) -> Sequence {
    let tiny = Sequence::tiny().with_sensor(Sensor::perfect());
    let mut spec = tiny.spec().clone();
    (spec.width, spec.height) = (scale * spec.width, scale * spec.height);
    spec.intrinsics = spec.intrinsics.scaled(scale as f64, scale as f64);
    spec.frames = FRAMES;
    Sequence::new(spec).unwrap()
}

/// ADD and ADD-S of a baseline that gets the frames from memory.
fn expected(method: Baseline, sequence: &Sequence, limit: f64) -> (f64, f64) {
    let mut tracker = method.tracker(&BaselineConfig::default());
    let poses: Vec<_> =
        (0..FRAMES).map(|i| Some(tracker.track(&sequence.render(i).frame).cam_from_obj)).collect();
    let truth: Vec<_> = (0..FRAMES).map(|i| Some(sequence.cam_from_obj(i))).collect();
    let model =
        ModelPoints::new(sequence.mesh().vertices.iter().map(|v| v.map(f64::from)).collect()).unwrap();
    let scores = score_poses(&poses, &truth, &model, limit);
    (scores.add_auc, scores.add_s_auc)
}

fn eval(dataset: &str, root: &Path, out: &Path, more: &[&str]) -> (Output, Value) {
    let json = out.join("scores.json");
    let output = Command::new(env!("CARGO_BIN_EXE_xtask"))
        .args(["eval", dataset, "--root"])
        .arg(root)
        .arg("--out")
        .arg(out)
        .arg("--json")
        .arg(&json)
        .args(more)
        .env_remove("RUST_BACKTRACE")
        .output()
        .unwrap();
    let scores = std::fs::read_to_string(&json).map_or(Value::Null, |t| serde_json::from_str(&t).unwrap());
    (output, scores)
}

fn text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

/// Evaluates frame-to-frame tracking on what `write` wrote; the score may differ by what rounding in the files does.
fn round_trip(
    dataset: &str,
    scale: usize,
    limit: f64,
    write: impl Fn(&Sequence, &Path) -> Result<String, rgbd_io::Error>,
) {
    let dir = tempfile::tempdir().unwrap();
    let (root, out) = (dir.path().join("data"), dir.path().join("out"));
    let name = write(&sequence(scale), &root).unwrap();
    let (output, scores) = eval(dataset, &root, &out, &["--method", "frame-to-frame", "--masks", "gt"]);
    assert!(output.status.success(), "{}", text(&output));
    let row = &scores["rows"][0];
    assert!(row["video"].as_str().is_some_and(|v| name.starts_with(v) || v.starts_with(&name)), "{row}");
    // BEHAVE's images are used at a third.
    let seen = if dataset == "behave" { sequence(scale / 3) } else { sequence(scale) };
    let (add, add_s) = expected(Baseline::FrameToFrame, &seen, limit);
    assert!(add > 90.0, "the method is no good here: {add}");
    let near = |key: &str, value: f64| (row[key].as_f64().unwrap() - value).abs() < 2.0;
    assert!(near("add", add) && near("add_s", add_s), "{row}, and not {add}, {add_s}");
    assert!(row["cd_cm"].as_f64().is_some_and(|cd| cd < 0.6), "{row}");
    assert_eq!(row["lost"], 0);
}

#[test]
fn ho3d() {
    round_trip("ho3d", 2, 0.1, |s, root| rgbd_synth::write_ho3d(s, root));
}

#[test]
fn ycbineoat() {
    round_trip("ycbineoat", 2, 0.1, |s, root| rgbd_synth::write_ycbineoat(s, root));
}

#[test]
fn behave() {
    round_trip("behave", 6, 0.5, |s, root| rgbd_synth::write_behave(s, root));
}

#[test]
fn bop() {
    round_trip("bop", 2, 0.1, |s, root| rgbd_synth::write_bop(s, root));
}

/// A custom folder: methods of both kinds, a failure beside them, and the second run that does only what is missing.
#[test]
fn custom_with_failures_and_a_report() {
    let dir = tempfile::tempdir().unwrap();
    let (root, out, report) = (dir.path().join("data"), dir.path().join("out"), dir.path().join("report"));
    for name in ["good", "broken"] {
        rgbd_synth::write_custom(&sequence(2), root.join(name)).unwrap();
    }
    std::fs::write(root.join("broken/rgb/000000.png"), "no image").unwrap();
    let arguments = ["--method", "bundletrack,frame-to-frame", "--masks", "first", "--jobs", "2", "--report"];
    let arguments = [&arguments[..], &[report.to_str().unwrap()]].concat();
    let (output, scores) = eval("custom", &root, &out, &arguments);
    assert!(!output.status.success());
    let rows = scores["rows"].as_array().unwrap();
    assert_eq!(rows.len(), 4);
    for row in rows {
        let is_broken = row["video"] == "broken";
        assert_eq!(row["error"].is_string(), is_broken, "{row}");
        assert!(!is_broken || row["error"].as_str().unwrap().contains("000000.png"), "{row}");
        assert!(is_broken || row["add"].as_f64().unwrap() > 80.0, "{row}");
        assert!(is_broken || row["cd_cm"].as_f64().unwrap() < 0.6, "{row}");
        // Found masks are scored, given ones aren't.
        let is_found = !is_broken && row["method"] == "bundletrack";
        assert_eq!(row["region_j"].is_f64() && row["boundary_f"].is_f64(), is_found, "{row}");
        assert!(!is_found || row["region_j"].as_f64().unwrap() > 60.0, "{row}");
    }
    // Half of the mean is the failed video's.
    let mean = |method: &str| {
        let means = scores["mean"].as_array().unwrap();
        means.iter().find(|m| m["method"] == method).unwrap()["add"].as_f64().unwrap()
    };
    assert!(mean("frame-to-frame") < 50.1 && mean("bundletrack") < 50.1);

    let page = std::fs::read_to_string(report.join("index.html")).unwrap();
    assert!(page.contains("<svg") && page.contains("000000.png") && page.contains("bundletrack"));
    // Nothing is asked of the network.
    assert!(!page.contains("http") && !page.contains("src=") && !page.contains("@import"));
    assert!(std::fs::read_to_string(report.join("tables.md")).unwrap().contains("| good |"));

    // What is done isn't done again: its log stays away. What failed is.
    let log = |video: &str| out.join("custom/frame-to-frame").join(video).join("log.txt");
    for video in ["good", "broken"] {
        std::fs::remove_file(log(video)).unwrap();
    }
    rgbd_synth::write_custom(&sequence(2), root.join("broken")).unwrap();
    let (output, scores) = eval("custom", &root, &out, &["--method", "frame-to-frame", "--masks", "first"]);
    assert!(output.status.success(), "{}", text(&output));
    assert!(!log("good").exists() && log("broken").exists());
    assert!(scores["rows"].as_array().unwrap().iter().all(|r| r["add"].as_f64().unwrap() > 80.0));
    // Unless it is asked for.
    let one = ["--method", "frame-to-frame", "--videos", "good", "--force"];
    assert!(eval("custom", &root, &out, &one).0.status.success() && log("good").exists());
}

#[test]
fn missing_data_is_one_message_with_source_and_layout() {
    let dir = tempfile::tempdir().unwrap();
    for (dataset, source, layout) in [
        ("ho3d", "shreyashampali/ho3d", "evaluation/<SEQ>/rgb"),
        ("ycbineoat", "iros20-6d-pose-tracking", "annotated_poses"),
        ("behave", "virtualhumans.mpi-inf.mpg.de/behave", "calibs/"),
        ("bop", "bop.felk.cvut.cz", "scene_camera.json"),
    ] {
        let (output, _) = eval(dataset, &dir.path().join("nowhere"), dir.path(), &[]);
        let message = text(&output);
        assert!(!output.status.success());
        assert!(
            message.contains(source) && message.contains(layout) && message.contains("nowhere"),
            "{message}"
        );
        assert_eq!(message.trim().lines().count(), 1, "{message}");
    }
}
