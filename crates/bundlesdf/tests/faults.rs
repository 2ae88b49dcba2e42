//! Faults put into a video, into the field and into the output folder: tracking goes on, or ends with what there is
//! and a message that names the file and the remedy.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod support;

use std::{
    fs,
    sync::atomic::{AtomicBool, AtomicUsize, Ordering},
    time::{Duration, Instant},
};

use bundlesdf::{
    FrameResult, RunError, RunSoFar, Schedule, Status, Tracker, VideoRun, continue_video,
    evaluate::{Truth, evaluate},
};
use rgbd_io::{Error, Image, Mask, RgbdFrame};
use rgbd_synth::{Masks, Sequence};
use support::{
    Recorder, Video, bundlesdf, command, frames, report, run, run_args, run_with, small, video_folder,
    without_field,
};

/// The frames with a change to some of them, and the true frame number of each.
struct Faulty(Vec<(usize, Result<RgbdFrame, Error>)>);

impl Faulty {
    fn new() -> Self {
        Self(frames(Masks::Every).into_iter().map(Ok).enumerate().collect())
    }

    /// Changes the frames at these places.
    fn at(mut self, places: impl IntoIterator<Item = usize>, change: impl Fn(&mut RgbdFrame)) -> Self {
        for place in places {
            if let Ok(frame) = &mut self.0[place].1 {
                change(frame);
            }
        }
        self
    }

    /// Tracks without a field and returns the results with the true frame numbers.
    fn track(self) -> (VideoRun, Vec<usize>) {
        let (numbers, frames): (Vec<_>, Vec<_>) = self.0.into_iter().unzip();
        (run(Video::new(frames), &without_field(), Schedule::Lockstep), numbers)
    }
}

/// ADD AUC (percent, to 0.1 m) of the results at these places.
fn accuracy(results: &[FrameResult], numbers: &[usize], places: impl IntoIterator<Item = usize>) -> f64 {
    let video = Sequence::tiny();
    // The first frame aligns the two object frames and counts with the others.
    let places: Vec<usize> = std::iter::once(0).chain(places.into_iter().filter(|p| *p > 0)).collect();
    let exact: Vec<_> = places.iter().map(|p| video.cam_from_obj(numbers[*p])).collect();
    let poses: Vec<_> = places.iter().map(|p| results[*p].cam_from_obj).collect();
    let size = (video.spec().width, video.spec().height);
    let truth = Truth { cam_from_obj: &exact, mesh: video.mesh(), intrinsics: video.intrinsics(), size };
    evaluate(&poses, None, 0, &truth).add
}

fn statuses(run: &VideoRun) -> Vec<Status> {
    run.frames.iter().map(|f| f.status).collect()
}

/// All but the faulty places are as good as in a video without faults, up to a few points.
fn survives(faulty: Faulty, places: std::ops::Range<usize>, least: f64) -> VideoRun {
    let (run, numbers) = faulty.track();
    assert_eq!(run.frames.len(), numbers.len(), "every frame has a result");
    for result in &run.frames {
        assert!(result.cam_from_obj.to_homogeneous().iter().all(|v| v.is_finite()), "{}", result.id);
    }
    let others = (0..numbers.len()).filter(|p| !places.contains(p));
    let add = accuracy(&run.frames, &numbers, others);
    assert!(add > least, "ADD {add:.1} after the fault, {:?}", statuses(&run));
    let end = run.frames.last().unwrap();
    assert_ne!(end.status, Status::Lost, "{:?}", statuses(&run));
    run
}

fn no_depth(frame: &mut RgbdFrame) {
    frame.depth = frame.depth.map(|_| 0.0);
}

fn with_mask(frame: &mut RgbdFrame, change: impl Fn(&Mask) -> Mask) {
    frame.mask = frame.mask.as_ref().map(change);
}

#[test]
fn missing_frames_are_bridged() {
    let mut faulty = Faulty::new();
    faulty.0.drain(8..11);
    survives(faulty, 0..0, 85.0);
}

