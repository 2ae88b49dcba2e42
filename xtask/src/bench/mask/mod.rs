//! `cargo xtask bench mask`: the built-in segmenter on sequences with known poses and masks.

mod clock;
mod follow;
mod fusion;
mod overlay;
mod score;
mod table;

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;

use crate::eval::synth;
use follow::follow;
use table::Row;

/// What to measure and how.
#[derive(clap::Args)]
pub(crate) struct MaskArgs {
    /// Synthetic sequences; all of the suite when none is named.
    #[arg(value_name = "NAME")]
    names: Vec<String>,
    /// Measure on this folder instead (may be repeated): rgb/, depth/, cam_K.txt, gt_poses/ and masks_derived/ or masks/.
    #[arg(long, value_name = "DIR")]
    dir: Vec<PathBuf>,
    /// Where the synthetic sequences are kept; made on first use.
    #[arg(long, default_value = "out/synth", value_name = "DIR")]
    data: PathBuf,
    /// Stop after this many frames of each sequence.
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// Tell the segmenter neither pose nor model.
    #[arg(long)]
    no_pose: bool,
    /// Disturb every pose by up to this many millimetres and degrees per axis.
    #[arg(long, num_args = 2, value_names = ["MM", "DEG"])]
    noise: Vec<f64>,
    /// Draw each frame's mask (red) and the true one (green) into this folder.
    #[arg(long, value_name = "DIR")]
    overlays: Option<PathBuf>,
    /// Also write the figures to this file.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// Follows every sequence's mask and prints a table.
pub(super) fn run(args: &MaskArgs) -> anyhow::Result<ExitCode> {
    let folders = if args.dir.is_empty() {
        let names = synth::prepare(&args.names, &args.data)?;
        names.iter().map(|name| args.data.join(name)).collect()
    } else {
        args.dir.clone()
    };
    let mut rows = Vec::new();
    for folder in &folders {
        let run = follow(folder, args).with_context(|| format!("measuring on {}", folder.display()))?;
        let row = Row::new(folder, &run);
        eprintln!("{}", row.line());
        rows.push(row);
    }
    print!("{}", table::text(&rows));
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_string_pretty(&rows)?)
            .with_context(|| format!("{} can't be written", path.display()))?;
    }
    Ok(ExitCode::SUCCESS)
}
