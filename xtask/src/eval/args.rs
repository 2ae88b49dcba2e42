//! The command line of `cargo xtask eval`.

use super::benchmark::Benchmark;
use super::job::{Asked, Job};
use super::method::Method;
use super::peer;
use super::synth;
use super::video::{Masks, Place};
use anyhow::Context;
use bundlesdf::{Config, Schedule};
use clap::{Args, Subcommand, ValueEnum};
use std::path::{Path, PathBuf};

/// What to evaluate on.
#[derive(Subcommand)]
pub(crate) enum Target {
    /// The synthetic suite, whose truth is exact: made on first use, nothing is downloaded.
    Synth(SynthArgs),
    /// HO3D version 3: hands that turn YCB objects.
    Ho3d(DatasetArgs),
    /// YCBInEOAT: YCB objects in a robot's gripper.
    #[command(name = "ycbineoat")]
    YcbInEoat(DatasetArgs),
    /// BEHAVE: people who carry furniture; errors up to 0.5 m count.
    Behave(DatasetArgs),
    /// A dataset in the BOP format.
    Bop(BopArgs),
    /// Folders with rgb/, depth/, masks/, cam_K.txt, gt_poses/*.txt (4x4, object to camera) and mesh/*.obj.
    Custom(CustomArgs),
    /// One job of an evaluation, in a process of its own.
    #[command(hide = true)]
    Job(JobArgs),
}

#[derive(Args)]
pub(crate) struct SynthArgs {
    /// Where the sequences are kept, about 150 MB each; those already there are used again.
    #[arg(long, alias = "data", default_value = "out/synth", value_name = "DIR")]
    root: PathBuf,
    #[command(flatten)]
    how: How,
}

#[derive(Args)]
pub(crate) struct DatasetArgs {
    /// Folder of the dataset [default: data/NAME].
    #[arg(long, value_name = "DIR")]
    root: Option<PathBuf>,
    /// Folder of the models, where it isn't in its usual place.
    #[arg(long, value_name = "DIR")]
    models: Option<PathBuf>,
    #[command(flatten)]
    how: How,
}

#[derive(Args)]
pub(crate) struct BopArgs {
    #[command(flatten)]
    dataset: DatasetArgs,
    /// Number of the object to track, where a scene has several.
    #[arg(long, value_name = "N")]
    object: Option<u32>,
}

#[derive(Args)]
pub(crate) struct CustomArgs {
    /// Sequence folders; without any, all in --root.
    #[arg(value_name = "DIR")]
    dirs: Vec<PathBuf>,
    /// Folder of the sequences.
    #[arg(long, value_name = "DIR", conflicts_with = "dirs")]
    root: Option<PathBuf>,
    #[command(flatten)]
    how: How,
}

#[derive(Args)]
pub(crate) struct JobArgs {
    /// Folder with the job's job.json.
    pub(super) folder: PathBuf,
    /// Only score the results that are there.
    #[arg(long)]
    pub(super) no_run: bool,
}

/// How the tracker and the field take turns.
#[derive(Clone, Copy, ValueEnum)]
enum Turns {
    /// A field round after each batch of keyframes: reproducible.
    Lockstep,
    /// The tracker never waits.
    Realtime,
}

