//! Arguments, and what each command does with the library.

mod check;
mod complete;
mod demo;
mod draw;
mod export;
mod log;
mod mask;
mod progress;
mod refine;
mod report;
mod run;
mod truth;

use std::{
    path::PathBuf,
    process::ExitCode,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use bundlesdf::FieldDevice;
use clap::{Args, Parser, Subcommand, ValueEnum};

use self::log::Log;

/// Something in the input, the config or the output folder is wrong; the message says what.
const EXIT_BAD_INPUT: u8 = 2;
/// Ended by Ctrl-C or SIGTERM after the frame under way; everything up to it is written.
const EXIT_INTERRUPTED: u8 = 130;

const AFTER_HELP: &str = "\
Examples:
  bundlesdf demo                          track and reconstruct a built-in synthetic video
  bundlesdf check VIDEO                   see what is in a folder and what is wrong with it
  bundlesdf mask VIDEO --box 210,130,180,240
                                          cut the first mask out of a box around the object
  bundlesdf run VIDEO --out OUT           track VIDEO from the mask of its first frame
  bundlesdf run VIDEO --out OUT --masks all --schedule realtime
  bundlesdf run --resume OUT              go on with a run that was stopped
  bundlesdf refine OUT                    improve the mesh and all poses of a run that has ended
  bundlesdf export OUT --canonical --sim  write textured meshes and simulator files of a finished run
  bundlesdf draw OUT --video OUT/poses.gif  draw box, axes and outline over the frames

VIDEO is a folder with rgb/*.png|jpg, depth/*.png (16 bit, millimetres, registered to colour), masks/*.png (at least
the first frame's; white = object) and cam_K.txt (3x3 intrinsics of the colour camera, pixels).

Exit codes: 0 done; 2 wrong arguments, or an input, config or output that can't be used (the message names it; a run
with single unreadable frames ends with it too, after writing its results); 130 interrupted by Ctrl-C or SIGTERM, with
the results up to then written.";

/// Track an unknown object in an RGB-D video and reconstruct it as a mesh.
#[derive(Parser, Debug)]
#[command(name = "bundlesdf", version, about, after_help = AFTER_HELP, arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    /// Log what happens inside: -v the time of every frame and field round, -vv every decision, -vvv everything.
    #[arg(short, long, action = clap::ArgAction::Count, global = true)]
    verbose: u8,
    /// Write one JSON object per line to standard error: frames, rounds, warnings, the summary, errors.
    #[arg(long, global = true)]
    json_log: bool,
}

#[derive(Subcommand, Debug)]
enum Command {
    /// Make a synthetic video, track and reconstruct its object, and score the result against the exact truth.
    Demo(DemoArgs),
    /// Track and reconstruct the object in a video.
    Run(RunArgs),
    /// Refine the results of a run: the mesh, and the poses of all frames against it.
    Refine(refine::RefineArgs),
    /// Look at a video folder: what is in it, what is wrong, and what to do about it.
    Check(CheckArgs),
    /// Make the first frame's mask from a box around the object, or from points on it.
    Mask(mask::MaskArgs),
    /// Turn the results of a run into assets: textured GLB, OBJ, PLY and STL, and bodies for simulators.
    Export(export::ExportArgs),
    /// Write report.html into a results folder again: model, timeline, poses on frames, losses, config.
    Report(ReportArgs),
    /// Draw box, axes and outline of the mesh over the frames of a results folder.
    Draw(DrawArgs),
    /// Print what makes a shell complete this program's arguments.
    Completions(CompletionsArgs),
    /// Print the manual page, or write one for every command.
    Man(ManArgs),
}

#[derive(Args, Debug)]
struct DemoArgs {
    /// Folder for the results; an earlier demo in it is replaced.
    #[arg(long, default_value = "bundlesdf-demo")]
    out: PathBuf,
    /// Track only the first N of the 120 frames.
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// Give the tracker the first frame's mask only, or the true masks of all frames.
    #[arg(long, value_enum, default_value_t = DemoMasks::First)]
    masks: DemoMasks,
    #[command(flatten)]
    how: HowArgs,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum DemoMasks {
    /// The first frame's mask; the others are propagated.
    First,
    /// Every frame's true mask.
    All,
}

#[derive(Args, Debug)]
struct RunArgs {
    /// Folder of the video; with --dataset the folder of the dataset.
    #[arg(required_unless_present = "resume")]
    input: Option<PathBuf>,
    /// The input is a published dataset: ho3d, ycbineoat, behave, bop, tum or custom.
    #[arg(long, value_name = "NAME")]
    dataset: Option<String>,
    /// Name of the sequence in the dataset.
    #[arg(long, value_name = "NAME", requires = "dataset")]
    video: Option<String>,
    /// Folder for the results: report.html, ob_in_cam/, ob_in_cam_refined/, masks/, mesh.obj, mesh.ply, mesh.glb,
    /// textured.obj, keyframes.json, run.json.
    #[arg(long, required_unless_present = "resume")]
    out: Option<PathBuf>,
    /// Go on with the run in this output folder that was stopped: by Ctrl-C, a kill, a full disk. Video and settings
    /// are those it began with, and so is the result.
    #[arg(long, value_name = "OUT", conflicts_with_all = [
        "input", "out", "force", "dataset", "video", "masks", "first_mask", "stride", "depth_scale", "config",
        "ablate", "schedule", "device", "deterministic", "segmenter", "matcher",
    ])]
    resume: Option<PathBuf>,
    /// Replace the results of an earlier run in the folder.
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    input_options: InputArgs,
    #[command(flatten)]
    how: HowArgs,
}

#[derive(Args, Debug)]
struct CheckArgs {
    /// Folder of the video.
    input: PathBuf,
    #[command(flatten)]
    input_options: InputArgs,
}

#[derive(Args, Debug)]
struct ReportArgs {
    /// Folder with the results of a run.
    results: PathBuf,
}

#[derive(Args, Debug)]
struct DrawArgs {
    /// Folder with the results of a run; PNG files go to its draw/.
    results: PathBuf,
    /// Draw every N-th frame.
    #[arg(long, default_value_t = 1, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    every: u32,
    /// Write an animation instead of PNG files: .gif, or .webp, .mp4, .webm where ffmpeg is installed.
    #[arg(long, value_name = "FILE")]
    video: Option<PathBuf>,
    /// Pictures per second of the animation.
    #[arg(long, default_value_t = 15.0, value_name = "N", requires = "video")]
    fps: f64,
    /// What to draw: any of box, axes, contour, mask.
    #[arg(long, default_value = "box,axes,contour", value_name = "LIST", value_parser = layers)]
    what: bundlesdf::draw::Layers,
}

fn layers(list: &str) -> Result<bundlesdf::draw::Layers, String> {
    bundlesdf::draw::Layers::from_names(list)
}

#[derive(Args, Debug)]
struct CompletionsArgs {
    /// The shell.
    shell: clap_complete::Shell,
}

#[derive(Args, Debug)]
struct ManArgs {
    /// Write bundlesdf.1, bundlesdf-run.1 and so on into this folder instead.
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
}

/// How the input is read.
#[derive(Args, Debug)]
struct InputArgs {
    /// Which masks to use: `first` (propagate it), `all` (masks/ has one per frame), or a folder of masks.
    #[arg(long, default_value = "first", value_name = "first|all|FOLDER")]
    masks: String,
    /// The first frame's mask, when it isn't masks/<first frame>.png.
    #[arg(long, value_name = "FILE")]
    first_mask: Option<PathBuf>,
    /// Use every N-th frame.
    #[arg(long, default_value_t = 1, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    stride: u32,
    /// Metres per unit of the depth files.
    #[arg(long, default_value_t = 0.001, value_name = "METRES")]
    depth_scale: f64,
}

/// How tracking is done.
#[derive(Args, Debug)]
struct HowArgs {
    /// TOML file with settings; what it leaves out keeps its default.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Take a part of the system out, as in the paper's table 4: no-memory, no-nof, gpg, no-hybrid-sdf or
    /// no-compact-pool.
    #[arg(long, value_name = "NAME", value_parser = ablation)]
    ablate: Option<bundlesdf::Ablation>,
    /// lockstep: the tracker waits for the field (reproducible). realtime: it never waits.
    #[arg(long, value_enum, default_value_t = ScheduleArg::Lockstep)]
    schedule: ScheduleArg,
    /// Where masks come from: `propagate` (built in), `folder:DIR` (PNG files of any naming and size), or
    /// `command:PROGRAM` (a program fed frames and answering masks, see docs/masks.md).
    #[arg(long, default_value = "propagate", value_name = "HOW")]
    segmenter: bundlesdf::SegmenterChoice,
    /// What compares views that are too far apart for point tracks, instead of what the config says: `classical`
    /// (built in), `edgepoint2:FILE` or `xfeat:FILE` (a network with the file of weights that its authors publish).
    #[arg(long, value_name = "HOW")]
    matcher: Option<matcher::learned::MatcherSpec>,
    /// Where the field is trained, instead of what the config says; auto is a GPU if this build can use one and there
    /// is one, else the CPU.
    #[arg(long, value_enum)]
    device: Option<Device>,
    /// Bit-identical results in every run on one machine (implies lockstep and the CPU).
    #[arg(long)]
    deterministic: bool,
    /// Leave out the refinement at the end (ob_in_cam_refined/, a finer mesh); `bundlesdf refine` makes it later.
    #[arg(long)]
    no_refine: bool,
    /// Leave out the textured mesh at the end (mesh.glb, textured.obj); `bundlesdf export` makes it later.
    #[arg(long)]
    no_export: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum ScheduleArg {
    Lockstep,
    Realtime,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Device {
    Auto,
    Cpu,
    Gpu,
}

fn ablation(name: &str) -> Result<bundlesdf::Ablation, String> {
    bundlesdf::Ablation::from_name(name).ok_or_else(|| {
        let names: Vec<_> = bundlesdf::Ablation::ALL.iter().map(|a| a.name()).collect();
        format!("use one of {}", names.join(", "))
    })
}

impl HowArgs {
    /// The config and schedule that these arguments ask for.
    fn resolve(&self) -> anyhow::Result<(bundlesdf::Config, bundlesdf::Schedule)> {
        anyhow::ensure!(
            !(self.deterministic && self.schedule == ScheduleArg::Realtime),
            "--deterministic needs the lockstep schedule; leave out --schedule realtime"
        );
        let mut config = match &self.config {
            None => bundlesdf::Config::default(),
            Some(path) => {
                let text = std::fs::read_to_string(path).map_err(|e| {
                    anyhow::anyhow!(
                        "{}: can't be read ({e}); give an existing TOML file to --config",
                        path.display()
                    )
                })?;
                bundlesdf::Config::from_toml(&text, &path.display().to_string())?
            }
        };
        if let Some(ablation) = self.ablate {
            ablation.apply(&mut config);
        }
        if let Some(device) = self.device {
            config.field.device = match device {
                Device::Auto => FieldDevice::Auto,
                Device::Cpu => FieldDevice::Cpu,
                Device::Gpu => FieldDevice::Gpu,
            };
        }
        if let Some(spec) = &self.matcher {
            config.coarse.matcher = absolute(spec);
        }
        if self.deterministic {
            anyhow::ensure!(
                config.field.device != FieldDevice::Gpu,
                "--deterministic needs the CPU: a GPU adds in no fixed order; leave out --device gpu"
            );
            config.field.device = FieldDevice::Cpu;
        }
        config.validate().map_err(|problem| anyhow::anyhow!("config: {problem}"))?;
        let schedule = match self.schedule {
            ScheduleArg::Lockstep => bundlesdf::Schedule::Lockstep,
            ScheduleArg::Realtime => bundlesdf::Schedule::Realtime,
        };
        Ok((config, schedule))
    }
}

/// What goes on with the run later may be started elsewhere.
fn absolute(spec: &matcher::learned::MatcherSpec) -> matcher::learned::MatcherSpec {
    use matcher::learned::MatcherSpec;
    match spec {
        MatcherSpec::Learned(network, path) => {
            MatcherSpec::Learned(*network, path.canonicalize().unwrap_or_else(|_| path.clone()))
        }
        MatcherSpec::Classical => MatcherSpec::Classical,
    }
}

/// Parses the arguments and runs the command; errors go to standard error in one line.
pub(crate) fn main() -> ExitCode {
    let cli = Cli::parse();
    let log = if cli.json_log { Log::Json } else { Log::Text };
    let outcome = if cli.json_log && cli.verbose > 0 {
        Err(anyhow::anyhow!("--json-log and -v would write into each other; leave one of them out"))
    } else {
        init_tracing(cli.verbose);
        dispatch(&cli.command, log)
    };
    outcome.unwrap_or_else(|error| {
        log.error(&format!("{error:#}"), EXIT_BAD_INPUT);
        ExitCode::from(EXIT_BAD_INPUT)
    })
}

fn dispatch(command: &Command, log: Log) -> anyhow::Result<ExitCode> {
    match command {
        Command::Demo(args) => demo::demo(args, log),
        Command::Run(args) => run::run(args, log),
        Command::Refine(args) => refine::refine(args, log),
        Command::Check(args) => check::check(args),
        Command::Mask(args) => mask::mask(args),
        Command::Report(args) => report::report(args),
        Command::Export(args) => export::run(args),
        Command::Draw(args) => draw::draw(args, log),
        Command::Completions(args) => complete::completions(args),
        Command::Man(args) => complete::man(args),
    }
}

fn init_tracing(verbose: u8) {
    use tracing_subscriber::{EnvFilter, fmt::format::FmtSpan};
    let level = match verbose {
        0 => "off",
        1 => "info",
        2 => "debug",
        _ => "trace",
    };
    // A span's end carries its duration.
    let spans = if verbose > 0 { FmtSpan::CLOSE } else { FmtSpan::NONE };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(log::colors_on(&std::io::stderr()))
        .with_span_events(spans)
        .init();
}

/// A flag that Ctrl-C and SIGTERM set; a second signal ends the process at once.
fn stop_flag() -> Arc<AtomicBool> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = stop.clone();
    let handler = move || {
        if flag.swap(true, Ordering::SeqCst) {
            std::process::exit(i32::from(EXIT_INTERRUPTED));
        }
    };
    if let Err(error) = ctrlc::set_handler(handler) {
        tracing::warn!(%error, "Ctrl-C will end the run without its last files");
    }
    stop
}
