//! What the tests of faults, resuming, load and memory share.
#![allow(dead_code, clippy::unwrap_used, clippy::expect_used, unreachable_pub)]

use std::{
    path::{Path, PathBuf},
    process::{Command, Output, Stdio},
    sync::{Arc, atomic::AtomicBool},
};

use bundlesdf::{
    Config, FrameResult, Observer, Reconstruction, RunSoFar, Schedule, Tracker, VideoRun, continue_video,
};
use rgbd_io::{Error, FrameSource, RgbdFrame};
use rgbd_synth::{Masks, Sequence, SequenceSpec, write_custom};

/// Settings for some twenty frames of 160x120: several short rounds.
pub fn small() -> Config {
    let mut config = Config::default();
    config.memory.min_swing_deg = 5.0;
    config.field.first_round_keyframes = 3;
    config.field.keyframes_per_round = 2;
    config.field.steps = 30;
    config.field.final_steps = 40;
    config.field.refine_steps = 20;
    config.mesh.spacing = 0.005;
    config
}

/// The same as a config file.
pub const SMALL_TOML: &str = "[memory]\nmin_swing_deg = 5.0\n[field]\nfirst_round_keyframes = 3\n\
    keyframes_per_round = 2\nsteps = 30\nfinal_steps = 40\nrefine_steps = 20\n[mesh]\nspacing = 0.005\n";

/// The same without a field, for tests that are about something else.
pub fn without_field() -> Config {
    let mut config = small();
    config.field.refiner = bundlesdf::config::Refiner::None;
    config
}

/// All frames of a sequence, rendered once for each choice of masks.
pub fn frames(masks: Masks) -> Vec<RgbdFrame> {
    let video = Sequence::tiny().with_masks(masks);
    (0..video.len()).map(|i| video.render(i).frame).collect()
}

/// Frames of [`medium`].
pub const MEDIUM: usize = 14;

/// The tiny sequence at twice its resolution, where enough is matched for many keyframes and rounds.
pub fn medium(masks: Masks) -> Sequence {
    let spec = Sequence::tiny().spec().clone();
    let intrinsics = spec.intrinsics.scaled(2.0, 2.0);
    let spec = SequenceSpec { frames: MEDIUM, width: 320, height: 240, intrinsics, masks, ..spec };
    Sequence::new(spec).unwrap()
}

/// Its frames.
pub fn medium_frames(masks: Masks) -> Vec<RgbdFrame> {
    let video = medium(masks);
    (0..video.len()).map(|i| video.render(i).frame).collect()
}

/// A video in memory; an `Err` is a frame that can't be read.
pub struct Video {
    ids: Vec<String>,
    frames: Vec<Result<RgbdFrame, Error>>,
}

impl Video {
    /// Frames under their own names, made unique by their place.
    pub fn new(frames: impl IntoIterator<Item = Result<RgbdFrame, Error>>) -> Arc<Self> {
        let mut video = Self { ids: Vec::new(), frames: Vec::new() };
        for (i, frame) in frames.into_iter().enumerate() {
            let id = format!("{i:06}");
            video.frames.push(frame.map(|f| RgbdFrame { id: id.clone(), ..f }));
            video.ids.push(id);
        }
        Arc::new(video)
    }

    pub fn of(frames: Vec<RgbdFrame>) -> Arc<Self> {
        Self::new(frames.into_iter().map(Ok))
    }
}

impl FrameSource for Video {
    fn len(&self) -> usize {
        self.ids.len()
    }

    fn id(&self, index: usize) -> &str {
        self.ids.get(index).map_or("", String::as_str)
    }

    fn frame(&self, index: usize) -> Result<RgbdFrame, Error> {
        self.frames.get(index).cloned().unwrap_or_else(|| Err(Error::new("end", "is past it", "stop before")))
    }
}

/// Keeps every checkpoint and every message.
#[derive(Default)]
pub struct Recorder {
    /// Frames done, and the bytes.
    pub checkpoints: Vec<(usize, Vec<u8>)>,
    pub warnings: Vec<bundlesdf::Warning>,
    pub frames: usize,
    pub keep: bool,
    /// An error in place of this frame's results.
    pub fail_at: Option<usize>,
}