#[test]
fn unreadable_frames_count_as_lost_and_are_named() {
    let mut faulty = Faulty::new();
    for place in 7..9 {
        faulty.0[place].1 = Err(Error::new(format!("depth/{place}.png"), "is truncated", "export it again"));
    }
    let run = survives(faulty, 7..9, 85.0);
    assert_eq!(run.unreadable.len(), 2);
    assert!(run.unreadable[0].to_string().contains("depth/7.png"));
    assert!(statuses(&run)[7..9].iter().all(|s| *s == Status::Lost));
}

#[test]
fn a_panic_in_the_frame_source_costs_one_frame() {
    struct Panics(std::sync::Arc<Video>);
    impl rgbd_io::FrameSource for Panics {
        fn len(&self) -> usize {
            self.0.len()
        }
        fn id(&self, index: usize) -> &str {
            self.0.id(index)
        }
        fn frame(&self, index: usize) -> Result<RgbdFrame, Error> {
            assert_ne!(index, 6, "a decoder's bug");
            self.0.frame(index)
        }
    }
    let source = std::sync::Arc::new(Panics(Video::of(frames(Masks::Every))));
    let run = run(source, &without_field(), Schedule::Lockstep);
    assert_eq!(run.unreadable.len(), 1);
    assert!(run.unreadable[0].to_string().contains("a decoder's bug"));
    assert_ne!(run.frames.last().unwrap().status, Status::Lost);
}

#[test]
fn repeated_frames_change_nothing() {
    let mut faulty = Faulty::new();
    for place in [6, 6, 6, 13] {
        let copy = (faulty.0[place].0, Ok(faulty.0[place].1.clone().unwrap()));
        faulty.0.insert(place, copy);
    }
    survives(faulty, 0..0, 88.0);
}

#[test]
fn frames_out_of_order_are_tracked_at_their_own_poses() {
    let mut faulty = Faulty::new();
    for (a, b) in [(5, 6), (10, 12), (17, 18)] {
        faulty.0.swap(a, b);
    }
    survives(faulty, 0..0, 85.0);
}

#[test]
fn one_frame_without_depth_is_lost_alone() {
    let run = survives(Faulty::new().at([9], no_depth), 9..10, 85.0);
    let lost: Vec<usize> = (0..24).filter(|i| statuses(&run)[*i] == Status::Lost).collect();
    assert_eq!(lost, [9]);
    assert_eq!(run.frames[9].cam_from_obj, run.frames[8].cam_from_obj, "the last good pose stands in");
}

#[test]
fn ten_frames_without_depth_are_survived_and_told() {
    let run = survives(Faulty::new().at(7..17, no_depth), 7..17, 75.0);
    assert!(statuses(&run)[7..17].iter().all(|s| *s == Status::Lost));
    let warning = run.warnings.iter().find(|w| w.kind == bundlesdf::WarningKind::NoDepth).unwrap();
    assert_eq!(warning.frames, 10);
}

#[test]
fn a_hundred_frames_without_depth_are_survived() {
    let mut faulty = Faulty::new();
    let mut dark = faulty.0[8].1.clone().unwrap();
    no_depth(&mut dark);
    for _ in 0..100 {
        faulty.0.insert(9, (8, Ok(dark.clone())));
    }
    let run = survives(faulty, 9..109, 85.0);
    assert_eq!(statuses(&run).iter().filter(|s| **s == Status::Lost).count(), 100);
}

#[test]
fn depth_that_is_no_number_is_missing_depth() {
    let broken = Faulty::new().at(9..12, |f| f.depth = f.depth.map(|_| f32::NAN));
    survives(broken, 9..12, 85.0);
}

#[test]
fn empty_masks_lose_their_frames_only() {
    let run = survives(Faulty::new().at(8..11, |f| with_mask(f, |m| m.map(|_| 0))), 8..11, 85.0);
    assert!(statuses(&run)[8..11].iter().all(|s| *s == Status::Lost));
}

#[test]
fn a_mask_of_the_whole_image_is_survived() {
    survives(Faulty::new().at([9], |f| with_mask(f, |m| m.map(|_| 255))), 9..10, 75.0);
}