/// What every evaluation has in common.
#[derive(Args)]
pub(super) struct How {
    /// Sequences; without it, all there are.
    #[arg(long, value_delimiter = ',', value_name = "NAME,...")]
    videos: Vec<String>,
    /// Methods: ours, bundletrack, kinectfusion, sdf2sdf, frame-to-frame, or all; and open3d, which needs --peer.
    #[arg(long, value_delimiter = ',', default_value = "ours", value_name = "NAME,...")]
    method: Vec<String>,
    /// Ablations of ours beside them: no-memory, no-nof, gpg, no-hybrid-sdf, no-compact-pool, or all.
    #[arg(long, value_delimiter = ',', value_name = "NAME,...")]
    ablate: Vec<String>,
    /// Python with Open3D (pip install open3d), for the method open3d.
    #[arg(long, value_name = "PYTHON")]
    peer: Option<PathBuf>,
    /// Masks to track with: the first frame's, those given for every frame, or those of a folder.
    #[arg(long, default_value = "first", value_name = "first|gt|FOLDER")]
    masks: String,
    /// How tracker and field take turns.
    #[arg(long, value_enum, default_value = "lockstep")]
    schedule: Turns,
    /// Use every Nth frame.
    #[arg(long, default_value_t = 1, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    stride: u32,
    /// Configuration file for the system.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Run each job N times, with another seed each time.
    #[arg(long, default_value_t = 1, value_name = "N", value_parser = clap::value_parser!(u64).range(1..1000))]
    repeat: u64,
    /// Run N jobs at a time.
    #[arg(long, default_value_t = 1, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    pub(super) jobs: u16,
    /// Where the results go: DIR/DATASET/METHOD/SEQUENCE/.
    #[arg(long, default_value = "out/eval", value_name = "DIR")]
    out: PathBuf,
    /// Also write the scores to this file.
    #[arg(long, value_name = "FILE")]
    pub(super) json: Option<PathBuf>,
    /// Also write a page with tables and plots (index.html, and tables.md) to this folder.
    #[arg(long, value_name = "DIR")]
    pub(super) report: Option<PathBuf>,
    /// Run jobs again that are finished.
    #[arg(long)]
    pub(super) force: bool,
    /// Score the results that are already in the output folder again, and run nothing.
    #[arg(long, conflicts_with = "force")]
    pub(super) no_run: bool,
}

/// What a command line asks for.
pub(super) struct Plan<'a> {
    pub(super) benchmark: Benchmark,
    pub(super) jobs: Vec<Job>,
    pub(super) masks: Masks,
    pub(super) how: &'a How,
}

/// Where the sequences are.
struct Places {
    /// Folder and name of each.
    sequences: Vec<(PathBuf, String)>,
    models: Option<PathBuf>,
    object: Option<u32>,
}

impl Target {
    /// The jobs that are asked for; `None` for one that is a job itself.
    pub(super) fn plan(&self) -> anyhow::Result<Option<Plan<'_>>> {
        let (benchmark, how, places) = match self {
            Self::Synth(args) => {
                let root = args.root.clone();
                let names = synth::prepare(&args.how.videos, &root)?;
                let sequences = names.into_iter().map(|n| (root.clone(), n)).collect();
                (Benchmark::Synth, &args.how, Places { sequences, models: None, object: None })
            }
            Self::Ho3d(args) => (Benchmark::Ho3d, &args.how, places(Benchmark::Ho3d, args, None)?),
            Self::YcbInEoat(args) => {
                (Benchmark::YcbInEoat, &args.how, places(Benchmark::YcbInEoat, args, None)?)
            }
            Self::Behave(args) => (Benchmark::Behave, &args.how, places(Benchmark::Behave, args, None)?),
            Self::Bop(args) => {
                let places = places(Benchmark::Bop, &args.dataset, args.object)?;
                (Benchmark::Bop, &args.dataset.how, places)
            }
            Self::Custom(args) => (Benchmark::Custom, &args.how, custom_places(args)?),
            Self::Job(_) => return Ok(None),
        };
        plan(benchmark, how, places).map(Some)
    }
}

fn places(benchmark: Benchmark, args: &DatasetArgs, object: Option<u32>) -> anyhow::Result<Places> {
    let root = args.root.clone().unwrap_or_else(|| Path::new("data").join(benchmark.name()));
    let sequences = below(benchmark, &root, &args.how.videos)?;
    Ok(Places { sequences, models: args.models.clone(), object })
}

/// The named sequences, or all; the error without any says where the dataset comes from and what belongs where.
fn below(benchmark: Benchmark, root: &Path, names: &[String]) -> anyhow::Result<Vec<(PathBuf, String)>> {
    let known = benchmark.dataset().sequences(root)?;
    for name in names {
        // A video of BEHAVE may be named with its camera, and videos of other splits aren't listed.
        let is_listed = known.iter().any(|k| k == name || name.starts_with(k.as_str()));
        anyhow::ensure!(
            is_listed || benchmark == Benchmark::Ho3d || benchmark == Benchmark::Bop,
            "{} has no sequence {name}; there are {}",
            root.display(),
            known.join(", ")
        );
    }
    let chosen = if names.is_empty() { known } else { names.to_vec() };
    Ok(chosen.into_iter().map(|n| (root.to_owned(), n)).collect())
}

