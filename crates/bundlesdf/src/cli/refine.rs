//! `bundlesdf refine`.

use std::{io::IsTerminal, path::PathBuf, process::ExitCode, sync::atomic::AtomicBool};

use anyhow::Context;
use bundlesdf::{
    OutputFolder, RunReport,
    config::Refiner,
    refine::{Progress, RefineError, RefineOptions, Refined, refine as refine_run},
};
use clap::Args;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use super::{
    EXIT_INTERRUPTED, export,
    log::Log,
    report::write_report,
    run::print,
    stop_flag,
    truth::{self, write_refined_scores},
};

#[derive(Args, Debug)]
pub(super) struct RefineArgs {
    /// Folder of a run that has ended. Adds ob_in_cam_refined/ and keyframes_refined.json and replaces the mesh, also
    /// the textured one if there is one; the run's own poses stay, and its mesh as mesh_online.ply and mesh_online.obj.
    out: PathBuf,
    /// Bridge the holes of the mesh where the object was never seen: watertight.
    #[arg(long)]
    close: bool,
    /// Training steps of each of the two rounds of the field, instead of what the run's config says.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    steps: Option<u32>,
    /// Edge of a marching-cubes cell, instead of four fifths of the run's `mesh.spacing`.
    #[arg(long, value_name = "METRES")]
    spacing: Option<f32>,
}

/// Refines a run and prints what changed.
pub(super) fn refine(args: &RefineArgs, log: Log) -> anyhow::Result<ExitCode> {
    if let Some(spacing) = args.spacing {
        let usable = spacing.is_finite() && spacing > 0.0;
        anyhow::ensure!(usable, "--spacing must be above 0 metres, is {spacing}");
    }
    let folder = OutputFolder::open(&args.out)?;
    let report = folder.read_report()?;
    let mut options = RefineOptions { close: args.close, ..RefineOptions::of(&report.config) };
    options.spacing = args.spacing.unwrap_or(options.spacing);
    if let Some(steps) = args.steps {
        options.field.steps = steps as usize;
    }
    let refined = match improve(&report, &folder, &options, &stop_flag(), log) {
        Err(error) if is_stop(&error) => {
            eprintln!("error: {error}");
            return Ok(ExitCode::from(EXIT_INTERRUPTED));
        }
        other => other?,
    };
    if let Err(error) = write_refined_scores(&report, &folder, &refined) {
        log.warning(&format!("not scored against the truth: {error}"));
    }
    // The report shows this file: it must not be the mesh from before.
    if folder.path().join("mesh.glb").is_file() {
        export::at_the_end(&report, &folder, log);
    }
    write_report(&folder, log);
    print(&summary(&refined, &folder));
    print(&truth::lines(&folder));
    Ok(ExitCode::SUCCESS)
}

/// The refinement at the end of a run, unless it was cut short or has nothing to refine. The results of the run are all
/// there without it: a failure is a warning.
pub(super) fn at_the_end(
    report: &RunReport,
    folder: &OutputFolder,
    stop: &AtomicBool,
    log: Log,
) -> Option<Refined> {
    if report.interrupted || report.keyframes == 0 || report.config.field.refiner != Refiner::Field {
        return None;
    }
    match improve(report, folder, &RefineOptions::of(&report.config), stop, log) {
        Ok(refined) => Some(refined),
        Err(error) => {
            let again = folder.path().display();
            log.warning(&format!("not refined: {error}; `bundlesdf refine {again}` tries again"));
            None
        }
    }
}

/// Refines a run and writes the results.
fn improve(
    report: &RunReport,
    folder: &OutputFolder,
    options: &RefineOptions,
    stop: &AtomicBool,
    log: Log,
) -> anyhow::Result<Refined> {
    let input = report.input.as_ref().with_context(|| {
        let folder = folder.path().display();
        format!("{folder}: run.json doesn't say where the video is; run it again with `bundlesdf run`")
    })?;
    // The run has a mask for every frame; those of the video may not be there any more.
    let source = input.open_without_masks()?;
    let bar = Bar::new(log);
    let refined = refine_run(folder, &*source, options, stop, &|at| bar.show(at));
    bar.0.finish_and_clear();
    let refined = refined?;
    folder.write_refined(&refined)?;
    log.refined(&refined, folder);
    Ok(refined)
}

fn is_stop(error: &anyhow::Error) -> bool {
    matches!(error.downcast_ref(), Some(RefineError::Stopped))
}

/// The bar of the stage under way.
struct Bar(ProgressBar);

impl Bar {
    fn new(log: Log) -> Self {
        let terminal = log == Log::Text && std::io::stderr().is_terminal();
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

/// One line for the table of a run.
pub(super) fn line(refined: &Refined) -> String {
    let (frames, keyframes) = (refined.frames.len(), refined.keyframes.len());
    let measured = refined.frames.iter().filter(|f| f.measured).count();
    let seconds = refined.wall.as_secs_f64();
    format!(
        "{:<10} {frames} frames ({measured} measured) and {keyframes} keyframes in {seconds:.1} s\n",
        "refined"
    )
}
