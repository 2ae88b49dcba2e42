//! `bundlesdf refine`.

use std::{io::IsTerminal, path::PathBuf, process::ExitCode};

use anyhow::Context;
use bundlesdf::{
    OutputFolder, RunReport, Status, VideoInput,
    evaluate::{Scores, Truth, evaluate},
    refine::{Progress, RefineError, RefineOptions, Refined, refine as refine_run},
};
use clap::Args;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use rgbd_synth::Sequence;

use super::{EXIT_INTERRUPTED, export, log::Log, report::write_report, run::print, stop_flag};

#[derive(Args, Debug)]
pub(super) struct RefineArgs {
    /// Folder of a run that has ended. Adds ob_in_cam_refined/ and keyframes_refined.json and replaces the mesh, also
    /// the textured one if there is one; the run's own poses stay, and its mesh as mesh_online.ply and mesh_online.obj.
    out: PathBuf,
    /// Bridge the holes of the mesh where the object was never seen: watertight.
    #[arg(long)]
    close: bool,
    /// Training steps of the field.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    steps: Option<u32>,
    /// Edge of a marching-cubes cell.
    #[arg(long, value_name = "METRES", default_value_t = 0.002)]
    spacing: f32,
}

/// Refines a run and prints what changed.
pub(super) fn refine(args: &RefineArgs, log: Log) -> anyhow::Result<ExitCode> {
    anyhow::ensure!(
        args.spacing.is_finite() && args.spacing > 0.0,
        "--spacing must be above 0 metres, is {}",
        args.spacing
    );
    let folder = OutputFolder::open(&args.out)?;
    let mut options = RefineOptions { close: args.close, spacing: args.spacing, ..RefineOptions::default() };
    if let Some(steps) = args.steps {
        options.field.steps = steps as usize;
    }
    let bar = Bar::new();
    let report = folder.read_report()?;
    let input = report.input.as_ref().with_context(|| {
        let folder = folder.path().display();
        format!("{folder}: run.json doesn't say where the video is; run it again with `bundlesdf run`")
    })?;
    let source = input.open()?;
    let refined = refine_run(&folder, &*source, &options, &stop_flag(), &|at| bar.show(at));
    bar.0.finish_and_clear();
    let refined = match refined {
        Err(RefineError::Stopped) => {
            eprintln!("error: {}", RefineError::Stopped);
            return Ok(ExitCode::from(EXIT_INTERRUPTED));
        }
        other => other?,
    };
    folder.write_refined(&refined)?;
    // The report shows this file: it must not be the mesh from before.
    if folder.path().join("mesh.glb").is_file() {
        export::at_the_end(&report, &folder, log);
    }
    write_report(&folder, log);
    print(&summary(&refined, &folder));
    print(&truth_lines(&report, &folder, &refined)?);
    Ok(ExitCode::SUCCESS)
}

/// The bar of the stage under way.
struct Bar(ProgressBar);

impl Bar {
    fn new() -> Self {
        let terminal = std::io::stderr().is_terminal();
        let target = if terminal { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() };
        let bar = ProgressBar::with_draw_target(Some(1), target);
        if let Ok(style) = ProgressStyle::with_template("{spinner} {msg} {pos}/{len} [{wide_bar}] eta {eta}")
        {
            bar.set_style(style.progress_chars("=> "));
        }
        Self(bar)
    }

    fn show(&self, at: Progress) {
        let (stage, done, all) = match at {
            Progress::Reading(done, all) => ("reading keyframes", done, all),
            Progress::Training(done, all) => ("training steps", done, all),
            Progress::Frames(done, all) => ("frames", done, all),
        };
        if self.0.message() != stage {
            self.0.set_message(stage);
            self.0.reset();
        }
        self.0.set_length(all as u64);
        self.0.set_position(done as u64);
    }
}

fn summary(refined: &Refined, folder: &OutputFolder) -> String {
    let mesh = &refined.mesh;
    let closed = if mesh.is_watertight() { "watertight" } else { "open where nothing was seen" };
    let measured = refined.frames.iter().filter(|f| f.measured).count();
    let mut text = String::new();
    for (name, value) in [
        ("frames", format!("{} ({measured} measured, others interpolated)", refined.frames.len())),
        ("keyframes", refined.keyframes.len().to_string()),
        (
            "time",
            format!(
                "{:.1} s in all, {:.1} s of it training",
                refined.wall.as_secs_f64(),
                refined.training.as_secs_f64()
            ),
        ),
        ("mesh", format!("{} vertices, {} faces, {closed}", mesh.vertices.len(), mesh.triangles.len())),
        (
            "results",
            format!(
                "{} (ob_in_cam_refined/, keyframes_refined.json, mesh.ply, mesh.obj; before: mesh_online.ply)",
                folder.path().display()
            ),
        ),
    ] {
        text.push_str(&format!("{name:<10} {value}\n"));
    }
    text
}

/// Scores before and after, where the video is synthetic and its truth known.
fn truth_lines(report: &RunReport, folder: &OutputFolder, refined: &Refined) -> anyhow::Result<String> {
    let Some(VideoInput::Synthetic { name, .. }) = &report.input else { return Ok(String::new()) };
    let video = if name == "demo" { Some(Sequence::demo()) } else { Sequence::named(name) };
    let Some(video) = video else { return Ok(String::new()) };
    let exact: Vec<_> = (0..report.frames.len()).map(|i| video.cam_from_obj(i)).collect();
    let truth = Truth {
        cam_from_obj: &exact,
        mesh: video.mesh(),
        intrinsics: video.intrinsics(),
        size: (video.spec().width, video.spec().height),
    };
    let online =
        report.frames.iter().map(|f| folder.read_pose(&f.id)).collect::<Result<Vec<_>, rgbd_io::Error>>()?;
    let lost = report.count(Status::Lost);
    let online_mesh = folder.read_online_mesh()?;
    let before = evaluate(&online, online_mesh.as_ref(), lost, &truth);
    let poses: Vec<_> = refined.frames.iter().map(|f| f.cam_from_obj).collect();
    let unmeasured = refined.frames.iter().filter(|f| !f.measured).count();
    let after = evaluate(&poses, Some(&refined.mesh), unmeasured, &truth);
    let line = |name: &str, s: &Scores| {
        let chamfer = s.cd_cm.map_or_else(String::new, |cd| format!(", chamfer {cd:.2} cm"));
        format!("{name:<10} ADD AUC {:.2}, ADD-S AUC {:.2} (0 to 0.1 m, percent){chamfer}", s.add, s.add_s)
    };
    Ok(format!(
        "{}, {lost} lost\n{}, {unmeasured} not measured\n",
        line("online", &before),
        line("refined", &after)
    ))
}
