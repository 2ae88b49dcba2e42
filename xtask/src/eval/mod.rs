//! Scores the system on sequences with known poses and mesh.

mod masks;
mod ply;
mod report;
mod run;
mod score;
pub(crate) mod synth;
mod truth;

use clap::{Subcommand, ValueEnum};
use report::{Report, Row};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// The layouts of sequences that can be scored.
#[derive(Subcommand)]
pub(crate) enum Layout {
    /// Folders with rgb/, depth/, cam_K.txt, gt_poses/*.txt (4x4, object to camera) and mesh/*.obj.
    Custom(CustomArgs),
    /// The synthetic suite, whose truth is exact: made on first use, nothing is downloaded.
    Synth(SynthArgs),
}

/// How the tracker and the field take turns.
#[derive(Clone, Copy, ValueEnum)]
pub(crate) enum Schedule {
    /// A field round after each batch of keyframes: reproducible.
    Lockstep,
    /// The tracker never waits.
    Realtime,
}

#[derive(clap::Args)]
pub(crate) struct CustomArgs {
    /// Sequence folders.
    #[arg(required = true, value_name = "DIR")]
    dirs: Vec<PathBuf>,
    #[command(flatten)]
    how: How,
}

#[derive(clap::Args)]
pub(crate) struct SynthArgs {
    /// Sequences of the suite; without it, all of them.
    #[arg(long, value_delimiter = ',', value_name = "NAME,...")]
    videos: Vec<String>,
    /// Where the sequences are kept, about 150 MB each; those already there are used again.
    #[arg(long, default_value = "out/synth", value_name = "DIR")]
    data: PathBuf,
    #[command(flatten)]
    how: How,
}

/// What every layout's evaluation has in common.
#[derive(clap::Args)]
struct How {
    /// Masks to track with: the first frame's, all (`masks/`, else `masks_derived/`), or those of a folder.
    #[arg(long, default_value = "first", value_name = "first|all|FOLDER")]
    masks: String,
    /// How tracker and field take turns.
    #[arg(long, value_enum, default_value = "lockstep")]
    schedule: Schedule,
    /// Use every Nth frame.
    #[arg(long, default_value_t = 1, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    stride: u32,
    /// Configuration file for the system.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Where the results go, one folder a sequence.
    #[arg(long, default_value = "out/eval", value_name = "DIR")]
    out: PathBuf,
    /// Also write the scores to this file.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Score the results that are already in the output folder.
    #[arg(long)]
    no_run: bool,
}

/// Evaluates on one layout.
pub(crate) fn run(layout: &Layout) -> anyhow::Result<ExitCode> {
    match layout {
        Layout::Custom(args) => run_all(&args.dirs, &args.how),
        Layout::Synth(args) => run_all(&synth::folders(&args.videos, &args.data)?, &args.how),
    }
}

/// Runs and scores every sequence. A sequence that fails is a row with its error, and fails the command at the
/// end.
fn run_all(dirs: &[PathBuf], args: &How) -> anyhow::Result<ExitCode> {
    let names = sequence_names(dirs)?;
    let program = if args.no_run { None } else { Some(run::build()?) };
    let mut report = Report::default();
    for (dir, name) in dirs.iter().zip(names) {
        let row = evaluate(args, program.as_deref(), dir, &name)
            .unwrap_or_else(|error| Row::failed(&name, &format!("{error:#}")));
        eprintln!("{}", row.summary());
        report.rows.push(row);
    }
    println!("{report}");
    if let Some(path) = &args.json {
        report.write_json(path)?;
    }
    Ok(if report.rows.iter().any(|row| row.error.is_some()) { ExitCode::FAILURE } else { ExitCode::SUCCESS })
}

fn evaluate(args: &How, program: Option<&Path>, dir: &Path, name: &str) -> anyhow::Result<Row> {
    // Read first: a folder without truth should not cost a run.
    let truth = truth::Truth::read(dir, args.stride as usize)?;
    let out = args.out.join(name);
    let mut failure = None;
    if let Some(program) = program {
        let masks = masks::arguments(&args.masks, dir, &truth.ids)?;
        let outcome = run::run(program, args, dir, &masks, &out);
        // A run that stopped half-way has left the poses so far, and the rest of the frames counts as lost.
        if let Err(error) = outcome {
            if !out.join("run.json").exists() {
                return Err(error);
            }
            failure = Some(format!("{error:#}"));
        }
    }
    let mut row = score::score(name, &truth, &out)?;
    row.error = failure;
    Ok(row)
}

/// The last part of each folder's path; these name the output folders, so they must differ.
fn sequence_names(dirs: &[PathBuf]) -> anyhow::Result<Vec<String>> {
    let mut names: Vec<String> = Vec::new();
    for dir in dirs {
        let full = dir.canonicalize().unwrap_or_else(|_| dir.clone());
        let name = full.file_name().map_or_else(|| "sequence".into(), |n| n.to_string_lossy().into_owned());
        anyhow::ensure!(!names.contains(&name), "two sequences are called {name}: rename one of the folders");
        names.push(name);
    }
    Ok(names)
}
