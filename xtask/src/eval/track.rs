//! Runs a method on a sequence and writes its poses, masks and surface, each in the same layout.

use super::job::Asked;
use super::method::Method;
use super::peer;
use super::video::{Masks, Video};
use anyhow::Context;
use baselines::{Baseline, BaselineConfig, PoseFusion};
use bundlesdf::{
    FrameResult, Observer, OutputFolder, RunReport, Schedule, Status, Tracker, VideoInput, VideoRun,
    refine::{RefineOptions, refine},
    run_video,
};
use marching_cubes::TriMesh;
use rgbd_io::FrameSource;
use serde::Serialize;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

/// Spacing at which a fused surface becomes a mesh, metres; the same as our own system's.
const SPACING: f32 = 0.0025;

/// Runs the job and fills `folder`.
pub(super) fn track(asked: &Asked, folder: &Path) -> anyhow::Result<()> {
    let video = Arc::new(asked.place.open(&asked.masks)?);
    let out = OutputFolder::create(folder, true)?;
    match asked.method {
        Method::Baseline(baseline) => run_baseline(baseline, asked, &video, &out),
        Method::Open3d => peer::run(asked.python.as_deref(), &video, &out, SPACING),
        _ => run_ours(asked, video, &out),
    }
}

/// Writes what the tracker answers.
struct Writer<'a>(&'a OutputFolder);

impl Observer for Writer<'_> {
    fn frame(&mut self, result: &FrameResult, tracker: &Tracker) -> Result<(), rgbd_io::Error> {
        if let Some(mask) = tracker.mask() {
            self.0.write_mask(&result.id, mask)?;
        }
        self.0.write_pose(&result.id, &result.cam_from_obj)
    }

    fn unreadable(&mut self, error: &rgbd_io::Error) {
        eprintln!("warning: {error}; the frame counts as lost");
    }
}

fn run_ours(asked: &Asked, video: Arc<Video>, out: &OutputFolder) -> anyhow::Result<()> {
    let config = asked.config.as_ref().context("the job has no config")?;
    let schedule = asked.schedule.unwrap_or(Schedule::Lockstep);
    let run = run_video(video.clone(), config, schedule, &AtomicBool::new(false), &mut Writer(out))?;
    out.write_reconstruction(&run.reconstruction)?;
    if asked.method == Method::BundleTrack {
        write_mesh(out, &fused(&video, &run, out))?;
    }
    let report = RunReport { input: input(asked), ..RunReport::new(config, schedule, &run) };
    out.write_report(&report)?;
    if asked.method == Method::Refined {
        let stop = AtomicBool::new(false);
        let refined = refine(out, &*video, &RefineOptions::default(), &stop, &|_| {})?;
        out.write_refined(&refined)?;
    }
    Ok(())
}

/// What opens the video again, for the commands that work on finished runs.
fn input(asked: &Asked) -> Option<VideoInput> {
    let place = &asked.place;
    let masks = match &asked.masks {
        Masks::First => "first".to_owned(),
        Masks::Given => "all".to_owned(),
        Masks::Folder(folder) => folder.to_string_lossy().into_owned(),
    };
    let video = place.name.clone();
    // A reduced image can't be asked for there.
    (place.benchmark.scale_divisor() == 1 && place.object.is_none()).then(|| VideoInput::Dataset {
        dataset: place.benchmark.dataset().name().to_owned(),
        root: place.root.clone(),
        video,
        masks,
        stride: place.stride,
    })
}

/// The surface of the frames whose pose is certain, at their poses and with the masks that they were tracked with.
fn fused(video: &Video, run: &VideoRun, out: &OutputFolder) -> TriMesh {
    let mut fusion = PoseFusion::new(&BaselineConfig::default());
    for result in &run.frames {
        if !matches!(result.status, Status::Tracked | Status::Relocalised) {
            continue;
        }
        // What can't be read was lost already.
        if let (Ok(mut frame), Ok(mask)) = (video.frame(result.index), out.read_mask(&result.id)) {
            frame.mask = Some(mask);
            fusion.add(&frame, &result.cam_from_obj);
        }
    }
    fusion.mesh(SPACING)
}

/// The part of `run.json` that the score reads, for methods that aren't ours.
#[derive(Serialize)]
pub(super) struct BaselineReport {
    pub(super) frames: Vec<BaselineFrame>,
    pub(super) tracking_hz_median: f64,
    pub(super) wall_s: f64,
}

#[derive(Serialize)]
pub(super) struct BaselineFrame {
    pub(super) id: String,
    pub(super) status: Status,
}

fn run_baseline(
    baseline: Baseline,
    asked: &Asked,
    video: &Arc<Video>,
    out: &OutputFolder,
) -> anyhow::Result<()> {
    let start = Instant::now();
    let mut tracker = baseline.tracker(&BaselineConfig { seed: asked.repeat, ..BaselineConfig::default() });
    let (mut frames, mut seconds) = (Vec::new(), Vec::new());
    let mut last = None;
    for index in 0..video.len() {
        let id = video.id(index).to_owned();
        let pose = match video.frame(index) {
            Ok(frame) => {
                let begin = Instant::now();
                let pose = tracker.track(&frame);
                seconds.push(begin.elapsed().as_secs_f64());
                last = Some(pose.cam_from_obj);
                if let Some(mask) = &frame.mask {
                    out.write_mask(&id, mask)?;
                }
                pose.tracked
            }
            Err(error) if index == 0 => return Err(error.into()),
            Err(error) => {
                eprintln!("warning: {error}; the frame counts as lost");
                false
            }
        };
        if let Some(cam_from_obj) = &last {
            out.write_pose(&id, cam_from_obj)?;
        }
        frames.push(BaselineFrame { id, status: if pose { Status::Tracked } else { Status::Lost } });
    }
    write_mesh(out, &tracker.mesh(SPACING))?;
    seconds.sort_by(f64::total_cmp);
    let median = seconds.get(seconds.len() / 2).copied().unwrap_or(0.0);
    let hz = if median > 0.0 { 1.0 / median } else { 0.0 };
    let wall_s = start.elapsed().as_secs_f64();
    Ok(out.write_json("run.json", &BaselineReport { frames, tracking_hz_median: hz, wall_s })?)
}

fn write_mesh(out: &OutputFolder, mesh: &TriMesh) -> anyhow::Result<()> {
    if mesh.triangles.is_empty() {
        return Ok(());
    }
    let mut bytes = Vec::new();
    marching_cubes::write_ply(mesh, &mut bytes)?;
    Ok(rgbd_io::poses::write_atomic(&out.path().join("mesh.ply"), &bytes)?)
}
