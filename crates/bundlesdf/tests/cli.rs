//! The command line on good and bad input: what it writes, what it says, how it exits.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
};

use rgbd_synth::{Masks, Sequence, write_custom};

fn bundlesdf(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_bundlesdf")).args(args).output().unwrap()
}

/// A small valid video in a temporary folder.
fn video(frames: usize) -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("video");
    write_custom(&Sequence::tiny().truncated(frames).with_masks(Masks::Every), &path).unwrap();
    (dir, path)
}

fn files(folder: &Path) -> Vec<PathBuf> {
    let mut files: Vec<_> = fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
    files.sort();
    files
}

/// Runs on the damaged video: exit code 2, one line on standard error that holds every word, nothing half-written.
fn refused(video: &Path, words: &[&str]) {
    let out = video.parent().unwrap().join("out");
    let output = bundlesdf(&["run", video.to_str().unwrap(), "--out", out.to_str().unwrap(), "--no-refine"]);
    let text = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{text}");
    let errors: Vec<_> = text.lines().filter(|l| l.starts_with("error: ")).collect();
    assert_eq!(errors.len(), 1, "{text}");
    for word in words {
        assert!(errors[0].contains(word), "{word} is not in: {}", errors[0]);
    }
    if out.exists() {
        for file in files(&out).into_iter().filter(|f| f.is_file()) {
            let name = file.file_name().unwrap().to_str().unwrap().to_owned();
            let whole = ["run.json", "keyframes.json", "mesh.ply", "mesh.obj", "report.html", "export.json"];
            let assets = ["mesh.glb", "textured.obj", "textured.mtl", "textured.png"];
            assert!(whole.contains(&name.as_str()) || assets.contains(&name.as_str()), "{name}");
        }
    }
}

#[test]
fn a_run_writes_a_pose_per_frame_and_its_report() {
    let (dir, video) = video(8);
    let out = dir.path().join("out");
    let args = ["run", video.to_str().unwrap(), "--out", out.to_str().unwrap(), "--no-refine"];
    let output = bundlesdf(&args);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let names = |p: PathBuf| files(&p).iter().map(|f| f.file_stem().unwrap().to_owned()).collect::<Vec<_>>();
    assert_eq!(names(out.join("ob_in_cam")), names(video.join("rgb")));
    let report: serde_json::Value = serde_json::from_slice(&fs::read(out.join("run.json")).unwrap()).unwrap();
    assert_eq!(report["frames"].as_array().unwrap().len(), 8);
    for key in ["version", "config", "keyframes", "field", "tracking_hz_median", "wall_s", "mesh"] {
        assert!(!report[key].is_null(), "{key}");
    }
    for key in ["segment", "match", "posegraph", "total"] {
        assert!(report["frames"][3]["ms"][key].is_number(), "{key}");
    }
    assert!(out.join("keyframes.json").exists() && out.join("report.html").exists());
    assert!(!out.join("ob_in_cam_refined").exists());
    // A second run doesn't overwrite it unless told to.
    let again = bundlesdf(&args);
    assert_eq!(again.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&again.stderr).contains("--force"));
}