#[test]
fn a_flickering_mask_is_survived() {
    let flicker = Faulty::new().at((4..20).filter(|i| i % 2 == 1), |f| with_mask(f, |m| m.map(|_| 0)));
    let (run, numbers) = flicker.track();
    let add = accuracy(&run.frames, &numbers, (0..24).filter(|i| !(4..20).contains(i) || i % 2 == 0));
    assert!(add > 85.0, "{add} {:?}", statuses(&run));
}

#[test]
fn masks_on_another_thing_are_lost_or_weak_and_forgotten() {
    // A patch of the background far from the object.
    let elsewhere =
        |m: &Mask| Image::from_fn(m.width(), m.height(), |x, y| if x < 40 && y < 40 { 255 } else { 0 });
    let run = survives(Faulty::new().at(9..12, |f| with_mask(f, elsewhere)), 9..12, 80.0);
    assert!(statuses(&run)[9..12].iter().all(|s| *s != Status::Tracked), "{:?}", statuses(&run));
    assert!(run.reconstruction.keyframes.iter().all(|k| !(9..12).contains(&k.index)));
}

#[test]
fn a_sudden_change_of_exposure_is_survived() {
    let darker = Faulty::new().at(10..24, |f| f.color = f.color.map(|c| c.map(|v| v / 2)));
    survives(darker, 0..0, 80.0);
    let brighter = Faulty::new().at(10..24, |f| f.color = f.color.map(|c| c.map(|v| v.saturating_mul(2))));
    survives(brighter, 0..0, 75.0);
}

#[test]
fn an_object_that_leaves_and_comes_back_is_found_again() {
    // Out of the image: neither mask nor object, as if the hand had taken it away.
    let gone = |f: &mut RgbdFrame| {
        with_mask(f, |m| m.map(|_| 0));
        f.color = f.color.map(|_| [90; 3]);
        f.depth = f.depth.map(|_| 1.2);
    };
    let run = survives(Faulty::new().at(8..14, gone), 8..14, 75.0);
    assert!(statuses(&run)[8..14].iter().all(|s| *s == Status::Lost));
    assert!(statuses(&run)[14..].iter().any(|s| *s != Status::Lost));
}

#[test]
fn a_first_frame_that_cannot_be_read_ends_the_run_by_name() {
    let mut faulty = Faulty::new();
    faulty.0[0].1 = Err(Error::new("rgb/0.png", "is missing", "export it"));
    let source = Video::new(faulty.0.into_iter().map(|f| f.1));
    let tracker = Tracker::new(without_field(), Schedule::Lockstep).unwrap();
    let error = continue_video(source, RunSoFar::new(tracker), &false.into(), &mut Recorder::default());
    assert!(matches!(error, Err(RunError::Input(e)) if e.to_string().contains("rgb/0.png")));
}

/// A run whose field rounds suffer `hook`.
fn with_rounds(
    hook: impl Fn(usize) -> Result<(), String> + Send + Sync + 'static,
    schedule: Schedule,
) -> VideoRun {
    let tracker = Tracker::with_round_hook(small(), schedule, hook).unwrap();
    run_with(Video::of(support::medium_frames(Masks::Every)), tracker, &mut Recorder::default())
}

#[test]
fn a_panic_in_the_field_is_reported_and_the_next_round_runs() {
    for schedule in [Schedule::Lockstep, Schedule::Realtime] {
        let hook = |round: usize| {
            assert_ne!(round, 0, "injected");
            Ok(())
        };
        let run = with_rounds(hook, schedule);
        let field = &run.reconstruction.field;
        assert_eq!(field.failures.len(), 1, "{schedule:?}");
        assert!(field.failures[0].contains("panic") && field.failures[0].contains("injected"));
        assert!(field.rounds > 0 && run.reconstruction.mesh.is_some(), "{schedule:?}");
        assert!(run.frames.iter().all(|f| f.status != Status::Lost));
    }
}

