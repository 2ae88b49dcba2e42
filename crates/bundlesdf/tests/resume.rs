//! A run that was stopped at any moment goes on and ends like one that was not.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod support;

use std::{
    fs,
    path::Path,
    time::{Duration, Instant},
};

use bundlesdf::{CheckpointError, Config, RunSoFar, Schedule, Tracker, VideoRun, continue_video};
use rgbd_io::{FrameSource, Image};
use rgbd_synth::Masks;
use support::{
    Random, Recorder, Video, assert_same, bundlesdf, command, folder_of, frames, medium, medium_frames,
    report, results, run, run_args, run_with, small, video_folder,
};

fn builtin() -> Box<dyn mask_tracker::VideoSegmenter> {
    Box::new(mask_tracker::Propagate::default())
}

/// Saves after each of `cuts` frames, restores, goes on to the end, and compares with the run that was not cut.
fn cut_and_compare(video: &std::sync::Arc<Video>, config: &Config, cuts: &[usize]) -> VideoRun {
    let whole = run(video.clone(), config, Schedule::Lockstep);
    for cut in cuts {
        let mut tracker = Tracker::new(config.clone(), Schedule::Lockstep).unwrap();
        let mut results: Vec<_> = (0..*cut).map(|i| tracker.track(&video.frame(i).unwrap())).collect();
        let saved = tracker.save().unwrap();
        drop(tracker);
        let mut tracker =
            Tracker::restore(config.clone(), Schedule::Lockstep, &saved, &**video, builtin()).unwrap();
        assert_eq!(tracker.frames(), *cut);
        // What was restored saves itself to the same bytes: nothing was lost on the way.
        assert_eq!(tracker.save().unwrap(), saved, "cut after {cut}");
        results.extend((*cut..video.len()).map(|i| tracker.track(&video.frame(i).unwrap())));
        let reconstruction = tracker.finish();
        assert_same(
            (&whole.frames, &whole.reconstruction),
            (&results, &reconstruction),
            &format!("cut after {cut}"),
        );
    }
    assert!(whole.reconstruction.field.rounds > 2 && whole.reconstruction.mesh.is_some());
    whole
}

#[test]
fn with_masks_given_a_restored_tracker_goes_on_bit_for_bit() {
    cut_and_compare(&Video::of(medium_frames(Masks::Every)), &small(), &[1, 9]);
}

#[test]
fn with_masks_propagated_a_restored_tracker_goes_on_bit_for_bit() {
    let mut frames = medium_frames(Masks::First);
    // A loss on the way: its traces have to be saved too.
    frames[7].depth = Image::filled(320, 240, 0.0);
    cut_and_compare(&Video::of(frames), &small(), &[2, 8, 11]);
}

#[test]
fn a_tracker_restored_around_a_replaced_keyframe_goes_on_bit_for_bit() {
    const WORSE: usize = 6;
    let mut frames = medium_frames(Masks::Every);
    // The same view twice, the first time with depth in every other stripe.
    let mut worse = frames[WORSE].clone();
    let (width, height) = worse.depth.size();
    worse.depth =
        Image::from_fn(width, height, |x, y| if x / 4 % 2 == 0 { worse.depth[(x, y)] } else { 0.0 });
    frames.insert(WORSE, worse);
    let whole = cut_and_compare(&Video::of(frames), &small(), &[WORSE + 1, WORSE + 2]);
    assert!(whole.frames[WORSE].keyframe && whole.frames[WORSE + 1].keyframe);
    let kept: Vec<_> = whole.reconstruction.keyframes.iter().map(|k| k.index).collect();
    assert!(!kept.contains(&WORSE) && kept.contains(&(WORSE + 1)) && kept[0] == 0, "{kept:?}");
}

#[test]
fn with_the_pose_graph_in_the_fields_place_a_restored_tracker_goes_on_bit_for_bit() {
    let mut config = small();
    bundlesdf::Ablation::Gpg.apply(&mut config);
    let video = Video::of(medium_frames(Masks::Every));
    let whole = run(video.clone(), &config, Schedule::Lockstep);
    let mut recorder = Recorder { keep: true, ..Recorder::default() };
    run_with(video.clone(), Tracker::new(config.clone(), Schedule::Lockstep).unwrap(), &mut recorder);
    let (count, saved) = &recorder.checkpoints[recorder.checkpoints.len() / 2];
    let mut earlier = RunSoFar::restore(&config, Schedule::Lockstep, saved, &*video, builtin()).unwrap();
    earlier.frames = whole.frames[..*count].to_vec();
    let again = continue_video(video, earlier, &false.into(), &mut Recorder::default()).unwrap();
    assert_same((&whole.frames, &whole.reconstruction), (&again.frames, &again.reconstruction), "gpg");
}