impl Observer for Recorder {
    fn frame(&mut self, _: &FrameResult, _: &Tracker) -> Result<(), Error> {
        if self.fail_at == Some(self.frames) {
            return Err(Error::new("out/000007.txt", "can't be written (disk full)", "free some space"));
        }
        self.frames += 1;
        Ok(())
    }

    fn warning(&mut self, warning: &bundlesdf::Warning) {
        self.warnings.push(warning.clone());
    }

    fn keeps_checkpoints(&self) -> bool {
        self.keep
    }

    fn checkpoint(&mut self, saved: &[u8]) -> Result<(), Error> {
        self.checkpoints.push((self.frames, saved.to_vec()));
        Ok(())
    }
}

/// Runs a video to its end.
pub fn run(source: Arc<dyn FrameSource>, config: &Config, schedule: Schedule) -> VideoRun {
    run_with(source, Tracker::new(config.clone(), schedule).unwrap(), &mut Recorder::default())
}

pub fn run_with(source: Arc<dyn FrameSource>, tracker: Tracker, observer: &mut dyn Observer) -> VideoRun {
    continue_video(source, RunSoFar::new(tracker), &AtomicBool::new(false), observer).unwrap()
}

/// Poses, judgements, keyframes and mesh are the same bit for bit.
pub fn assert_same(a: (&[FrameResult], &Reconstruction), b: (&[FrameResult], &Reconstruction), what: &str) {
    assert_eq!(a.0.len(), b.0.len(), "{what}");
    for (x, y) in a.0.iter().zip(b.0) {
        assert_eq!(x.cam_from_obj, y.cam_from_obj, "{what}: pose of {}", x.id);
        let judged =
            |r: &FrameResult| (r.id.clone(), r.status, r.inliers, r.keyframe, r.depth_agreement.to_bits());
        assert_eq!(judged(x), judged(y), "{what}");
    }
    let keyframes = |r: &Reconstruction| -> Vec<_> {
        r.keyframes.iter().map(|k| (k.index, k.obj_from_cam, k.refined_by_field)).collect()
    };
    assert_eq!(keyframes(a.1), keyframes(b.1), "{what}");
    assert_eq!(a.1.mesh, b.1.mesh, "{what}");
    assert_eq!(a.1.field.rounds, b.1.field.rounds, "{what}");
}

/// A folder with the first `frames` frames of the tiny sequence and a config file beside it.
pub fn video_folder(frames: usize, masks: Masks) -> (tempfile::TempDir, PathBuf, PathBuf) {
    folder_of(&Sequence::tiny().truncated(frames).with_masks(masks))
}

/// A folder with a sequence and a config file beside it.
pub fn folder_of(sequence: &Sequence) -> (tempfile::TempDir, PathBuf, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let (video, config) = (dir.path().join("video"), dir.path().join("small.toml"));
    write_custom(sequence, &video).unwrap();
    std::fs::write(&config, SMALL_TOML).unwrap();
    (dir, video, config)
}

/// `bundlesdf` with these arguments, not yet started.
pub fn command(args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_bundlesdf"));
    command.args(args).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

pub fn bundlesdf(args: &[&str]) -> Output {
    command(args).output().unwrap()
}

/// The arguments of a run of `video` into `out`.
pub fn run_args<'a>(video: &'a Path, out: &'a Path, config: &'a Path) -> [&'a str; 7] {
    let text = |p: &'a Path| p.to_str().unwrap();
    ["run", text(video), "--out", text(out), "--config", text(config), "--deterministic"]
}

/// Every result file of a run, by its path in the folder, except those that hold times.
pub fn results(out: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut files = Vec::new();
    for folder in ["ob_in_cam", "masks", ""] {
        for entry in std::fs::read_dir(out.join(folder)).unwrap() {
            let path = entry.unwrap().path();
            let has_times =
                ["run.json", "report.html", "export.json"].iter().any(|name| path.ends_with(name));
            if path.is_file() && !has_times {
                files.push((path.strip_prefix(out).unwrap().to_owned(), std::fs::read(&path).unwrap()));
            }
        }
    }
    files.sort();
    files
}

pub fn report(out: &Path) -> serde_json::Value {
    serde_json::from_slice(&std::fs::read(out.join("run.json")).unwrap()).unwrap()
}

/// A small random generator: tests have seeds too.
pub struct Random(pub u64);

impl Random {
    /// From 0 to below 1 (SplitMix64).
    pub fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let x = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((x ^ (x >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }
}