#[test]
fn a_lost_device_is_reported_and_the_field_comes_back_with_it() {
    let hook = |round: usize| if round == 1 { Err("the device was lost".into()) } else { Ok(()) };
    let run = with_rounds(hook, Schedule::Lockstep);
    let field = &run.reconstruction.field;
    assert_eq!(field.failures, ["the device was lost"]);
    assert!(field.rounds >= 2 && run.reconstruction.mesh.is_some());
}

#[test]
fn a_field_that_always_fails_leaves_the_tracking_alone() {
    let run = with_rounds(|_| Err("no device".into()), Schedule::Lockstep);
    assert!(run.reconstruction.mesh.is_none() && run.reconstruction.field.rounds == 0);
    assert!(!run.reconstruction.field.failures.is_empty());
    let numbers: Vec<usize> = (0..support::MEDIUM).collect();
    assert!(accuracy(&run.frames, &numbers, 0..support::MEDIUM) > 85.0);
}

#[test]
fn failures_of_the_field_are_in_the_report() {
    let run =
        with_rounds(|round| if round == 0 { Err("no device".into()) } else { Ok(()) }, Schedule::Lockstep);
    let report = bundlesdf::RunReport::new(&small(), Schedule::Lockstep, &run);
    let text = serde_json::to_value(&report).unwrap();
    assert_eq!(text["field"]["failures"][0], "no device");
}

#[test]
fn a_stop_during_the_last_round_ends_it_soon_with_the_mesh_so_far() {
    static ROUNDS: AtomicUsize = AtomicUsize::new(0);
    static STOP: AtomicBool = AtomicBool::new(false);
    let mut config = small();
    // Hours, were it not for the stop.
    config.field.final_steps = 100_000;
    config.field.keyframes_per_round = 1000;
    let hook = |round: usize| {
        ROUNDS.store(round, Ordering::SeqCst);
        // The second round is the last one.
        STOP.fetch_or(round == 1, Ordering::SeqCst);
        Ok(())
    };
    let tracker = Tracker::with_round_hook(config, Schedule::Lockstep, hook).unwrap();
    let start = Instant::now();
    let run = RunSoFar::new(tracker);
    let run =
        continue_video(Video::of(support::medium_frames(Masks::Every)), run, &STOP, &mut Recorder::default())
            .unwrap();
    assert_eq!(ROUNDS.load(Ordering::SeqCst), 1);
    assert!(run.interrupted && run.frames.len() == support::MEDIUM);
    assert!(run.reconstruction.mesh.is_some() && run.reconstruction.field.failures.is_empty());
    // Not a bar on speed: the round itself would take hours.
    assert!(start.elapsed() < Duration::from_secs(300));
}

#[test]
fn an_output_that_fails_ends_the_run_with_its_error() {
    let mut observer = Recorder { fail_at: Some(7), ..Recorder::default() };
    let tracker = Tracker::new(without_field(), Schedule::Lockstep).unwrap();
    let source = Video::of(frames(Masks::Every));
    let error = continue_video(source, RunSoFar::new(tracker), &false.into(), &mut observer);
    assert!(matches!(error, Err(RunError::Output(e)) if e.to_string().contains("000007")));
    assert_eq!(observer.frames, 7);
}

#[test]
fn queues_and_memory_pool_keep_their_bounds() {
    let mut config = small();
    config.memory.capacity = 3;
    config.memory.min_swing_deg = 2.0;
    let run = run(Video::of(support::medium_frames(Masks::Every)), &config, Schedule::Realtime);
    assert!(run.reconstruction.keyframes.len() <= 3);
    assert!(run.frames.iter().filter(|f| f.keyframe).count() > 3, "more views than places");
}