fn custom_places(args: &CustomArgs) -> anyhow::Result<Places> {
    let sequences = match &args.root {
        Some(root) => below(Benchmark::Custom, root, &args.how.videos)?,
        None => {
            anyhow::ensure!(
                !args.dirs.is_empty(),
                "name sequence folders, or the folder of them with --root"
            );
            args.dirs.iter().map(|dir| split(dir)).collect::<anyhow::Result<_>>()?
        }
    };
    for (i, (_, name)) in sequences.iter().enumerate() {
        let is_twice = sequences[..i].iter().any(|(_, other)| other == name);
        anyhow::ensure!(!is_twice, "two sequences are called {name}: rename one of the folders");
    }
    Ok(Places { sequences, models: None, object: None })
}

/// A folder as its parent and its name.
fn split(dir: &Path) -> anyhow::Result<(PathBuf, String)> {
    let full = dir.canonicalize().with_context(|| format!("{} isn't there", dir.display()))?;
    let name = full.file_name().context("the root folder is no sequence")?.to_string_lossy().into_owned();
    Ok((full.parent().unwrap_or(&full).to_owned(), name))
}

fn plan(benchmark: Benchmark, how: &How, places: Places) -> anyhow::Result<Plan<'_>> {
    let mut methods = Method::parse(&how.method, &how.ablate)?;
    if methods.contains(&Method::Open3d) && !peer::has_open3d(how.peer.as_deref()) {
        eprintln!(
            "skipped: open3d, for want of a Python that has it (pip install open3d, then --peer PYTHON)"
        );
        methods.retain(|m| *m != Method::Open3d);
    }
    anyhow::ensure!(
        !methods.is_empty(),
        "no method is left to run; --method all runs those that need nothing else"
    );
    let masks = Masks::parse(&how.masks);
    let mut jobs = Vec::new();
    for (root, name) in places.sequences {
        let absolute = |p: &Path| p.canonicalize().unwrap_or_else(|_| p.to_owned());
        let place = Place {
            benchmark,
            root: absolute(&root),
            name,
            models: places.models.as_deref().map(absolute),
            object: places.object,
            stride: how.stride as usize,
        };
        for &method in &methods {
            for repeat in 0..how.repeat {
                let asked = asked(method, place.clone(), repeat, &masks, how)?;
                jobs.push(Job::new(asked, &how.out, how.repeat));
            }
        }
    }
    Ok(Plan { benchmark, jobs, masks, how })
}

fn asked(method: Method, place: Place, repeat: u64, masks: &Masks, how: &How) -> anyhow::Result<Asked> {
    if let Method::Baseline(_) | Method::Open3d = method {
        // These can't find masks.
        let masks = if *masks == Masks::First { Masks::Given } else { masks.clone() };
        let python = how.peer.clone().filter(|_| method == Method::Open3d);
        return Ok(Asked { method, place, repeat, masks, schedule: None, config: None, python });
    }
    let mut config = match &how.config {
        Some(path) => {
            let text =
                std::fs::read_to_string(path).with_context(|| format!("{} can't be read", path.display()))?;
            Config::from_toml(&text, &path.display().to_string())?
        }
        None => Config::default(),
    };
    config.seed = config.seed.wrapping_add(repeat);
    match method {
        Method::Ablated(ablation) => ablation.apply(&mut config),
        Method::BundleTrack => {
            let other = Config::bundletrack();
            config.field.refiner = other.field.refiner;
            config.memory.rule = other.memory.rule;
            config.memory.min_swing_deg = other.memory.min_swing_deg;
        }
        Method::Ours | Method::Refined | Method::Baseline(_) | Method::Open3d => {}
    }
    let schedule = match how.schedule {
        Turns::Lockstep => Schedule::Lockstep,
        Turns::Realtime => Schedule::Realtime,
    };
    let (masks, schedule, config) = (masks.clone(), Some(schedule), Some(config));
    Ok(Asked { method, place, repeat, masks, schedule, config, python: None })
}
