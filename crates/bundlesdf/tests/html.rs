//! The report page: what is in it, and, where there is a Chromium, whether a browser draws the model.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::{
    fs,
    io::Write,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    time::{Duration, Instant},
};

use bundlesdf::{
    Config, FrameResult, KeyframeReport, OutputFolder, Reconstruction, RoundReport, RunReport, Schedule,
    StageTimes, Status, VideoInput, VideoRun, html::write_page,
};
use marching_cubes::TriMesh;
use rgbd_synth::Sequence;

const FRAMES: usize = 6;

/// The results of a run that found the exact truth, except that it lost the object once.
fn results(root: &Path, mesh: TriMesh) -> OutputFolder {
    let video = Sequence::demo().truncated(FRAMES);
    let folder = OutputFolder::create(root, false).unwrap();
    let mut frames = Vec::new();
    for index in 0..FRAMES {
        let result = FrameResult {
            index,
            id: format!("{index:06}"),
            cam_from_obj: video.cam_from_obj(index),
            status: if index == 3 { Status::Lost } else { Status::Tracked },
            inliers: 40 + index,
            depth_agreement: 0.9,
            uncertainty: None,
            keyframe: index % 2 == 0,
            times: StageTimes { total: Duration::from_millis(40), ..StageTimes::default() },
        };
        folder.write_pose(&result.id, &result.cam_from_obj).unwrap();
        frames.push(result);
    }
    let keyframes: Vec<_> = frames
        .iter()
        .filter(|f| f.keyframe)
        .map(|f| {
            let m = f.cam_from_obj.to_homogeneous();
            KeyframeReport {
                index: f.index,
                id: f.id.clone(),
                cam_from_obj: std::array::from_fn(|r| std::array::from_fn(|c| m[(r, c)])),
                refined_by_field: true,
            }
        })
        .collect();
    let mut reconstruction =
        Reconstruction { mesh: Some(mesh), keyframes: Vec::new(), field: Default::default() };
    let loss = vec![0.5, 0.2, 0.1];
    reconstruction.field.history =
        vec![RoundReport { keyframes: 3, steps: 100, ms: 900.0, loss, terms: Some(Default::default()) }];
    folder.write_reconstruction(&reconstruction).unwrap();
    folder.write_json("keyframes.json", &keyframes).unwrap();
    let run = VideoRun {
        frames,
        reconstruction,
        unreadable: Vec::new(),
        warnings: Vec::new(),
        interrupted: false,
        wall: Duration::from_secs(3),
    };
    let input = VideoInput::Synthetic { name: "demo".into(), masks: "first".into(), frames: FRAMES };
    let report =
        RunReport { input: Some(input), ..RunReport::new(&Config::default(), Schedule::Lockstep, &run) };
    folder.write_report(&report).unwrap();
    folder
}

/// The object in a colour that nothing else on the page has.
fn magenta() -> TriMesh {
    let mut mesh = Sequence::demo().mesh().clone();
    mesh.colors = vec![[255, 0, 255]; mesh.vertices.len()];
    mesh
}

#[test]
fn the_page_has_every_part_and_asks_the_network_for_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let page = fs::read_to_string(write_page(&results(dir.path(), magenta())).unwrap()).unwrap();
    let scripts = page.find("<script").unwrap();
    let body = &page[..page[scripts..].find("model/gltf-binary").unwrap() + scripts];
    for part in [
        "tracked in 5 of 6 frames",
        "in 1 it was lost",
        "Lost in frame 000003.",
        "training loss",
        "milliseconds per frame",
        "side of the first view",
        "Configuration",
        "min_swing_deg",
        "Content-Security-Policy",
    ] {
        assert!(body.contains(part), "{part}");
    }
    assert_eq!(body.matches("src=\"data:image/jpeg;base64,").count(), FRAMES);
    assert!(page.contains("The MIT License") && page.contains("three.js authors"), "the viewer's licence");
    for outside in ["src=\"http", "href=\"http", "src=\"//", "@import", "url("] {
        assert!(!page.contains(outside), "{outside}");
    }
    // Not anywhere: a picture's base64 may well contain the three letters.
    assert!(!body.contains("\"NaN") && !body.contains(">NaN"));
}

#[test]
fn a_video_that_has_moved_is_said_and_the_rest_is_shown() {
    let dir = tempfile::tempdir().unwrap();
    let folder = results(dir.path(), magenta());
    let mut report = folder.read_report().unwrap();
    let gone = dir.path().join("gone");
    report.input = Some(VideoInput::Folder {
        path: gone,
        masks: "first".into(),
        first_mask: None,
        stride: 1,
        depth_scale: 0.001,
    });
    folder.write_report(&report).unwrap();
    let page = fs::read_to_string(write_page(&folder).unwrap()).unwrap();
    assert!(page.contains("can't be opened any more") && page.contains("model/gltf-binary"));
}