#[test]
fn a_checkpoint_of_another_config_or_another_video_is_refused() {
    let video = Video::of(frames(Masks::Every).into_iter().take(6).collect());
    let mut tracker = Tracker::new(small(), Schedule::Lockstep).unwrap();
    (0..6).for_each(|i| drop(tracker.track(&video.frame(i).unwrap())));
    let saved = tracker.save().unwrap();
    let restore = |config: Config, source: &Video| {
        Tracker::restore(config, Schedule::Lockstep, &saved, source, builtin()).map(|t| t.frames())
    };
    assert_eq!(restore(small(), &video).unwrap(), 6);
    let other = Config { seed: 3, ..small() };
    assert!(matches!(restore(other, &video), Err(CheckpointError::OtherRun)));
    let mut changed = frames(Masks::Every);
    changed.iter_mut().for_each(|f| f.depth = f.depth.map(|d| if *d > 0.55 { 0.0 } else { *d }));
    assert!(matches!(restore(small(), &Video::of(changed)), Err(CheckpointError::Changed { .. })));
    assert!(matches!(restore(small(), &Video::of(Vec::new())), Err(CheckpointError::Frame(_))));
}

/// Kills a run after each of the given shares of its time, resumes it, and compares the results; returns how many
/// runs were still going when they were killed.
fn kill_and_resume(shares: impl Iterator<Item = f64>, frames: usize, masks: Masks) -> usize {
    let (dir, video, config) = folder_of(&medium(masks).truncated(frames));
    let whole = dir.path().join("whole");
    let start = Instant::now();
    assert!(bundlesdf(&run_args(&video, &whole, &config)).status.success());
    let time = start.elapsed().as_secs_f64();
    assert!(report(&whole)["field"]["rounds"].as_u64().unwrap() > 2, "nothing to lose but frames");
    let expected = results(&whole);
    let mut hits = 0;
    for (i, share) in shares.enumerate() {
        let out = dir.path().join(format!("out{i}"));
        let mut child = command(&run_args(&video, &out, &config)).spawn().unwrap();
        std::thread::sleep(Duration::from_secs_f64(share * time));
        let early = child.try_wait().unwrap().is_none();
        child.kill().unwrap();
        child.wait().unwrap();
        hits += usize::from(early);
        if !out.join("state/manifest.json").exists() && !out.join("run.json").exists() {
            // Killed before anything was begun: starting the run is all there is to go on with.
            let again = bundlesdf(&[&run_args(&video, &out, &config)[..], &["--force"]].concat());
            assert!(again.status.success(), "{}", String::from_utf8_lossy(&again.stderr));
        } else {
            // Killed once more on the way, now and then.
            if i % 3 == 2 {
                let mut child = command(&["run", "--resume", out.to_str().unwrap()]).spawn().unwrap();
                std::thread::sleep(Duration::from_secs_f64(0.3 * time));
                child.kill().unwrap();
                child.wait().unwrap();
            }
            let again = bundlesdf(&["run", "--resume", out.to_str().unwrap()]);
            assert!(again.status.success(), "{share}: {}", String::from_utf8_lossy(&again.stderr));
        }
        same_files(&expected, &results(&out), &format!("killed after {share:.3} of the run"));
        assert!(!out.join("state").exists(), "the state of a run that is done is removed");
        fs::remove_dir_all(&out).unwrap();
    }
    hits
}

fn same_files(a: &[(std::path::PathBuf, Vec<u8>)], b: &[(std::path::PathBuf, Vec<u8>)], what: &str) {
    let names =
        |files: &[(std::path::PathBuf, Vec<u8>)]| files.iter().map(|f| f.0.clone()).collect::<Vec<_>>();
    assert_eq!(names(a), names(b), "{what}");
    for (x, y) in a.iter().zip(b) {
        assert!(x.1 == y.1, "{what}: {} differs", x.0.display());
    }
}

#[test]
fn a_run_killed_at_any_moment_is_resumed_to_the_same_files() {
    let hits = kill_and_resume([0.25, 0.55, 0.85].into_iter(), support::MEDIUM, Masks::First);
    assert!(hits > 0, "every run was over before it was killed");
}

/// The bar; minutes long. `cargo test --release -p bundlesdf --test resume -- --ignored --nocapture`
#[test]
#[ignore = "minutes long"]
fn a_run_killed_at_fifty_random_moments_is_resumed_to_the_same_files() {
    let mut random = Random(2026);
    let hits = kill_and_resume((0..50).map(|_| 1.1 * random.next()), support::MEDIUM, Masks::First);
    println!("50 kills, {hits} of them during the run, 50 resumed to identical files");
}

