//! `bundlesdf run`.

use std::{
    io::Write,
    path::Path,
    process::ExitCode,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use bundlesdf::{
    Config, Manifest, OutputFolder, RunError, RunReport, RunSoFar, Schedule, SegmenterChoice, StateFolder,
    Status, Tracker, VideoInput, VideoRun, continue_video, export::ExportReport, input::mask_source,
    refine::Refined, segmenter::OnTrouble,
};
use rgbd_io::{CustomOptions, FrameSource};

use super::{
    EXIT_BAD_INPUT, EXIT_INTERRUPTED, HowArgs, InputArgs, RunArgs, export, log::Log, progress::Progress,
    refine, report::write_report, stop_flag, truth::write_scores,
};

/// How the input arguments read a custom folder.
pub(super) fn custom_options(args: &InputArgs) -> CustomOptions {
    CustomOptions {
        masks: mask_source(&args.masks),
        depth_scale: args.depth_scale,
        stride: args.stride as usize,
        first_mask: args.first_mask.clone(),
    }
}

/// The video that the arguments name, in the folder `input`.
fn video_input(args: &RunArgs, input: &Path) -> anyhow::Result<VideoInput> {
    let options = &args.input_options;
    // What reads the results later may be started elsewhere.
    let path = input.canonicalize().unwrap_or_else(|_| input.to_owned());
    let (masks, stride) = (options.masks.clone(), options.stride as usize);
    match (&args.dataset, &args.video) {
        (Some(dataset), Some(video)) => {
            let (dataset, video) = (dataset.clone(), video.clone());
            Ok(VideoInput::Dataset { dataset, root: path, video, masks, stride })
        }
        (Some(_), None) => anyhow::bail!("--dataset needs --video: the name of the sequence"),
        (None, _) => {
            let (first_mask, depth_scale) = (options.first_mask.clone(), options.depth_scale);
            Ok(VideoInput::Folder { path, masks, first_mask, stride, depth_scale })
        }
    }
}

/// Tracks a video, or goes on with one.
pub(super) fn run(args: &RunArgs, log: Log) -> anyhow::Result<ExitCode> {
    let stop = stop_flag();
    let (folder, (run, report)) = match (&args.resume, &args.input, &args.out) {
        (Some(out), _, _) => {
            if is_done(out) {
                return tidy_up(out, &args.how, &stop, log);
            }
            let (state, manifest) = StateFolder::open(out)?;
            let folder = OutputFolder::reopen(out)?;
            let done = go_on(state, &manifest, &folder, &stop, log)?;
            (folder, done)
        }
        (None, Some(input), Some(out)) => {
            let (config, schedule) = args.how.resolve()?;
            let input = video_input(args, input)?;
            let source = input.open()?;
            let folder = OutputFolder::create(out, args.force)?;
            let how = (&config, schedule, &args.how.segmenter);
            let done = track(source, input, how, &folder, &stop, log)?;
            (folder, done)
        }
        _ => anyhow::bail!("give a video and --out, or --resume with an output folder"),
    };
    let products = finish(&report, &folder, &args.how, &stop, log);
    log.summary(&report, &folder);
    print(&summary(&report, &products, &folder));
    Ok(match run.unreadable.first() {
        _ if stop.load(Ordering::SeqCst) => ExitCode::from(EXIT_INTERRUPTED),
        Some(first) => {
            let others = run.unreadable.len() - 1;
            let more = if others > 0 { format!(" (and {others} more frames)") } else { String::new() };
            log.error(&format!("{first}{more}"), EXIT_BAD_INPUT);
            ExitCode::from(EXIT_BAD_INPUT)
        }
        None => ExitCode::SUCCESS,
    })
}

/// What comes after tracking.
#[derive(Default)]
pub(super) struct Products {
    pub(super) refined: Option<Refined>,
    assets: Option<ExportReport>,
}

/// Refines the run, makes the textured mesh and the report.
pub(super) fn finish(
    report: &RunReport,
    folder: &OutputFolder,
    how: &HowArgs,
    stop: &AtomicBool,
    log: Log,
) -> Products {
    let refined = if how.no_refine { None } else { refine::at_the_end(report, folder, stop, log) };
    if let Err(error) = write_scores(report, folder, refined.as_ref()) {
        log.warning(&format!("not scored against the truth: {error}"));
    }
    let stopped = stop.load(Ordering::SeqCst);
    let assets = if how.no_export || stopped { None } else { export::at_the_end(report, folder, log) };
    write_report(folder, log);
    Products { refined, assets }
}

/// A run that is done may lack what comes after tracking: the process may have been killed there.
fn tidy_up(out: &Path, how: &HowArgs, stop: &AtomicBool, log: Log) -> anyhow::Result<ExitCode> {
    if let Ok((state, _)) = StateFolder::open(out) {
        state.remove()?;
    }
    if !out.join("report.html").exists() {
        let folder = OutputFolder::reopen(out)?;
        finish(&folder.read_report()?, &folder, how, stop, log);
    }
    print(&format!("{} is done: there is nothing to go on with\n", out.display()));
    Ok(ExitCode::SUCCESS)
}

/// Whether the run in the folder came to its end.
fn is_done(out: &Path) -> bool {
    let report = OutputFolder::open(out).and_then(|folder| folder.read_report());
    report.is_ok_and(|report| !report.interrupted)
}

/// Runs the tracker from the first frame, with a progress bar, and writes every result.
pub(super) fn track(
    source: Arc<dyn FrameSource>,
    input: VideoInput,
    (config, schedule, segmenter): (&Config, Schedule, &SegmenterChoice),
    folder: &OutputFolder,
    stop: &AtomicBool,
    log: Log,
) -> anyhow::Result<(VideoRun, RunReport)> {
    let manifest = Manifest::new(&input, (config, schedule, segmenter), &*source);
    let segmenter = segmenter.build(&*source, on_trouble(log))?;
    let state = StateFolder::create(folder.path(), &manifest)?;
    let run = RunSoFar::new(Tracker::new(config.clone(), schedule)?.with_segmenter(segmenter));
    complete(run, source, state, &manifest, folder, stop, log)
}

fn on_trouble(log: Log) -> OnTrouble {
    Arc::new(move |text: &str| log.warning(text))
}

/// The same from the newest checkpoint of an earlier run.
fn go_on(
    mut state: StateFolder,
    manifest: &Manifest,
    folder: &OutputFolder,
    stop: &AtomicBool,
    log: Log,
) -> anyhow::Result<(VideoRun, RunReport)> {
    let source = manifest.open_input()?;
    let segmenter = || manifest.segmenter.build(&*source, on_trouble(log));
    let earlier = state.earlier(manifest, &*source, &segmenter)?;
    for reason in &earlier.unusable {
        log.warning(&format!("{reason}; going on from an earlier point"));
    }
    let run = match earlier.run {
        Some(run) => run,
        None => {
            let tracker = Tracker::new(manifest.config.clone(), manifest.schedule)?;
            RunSoFar::new(tracker.with_segmenter(segmenter()?))
        }
    };
    log.note(&format!("going on after {} of {} frames", run.frames.len(), source.len()));
    complete(run, source, state, manifest, folder, stop, log)
}

fn complete(
    run: RunSoFar,
    source: Arc<dyn FrameSource>,
    state: StateFolder,
    manifest: &Manifest,
    folder: &OutputFolder,
    stop: &AtomicBool,
    log: Log,
) -> anyhow::Result<(VideoRun, RunReport)> {
    log.start(source.len(), &manifest.input, folder);
    let mut progress = Progress::new(&run, source.len(), folder, state, log);
    let outcome = continue_video(source, run, stop, &mut progress);
    let state = progress.close();
    let run = outcome.map_err(|error| match error {
        RunError::Output(e) => anyhow::Error::from(with_way_on(e, folder)),
        error => error.into(),
    })?;
    folder.write_reconstruction(&run.reconstruction).map_err(|e| with_way_on(e, folder))?;
    let report = RunReport {
        input: Some(manifest.input.clone()),
        ..RunReport::new(&manifest.config, manifest.schedule, &run)
    };
    folder.write_report(&report).map_err(|e| with_way_on(e, folder))?;
    if !run.interrupted {
        state.remove()?;
    }
    Ok((run, report))
}

/// An error in writing is no end: what was written is kept, and the run can go on.
fn with_way_on(error: rgbd_io::Error, folder: &OutputFolder) -> rgbd_io::Error {
    let remedy =
        format!("{}; then go on with `bundlesdf run --resume {}`", error.remedy, folder.path().display());
    rgbd_io::Error::new(error.path, error.problem, remedy)
}

/// The closing table.
pub(super) fn summary(report: &RunReport, products: &Products, folder: &OutputFolder) -> String {
    let statuses = [Status::Tracked, Status::Relocalised, Status::Weak, Status::Lost]
        .map(|s| format!("{} {}", report.count(s), s.as_str()))
        .join(", ");
    let mesh = if report.mesh.faces == 0 {
        "none (too few keyframes, or the field is switched off)".to_owned()
    } else {
        let closed = if report.mesh.watertight { "watertight" } else { "open where nothing was seen" };
        format!("{} vertices, {} faces, {closed}", report.mesh.vertices, report.mesh.faces)
    };
    let field = format!(
        "{} rounds, median {:.1} s for {} steps",
        report.field.rounds,
        report.field.ms_per_round_median / 1e3,
        report.field.steps
    );
    let textured = if products.assets.is_some() { " mesh.glb, textured.obj," } else { "" };
    let refined = if products.refined.is_some() { " ob_in_cam_refined/," } else { "" };
    let mut text = String::new();
    for (name, value) in [
        ("frames", format!("{} ({statuses})", report.frames.len())),
        ("tracking", format!("{:.1} Hz median, {:.1} s in all", report.tracking_hz_median, report.wall_s)),
        ("keyframes", report.keyframes.to_string()),
        ("field", field),
        ("mesh", mesh),
        (
            "results",
            format!(
                "{} (report.html,{textured} ob_in_cam/,{refined} masks/, mesh.obj, mesh.ply, keyframes.json, run.json)",
                folder.path().display()
            ),
        ),
    ] {
        text.push_str(&format!("{name:<10} {value}\n"));
    }
    if let Some(refined) = &products.refined {
        text.push_str(&refine::line(refined));
    }
    for warning in &report.field.warnings {
        text.push_str(&format!("{:<10} {warning}\n", "warning"));
    }
    for failure in &report.field.failures {
        text.push_str(&format!("{:<10} a field round failed: {failure}\n", "warning"));
    }
    for warning in &report.warnings {
        text.push_str(&format!("{:<10} {warning}\n", "warning"));
    }
    if report.interrupted {
        text.push_str(&format!(
            "{:<10} interrupted: results up to the last frame tracked; go on with `bundlesdf run --resume {}`\n",
            "warning",
            folder.path().display()
        ));
    }
    text
}

/// Writes to standard output; a reader that has gone away is not an error.
pub(super) fn print(text: &str) {
    let _ = std::io::stdout().write_all(text.as_bytes());
}
