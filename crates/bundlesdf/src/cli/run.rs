//! `bundlesdf run`.

use std::{io::Write, process::ExitCode, sync::Arc};

use bundlesdf::{
    Config, OutputFolder, RunReport, Schedule, SegmenterChoice, Status, Tracker, VideoInput, VideoRun,
    input::mask_source, run_tracker, segmenter::OnTrouble,
};
use rgbd_io::{CustomOptions, FrameSource};

use super::{
    EXIT_BAD_INPUT, EXIT_INTERRUPTED, InputArgs, RunArgs, log::Log, progress::Progress, report::write_report,
    stop_flag,
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

/// The video that the arguments name.
fn video_input(args: &RunArgs) -> anyhow::Result<VideoInput> {
    let options = &args.input_options;
    // What reads the results later may be started elsewhere.
    let path = args.input.canonicalize().unwrap_or_else(|_| args.input.clone());
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

/// Tracks a video.
pub(super) fn run(args: &RunArgs, log: Log) -> anyhow::Result<ExitCode> {
    let (config, schedule) = args.how.resolve()?;
    let input = video_input(args)?;
    let source = input.open()?;
    let folder = OutputFolder::create(&args.out, args.force)?;
    let (run, report) = track(source, input, (&config, schedule, &args.how.segmenter), &folder, log)?;
    write_report(&folder, log);
    log.summary(&report, &folder);
    print(&summary(&report, &folder));
    Ok(match run.unreadable.first() {
        _ if run.interrupted => ExitCode::from(EXIT_INTERRUPTED),
        Some(first) => {
            let others = run.unreadable.len() - 1;
            let more = if others > 0 { format!(" (and {others} more frames)") } else { String::new() };
            log.error(&format!("{first}{more}"), EXIT_BAD_INPUT);
            ExitCode::from(EXIT_BAD_INPUT)
        }
        None => ExitCode::SUCCESS,
    })
}

/// Runs the tracker with a progress bar and writes every result.
pub(super) fn track(
    source: Arc<dyn FrameSource>,
    input: VideoInput,
    (config, schedule, segmenter): (&Config, Schedule, &SegmenterChoice),
    folder: &OutputFolder,
    log: Log,
) -> anyhow::Result<(VideoRun, RunReport)> {
    let on_trouble: OnTrouble = Arc::new(move |text: &str| log.warning(text));
    let segmenter = segmenter.build(&*source, on_trouble)?;
    let tracker = Tracker::new(config.clone(), schedule)?.with_segmenter(segmenter);
    let stop = stop_flag();
    log.start(source.len(), &input, folder);
    let mut progress = Progress::new(source.len(), folder, log);
    let run = run_tracker(source, tracker, &stop, &mut progress);
    progress.close();
    let run = run?;
    folder.write_reconstruction(&run.reconstruction)?;
    let report = RunReport { input: Some(input), ..RunReport::new(config, schedule, &run) };
    folder.write_report(&report)?;
    Ok((run, report))
}

/// The closing table.
pub(super) fn summary(report: &RunReport, folder: &OutputFolder) -> String {
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
                "{} (report.html, ob_in_cam/, masks/, mesh.obj, mesh.ply, keyframes.json, run.json)",
                folder.path().display()
            ),
        ),
    ] {
        text.push_str(&format!("{name:<10} {value}\n"));
    }
    for failure in &report.field.failures {
        text.push_str(&format!("{:<10} a field round failed: {failure}\n", "warning"));
    }
    if report.interrupted {
        text.push_str(&format!("{:<10} interrupted: results up to the last frame tracked\n", "warning"));
    }
    text
}

/// Writes to standard output; a reader that has gone away is not an error.
pub(super) fn print(text: &str) {
    let _ = std::io::stdout().write_all(text.as_bytes());
}