/// Waits until the run has written this many poses.
#[cfg(unix)]
fn wait_for_poses(out: &std::path::Path, count: usize, child: &mut std::process::Child) {
    let poses = || {
        fs::read_dir(out.join("ob_in_cam")).map_or(0, |d| {
            d.filter(|e| e.as_ref().unwrap().path().extension().is_some_and(|e| e == "txt")).count()
        })
    };
    while poses() < count {
        assert!(child.try_wait().unwrap().is_none(), "the run ended early");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[cfg(unix)]
fn signal(child: &std::process::Child, name: &str) {
    let sent = std::process::Command::new("kill").args([name, &child.id().to_string()]).status().unwrap();
    assert!(sent.success());
}

#[cfg(unix)]
#[test]
fn ctrl_c_and_sigterm_finish_the_frame_write_everything_and_exit_130() {
    let (dir, video, config) = video_folder(24, Masks::First);
    let whole = dir.path().join("whole");
    assert!(bundlesdf(&run_args(&video, &whole, &config)).status.success());
    for name in ["-INT", "-TERM"] {
        let out = dir.path().join(name);
        let mut child = command(&run_args(&video, &out, &config)).spawn().unwrap();
        wait_for_poses(&out, 5, &mut child);
        signal(&child, name);
        let output = child.wait_with_output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        assert_eq!(output.status.code(), Some(130), "{name}: {text}");
        assert!(text.contains("interrupted") && text.contains("--resume"), "{text}");
        let written = report(&out);
        assert_eq!(written["interrupted"], true);
        let done = written["frames"].as_array().unwrap().len();
        assert!((5..24).contains(&done), "{done}");
        assert_eq!(fs::read_dir(out.join("ob_in_cam")).unwrap().count(), done, "a pose per frame done");
        // Nothing is tracked twice: the run goes on after the frame that was finished.
        let again = bundlesdf(&["run", "--resume", out.to_str().unwrap()]);
        let text = String::from_utf8_lossy(&again.stderr).into_owned();
        assert!(again.status.success() && text.contains(&format!("after {done} of 24")), "{text}");
        assert_eq!(support::results(&out), support::results(&whole), "{name}");
        assert_eq!(report(&out)["interrupted"], false);
    }
}

#[cfg(unix)]
#[test]
fn a_full_disk_is_named_and_the_run_can_go_on() {
    let (dir, video, config) = video_folder(10, Masks::Every);
    let (out, whole) = (dir.path().join("out"), dir.path().join("whole"));
    assert!(bundlesdf(&run_args(&video, &whole, &config)).status.success());
    // No file may grow beyond 16 KiB: the first checkpoint does.
    let script = format!(
        "trap '' XFSZ; ulimit -f 32; exec '{}' {}",
        env!("CARGO_BIN_EXE_bundlesdf"),
        run_args(&video, &out, &config).map(|a| format!("'{a}'")).join(" ")
    );
    let output = std::process::Command::new("sh").args(["-c", &script]).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{text}");
    let error = text.lines().find(|l| l.starts_with("error: ")).unwrap();
    assert!(error.contains("checkpoint") && error.contains("--resume"), "{error}");
    let half = fs::read_dir(out.join("state"))
        .unwrap()
        .filter(|e| e.as_ref().unwrap().file_name().to_str().unwrap().ends_with(".tmp"));
    assert_eq!(half.count(), 0, "nothing half-written stays");
    // Room was made.
    let again = bundlesdf(&["run", "--resume", out.to_str().unwrap()]);
    assert!(again.status.success(), "{}", String::from_utf8_lossy(&again.stderr));
    assert_eq!(support::results(&out), support::results(&whole));
}

#[cfg(unix)]
#[test]
fn an_output_folder_that_vanishes_during_the_run_is_named() {
    let (dir, video, config) = video_folder(24, Masks::Every);
    let out = dir.path().join("out");
    let mut child = command(&run_args(&video, &out, &config)).spawn().unwrap();
    wait_for_poses(&out, 3, &mut child);
    fs::rename(&out, dir.path().join("moved")).unwrap();
    let output = child.wait_with_output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{text}");
    let error = text.lines().find(|l| l.starts_with("error: ")).unwrap();
    assert!(error.contains("out") && error.contains("check"), "{error}");
    // What was written is where it was moved to, and the run goes on there.
    let moved = dir.path().join("moved");
    let again = bundlesdf(&["run", "--resume", moved.to_str().unwrap()]);
    assert!(again.status.success(), "{}", String::from_utf8_lossy(&again.stderr));
    assert_eq!(fs::read_dir(moved.join("ob_in_cam")).unwrap().count(), 24);
}