#[test]
fn a_finished_run_can_be_logged_reported_and_drawn() {
    let (dir, video) = video(5);
    let out = dir.path().join("out");
    let (input, results) = (video.to_str().unwrap(), out.to_str().unwrap());
    let config = dir.path().join("short.toml");
    fs::write(&config, "[field]\nsteps = 20\nfinal_steps = 20\nrefine_steps = 20\n").unwrap();
    let config = config.to_str().unwrap();
    let output = bundlesdf(&["run", input, "--out", results, "--config", config, "--json-log"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let events: Vec<serde_json::Value> = String::from_utf8(output.stderr)
        .unwrap()
        .lines()
        .map(|line| serde_json::from_str(line).unwrap_or_else(|e| panic!("{line}: {e}")))
        .collect();
    let named = |name: &str| events.iter().filter(|e| e["event"] == name).count();
    assert_eq!((named("start"), named("frame"), named("finishing"), named("summary")), (1, 5, 1, 1));
    assert_eq!((named("refined"), files(&out.join("ob_in_cam_refined")).len()), (1, 5));
    let summary = events.last().unwrap();
    assert_eq!((&summary["event"], &summary["frames"]), (&"summary".into(), &5.into()));

    fs::remove_file(out.join("report.html")).unwrap();
    assert!(bundlesdf(&["report", results]).status.success());
    assert!(fs::read_to_string(out.join("report.html")).unwrap().contains("tracked"));

    assert!(bundlesdf(&["draw", results, "--every", "2", "--what", "axes,mask"]).status.success());
    let names: Vec<_> = files(&out.join("draw")).iter().map(|f| f.file_stem().unwrap().to_owned()).collect();
    let poses: Vec<_> =
        files(&out.join("ob_in_cam")).iter().map(|f| f.file_stem().unwrap().to_owned()).collect();
    assert_eq!(names, poses.iter().step_by(2).cloned().collect::<Vec<_>>());
    let drawn = rgbd_io::read_color(&files(&out.join("draw"))[0]).unwrap();
    assert_eq!(drawn.size(), (160, 120));
    let gif = dir.path().join("poses.gif");
    assert!(bundlesdf(&["draw", results, "--video", gif.to_str().unwrap()]).status.success());
    assert!(fs::read(&gif).unwrap().starts_with(b"GIF89a"));
    // A run that replaces this one leaves no drawings of it behind.
    assert!(bundlesdf(&["run", input, "--out", results, "--config", config, "--force"]).status.success());
    assert!(files(&out.join("draw")).is_empty());
}

#[test]
fn a_finished_run_can_be_refined() {
    let (dir, video) = video(12);
    let out = dir.path().join("out");
    let (input, results) = (video.to_str().unwrap(), out.to_str().unwrap());
    let config = dir.path().join("short.toml");
    fs::write(&config, "[field]\nsteps = 40\nfinal_steps = 60\n").unwrap();
    let config = config.to_str().unwrap();
    let run = ["run", input, "--out", results, "--masks", "all", "--config", config, "--no-refine"];
    assert!(bundlesdf(&run).status.success());
    // A refinement needs the images again, not the masks.
    fs::remove_dir_all(video.join("masks")).unwrap();
    let read = |name: &str| fs::read(out.join(name)).unwrap();
    let names = ["mesh.ply", "mesh.obj", "mesh.glb"];
    let before = names.map(read);
    let poses: Vec<_> = files(&out.join("ob_in_cam")).iter().map(|f| fs::read(f).unwrap()).collect();

    let output = bundlesdf(&["refine", results, "--steps", "60"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let refined = files(&out.join("ob_in_cam_refined"));
    assert_eq!(refined.len(), 12);
    assert!(refined.iter().all(|f| rgbd_io::poses::read_pose(f).is_ok()));
    assert!(out.join("keyframes_refined.json").exists());
    // The run's own results stay; its mesh has another name, and the textured mesh is that of the new one.
    let kept: Vec<_> = files(&out.join("ob_in_cam")).iter().map(|f| fs::read(f).unwrap()).collect();
    assert_eq!(kept, poses);
    assert_eq!([read("mesh_online.ply"), read("mesh_online.obj")], [before[0].clone(), before[1].clone()]);
    for (name, before) in names.iter().zip(&before) {
        assert!(read(name) != *before, "{name} is still that of the run");
    }
    // A second refinement keeps the run's mesh, not the first refinement's.
    assert!(bundlesdf(&["refine", results, "--steps", "40"]).status.success());
    assert_eq!(read("mesh_online.ply"), before[0]);
}

#[test]
fn the_demo_scores_the_run_and_its_refinement_once_each() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let config = dir.path().join("short.toml");
    fs::write(&config, "[field]\nsteps = 20\nfinal_steps = 20\nrefine_steps = 20\n").unwrap();
    let (results, config) = (out.to_str().unwrap(), config.to_str().unwrap());
    let output = bundlesdf(&["demo", "--out", results, "--frames", "5", "--config", config]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let printed = String::from_utf8(output.stdout).unwrap();
    let line = |name: &str| printed.lines().find(|l| l.starts_with(name) && l.contains("ADD AUC")).unwrap();
    let page = fs::read_to_string(out.join("report.html")).unwrap();
    let mut scores = Vec::new();
    for (name, file) in [("online", "eval.json"), ("refined", "eval_refined.json")] {
        let read: serde_json::Value = serde_json::from_slice(&fs::read(out.join(file)).unwrap()).unwrap();
        let add = read["add"].as_f64().unwrap();
        assert!(add > 50.0 && line(name).contains(&format!("ADD AUC {add:.2}")), "{printed}");
        scores.push(format!("{add:.1}"));
    }
    assert!(page.contains(&format!("ADD AUC against the truth; {} while the video ran", scores[0])));

    // A refinement on its own leaves the run's scores alone.
    let before = fs::read(out.join("eval.json")).unwrap();
    fs::remove_file(out.join("eval_refined.json")).unwrap();
    assert!(bundlesdf(&["refine", results, "--steps", "10"]).status.success());
    assert_eq!(fs::read(out.join("eval.json")).unwrap(), before);
    assert!(out.join("eval_refined.json").is_file());
}

#[test]
fn errors_follow_the_log_and_have_no_colours_off_a_terminal() {
    let text = bundlesdf(&["report", "nowhere"]);
    assert_eq!(text.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&text.stderr).starts_with("error: nowhere: holds no run.json"));
    let json = bundlesdf(&["--json-log", "draw", "nowhere"]);
    let event: serde_json::Value = serde_json::from_slice(&json.stderr).unwrap();
    assert_eq!((&event["event"], &event["exit_code"]), (&"error".into(), &2.into()));
    let both = bundlesdf(&["--json-log", "-v", "report", "nowhere"]);
    assert_eq!(both.status.code(), Some(2));
}

#[test]
fn shells_and_man_learn_every_command() {
    let commands = ["demo", "run", "check", "report", "draw"];
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let script = String::from_utf8(bundlesdf(&["completions", shell]).stdout).unwrap();
        assert!(commands.iter().all(|c| script.contains(c)), "{shell}");
    }
    let page = String::from_utf8(bundlesdf(&["man"]).stdout).unwrap();
    assert!(page.contains(".TH") && page.contains("Exit codes"));
    let dir = tempfile::tempdir().unwrap();
    assert!(bundlesdf(&["man", "--out", dir.path().to_str().unwrap()]).status.success());
    for command in commands {
        assert!(dir.path().join(format!("bundlesdf-{command}.1")).is_file(), "{command}");
    }
}

#[test]
fn check_accepts_a_good_video_and_names_what_is_wrong_with_a_bad_one() {
    let (_dir, video) = video(4);
    let path = video.to_str().unwrap();
    let good = bundlesdf(&["check", path]);
    assert_eq!(good.status.code(), Some(0), "{}", String::from_utf8_lossy(&good.stdout));
    fs::remove_file(video.join("cam_K.txt")).unwrap();
    let bad = bundlesdf(&["check", path]);
    assert_eq!(bad.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&bad.stdout).contains("cam_K.txt"));
}

#[test]
fn a_missing_folder_is_named() {
    let dir = tempfile::tempdir().unwrap();
    refused(&dir.path().join("nowhere"), &["nowhere"]);
}

#[test]
fn a_video_without_frames_is_refused() {
    let (_dir, video) = video(2);
    files(&video.join("rgb")).iter().for_each(|f| fs::remove_file(f).unwrap());
    refused(&video, &["rgb"]);
}

#[test]
fn a_missing_first_mask_is_explained() {
    let (_dir, video) = video(2);
    files(&video.join("masks")).iter().for_each(|f| fs::remove_file(f).unwrap());
    refused(&video, &["mask", "first frame"]);
}

#[test]
fn an_empty_first_mask_is_refused() {
    let (_dir, video) = video(2);
    let mask = files(&video.join("masks")).remove(0);
    rgbd_io::write_png_mask(&mask, &rgbd_io::Image::filled(160, 120, 0)).unwrap();
    refused(&video, &[mask.file_name().unwrap().to_str().unwrap()]);
}

#[test]
fn colour_and_depth_of_different_sizes_are_refused() {
    let (_dir, video) = video(2);
    let depth = files(&video.join("depth")).remove(0);
    rgbd_io::write_png_depth(&depth, &rgbd_io::Image::filled(80, 80, 0.5)).unwrap();
    refused(&video, &[depth.file_name().unwrap().to_str().unwrap(), "80"]);
}

#[test]
fn eight_bit_depth_is_refused() {
    let (_dir, video) = video(2);
    let depth = files(&video.join("depth")).remove(0);
    rgbd_io::write_png_mask(&depth, &rgbd_io::Image::filled(160, 120, 200)).unwrap();
    refused(&video, &[depth.file_name().unwrap().to_str().unwrap(), "16"]);
}

#[test]
fn depth_in_metres_is_recognised() {
    let (_dir, video) = video(2);
    for depth in files(&video.join("depth")) {
        // Half a metre stored as if the unit were a metre: 0 or 1.
        rgbd_io::write_png_depth(&depth, &rgbd_io::Image::filled(160, 120, 0.001)).unwrap();
    }
    refused(&video, &["--depth-scale"]);
}

#[test]
fn a_truncated_image_is_named() {
    for frame in [0, 1] {
        let (_dir, video) = video(3);
        let depth = files(&video.join("depth")).remove(frame);
        let bytes = fs::read(&depth).unwrap();
        fs::write(&depth, &bytes[..bytes.len() / 2]).unwrap();
        refused(&video, &[depth.file_name().unwrap().to_str().unwrap()]);
    }
}

#[test]
fn intrinsics_that_are_not_numbers_are_refused() {
    let (_dir, video) = video(2);
    fs::write(video.join("cam_K.txt"), "nan 0 80\n0 100 60\n0 0 1\n").unwrap();
    refused(&video, &["cam_K.txt"]);
}

#[test]
fn a_config_with_an_unknown_key_is_refused() {
    let (dir, video) = video(2);
    let config = dir.path().join("c.toml");
    fs::write(&config, "[graph]\niteration = 3\n").unwrap();
    let out = dir.path().join("out");
    let args = [
        "run",
        video.to_str().unwrap(),
        "--out",
        out.to_str().unwrap(),
        "--config",
        config.to_str().unwrap(),
    ];
    let output = bundlesdf(&args);
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(text.contains("c.toml") && text.contains("iteration"), "{text}");
    assert!(!out.exists());
}