#[test]
fn after_a_refinement_the_page_shows_what_goes_with_the_refined_mesh() {
    let dir = tempfile::tempdir().unwrap();
    let folder = results(dir.path(), magenta());
    let page = || fs::read_to_string(write_page(&folder).unwrap()).unwrap();
    let before = page();
    assert!(!before.contains("after the refinement;"));
    // As after a refinement: another mesh than run.json counts, poses of its own.
    let mut report = folder.read_report().unwrap();
    report.mesh.faces = 1_234_567;
    folder.write_report(&report).unwrap();
    folder.write_json("keyframes_refined.json", &folder.read_keyframes().unwrap()).unwrap();
    fs::create_dir(dir.path().join("ob_in_cam_refined")).unwrap();
    for frame in &report.frames {
        let name = format!("{}.txt", frame.id);
        let aside = "1 0 0 0.05\n0 1 0 0\n0 0 1 0.6\n0 0 0 1\n";
        fs::write(dir.path().join("ob_in_cam_refined").join(name), aside).unwrap();
    }
    let after = page();
    assert!(after.contains("after the refinement;") && !after.contains("1\u{202f}234\u{202f}567"));
    let pictures = |page: &str| {
        let parts = page.split("src=\"data:image/jpeg;base64,").skip(1);
        parts.map(|p| p.split('"').next().unwrap().to_owned()).collect::<Vec<_>>()
    };
    assert!(
        pictures(&before).iter().zip(pictures(&after)).all(|(a, b)| *a != b),
        "drawn at the refined poses"
    );
}

/// Says why a test did nothing, past the test runner's capture.
fn skipped(reason: &str) {
    let _ = writeln!(std::io::stderr(), "skipped: the report in a browser: {reason}");
}

fn chromium() -> Option<PathBuf> {
    let names = ["chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome"];
    let folders: Vec<_> = std::env::split_paths(&std::env::var_os("PATH")?).collect();
    names.iter().find_map(|name| folders.iter().map(|f| f.join(name)).find(|p| p.is_file()))
}

/// Opens the page, with a software renderer, and answers what the browser logged; `None` when it gave no picture.
fn photographed(browser: &Path, page: &Path, picture: &Path) -> Option<String> {
    let profile = tempfile::tempdir().unwrap();
    let log = profile.path().join("log");
    let mut child = Command::new(browser)
        .args(["--headless", "--no-sandbox", "--no-first-run", "--disable-background-networking"])
        .args(["--disable-component-update", "--disable-sync", "--disable-quic", "--hide-scrollbars"])
        .args(["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--enable-logging=stderr"])
        .args(["--virtual-time-budget=8000", "--window-size=1000,1400"])
        .arg(format!("--user-data-dir={}", profile.path().join("profile").display()))
        .arg(format!("--screenshot={}", picture.display()))
        .arg(format!("file://{}", page.display()))
        .stdout(Stdio::null())
        .stderr(fs::File::create(&log).unwrap())
        .spawn()
        .ok()?;
    // A browser that hangs is not this project's; it ends here instead of never.
    let start = Instant::now();
    while child.try_wait().unwrap().is_none() {
        if start.elapsed() > Duration::from_secs(240) {
            let _ = child.kill();
            break;
        }
        std::thread::sleep(Duration::from_millis(100));
    }
    let _ = child.wait();
    let text = String::from_utf8_lossy(&fs::read(&log).ok()?).into_owned();
    picture.is_file().then_some(text)
}

#[test]
fn a_browser_draws_the_model_without_an_error() {
    let Some(browser) = chromium() else { return skipped("there is no Chromium in PATH") };
    let dir = tempfile::tempdir().unwrap();
    let page = write_page(&results(&dir.path().join("out"), magenta())).unwrap();
    let picture = dir.path().join("page.png");
    let Some(log) = photographed(&browser, &page.canonicalize().unwrap(), &picture) else {
        return skipped("the browser made no picture");
    };
    let complaints: Vec<_> = log.lines().filter(|l| l.contains("CONSOLE")).collect();
    assert!(complaints.is_empty(), "{complaints:#?}");
    let image = rgbd_io::read_color(&picture).unwrap();
    let is_magenta = |p: &&[u8; 3]| p[0] > 100 && p[2] > 100 && p[1] < p[0] / 2 && p[1] < p[2] / 2;
    let model: Vec<_> = image.pixels().iter().filter(is_magenta).collect();
    assert!(model.len() > 5000, "{} pixels of the model", model.len());
    let shades: std::collections::HashSet<_> = model.iter().map(|p| p[0] / 8).collect();
    assert!(shades.len() > 3, "it is lit: {} shades", shades.len());
}