#[test]
fn damaged_checkpoints_are_told_and_an_earlier_point_is_used() {
    let (dir, video, config) = folder_of(&medium(Masks::Every).truncated(12));
    let whole = dir.path().join("whole");
    assert!(bundlesdf(&run_args(&video, &whole, &config)).status.success());
    let stopped = dir.path().join("stopped");
    stop_in_the_middle(&video, &stopped, &config);
    let state = stopped.join("state");
    assert!(state.join("checkpoint.1.bin").exists(), "two checkpoints are kept");
    for damage in 0..3 {
        let out = dir.path().join(format!("damaged{damage}"));
        copy(&stopped, &out);
        let state = out.join("state");
        let newest = state.join("checkpoint.bin");
        let bytes = fs::read(&newest).unwrap();
        fs::write(&newest, &bytes[..bytes.len() / 2]).unwrap();
        if damage > 0 {
            fs::write(state.join("checkpoint.1.bin"), b"rubbish").unwrap();
        }
        if damage > 1 {
            let journal = fs::read(state.join("frames.bin")).unwrap();
            fs::write(state.join("frames.bin"), &journal[..journal.len() / 3]).unwrap();
        }
        let again = bundlesdf(&["run", "--resume", out.to_str().unwrap()]);
        let text = String::from_utf8_lossy(&again.stderr).into_owned();
        assert!(again.status.success(), "{text}");
        assert!(text.contains("checkpoint.bin") && text.contains("damaged"), "{text}");
        assert_eq!(text.contains("after 0 of 12"), damage > 0, "{text}");
        same_files(&results(&whole), &results(&out), &format!("damage {damage}"));
    }
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let target = to.join(path.file_name().unwrap());
        if path.is_dir() {
            copy(&path, &target);
        } else {
            fs::copy(&path, &target).unwrap();
        }
    }
}

/// Starts a run and kills it once it has some frames and two checkpoints.
fn stop_in_the_middle(video: &Path, out: &Path, config: &Path) {
    let mut child = command(&run_args(video, out, config)).spawn().unwrap();
    while !out.join("state/checkpoint.1.bin").exists() {
        assert!(child.try_wait().unwrap().is_none(), "the run ended early");
        std::thread::sleep(Duration::from_millis(5));
    }
    child.kill().unwrap();
    child.wait().unwrap();
}

#[test]
fn what_cannot_be_resumed_is_explained() {
    let (dir, video, config) = folder_of(&medium(Masks::Every).truncated(6));
    let out = dir.path().join("out");
    let resume = |extra: &[&str]| {
        let output = bundlesdf(&[&["run", "--resume", out.to_str().unwrap()], extra].concat());
        (output.status.code().unwrap(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let (code, text) = resume(&[]);
    assert!(code == 2 && text.contains("manifest.json") && text.contains("--force"), "{text}");
    stop_in_the_middle(&video, &out, &config);
    // A folder with a stopped run is not overwritten by accident.
    let (again, text) = {
        let output = bundlesdf(&run_args(&video, &out, &config));
        (output.status.code().unwrap(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    assert!(again == 2 && text.contains("--resume") && text.contains("--force"), "{text}");
    // Settings are those of the first start.
    assert_eq!(resume(&["--schedule", "realtime"]).0, 2);
    // The video was changed in the meantime.
    let last = video.join("rgb/000005.png");
    let aside = dir.path().join("aside.png");
    fs::rename(&last, &aside).unwrap();
    let (code, text) = resume(&[]);
    assert!(code == 2 && text.contains("6") && text.contains("frames"), "{text}");
    fs::rename(&aside, &last).unwrap();
    assert_eq!(resume(&[]).0, 0);
    // Done is done.
    assert_eq!(resume(&[]).0, 0);
    assert_eq!(report(&out)["frames"].as_array().unwrap().len(), 6);
}

#[test]
fn two_runs_never_write_to_one_folder() {
    let (dir, video, config) = video_folder(24, Masks::Every);
    let out = dir.path().join("out");
    let mut first = command(&run_args(&video, &out, &config)).spawn().unwrap();
    while !out.join("state/frames.bin").exists() {
        std::thread::sleep(Duration::from_millis(5));
    }
    let refused = [
        bundlesdf(&["run", "--resume", out.to_str().unwrap()]),
        bundlesdf(&[&run_args(&video, &out, &config)[..], &["--force"]].concat()),
    ];
    first.kill().unwrap();
    first.wait().unwrap();
    for output in refused {
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{text}");
        assert!(text.contains("another run"), "{text}");
    }
}

#[test]
fn deterministic_runs_agree_for_any_number_of_threads_and_tell_their_seed() {
    let (dir, video, config) = folder_of(&medium(Masks::First).truncated(9));
    let mut all = Vec::new();
    for (i, threads) in ["1", "3"].iter().enumerate() {
        let out = dir.path().join(format!("out{i}"));
        let output =
            command(&run_args(&video, &out, &config)).env("RAYON_NUM_THREADS", threads).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        assert!(report(&out)["config"]["seed"].is_u64());
        assert!(out.join("mesh.ply").exists());
        all.push(results(&out));
    }
    same_files(&all[0], &all[1], "1 and 3 threads");
}
