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
    /// The suite in another make-up: other colours, views, courses, hands, rooms and noise. 0 is the suite itself.
    #[arg(long, default_value_t = 0, value_name = "N")]
    variant: u64,
    /// Hide everything for this many frames, early in each sequence, by a card before the camera: is the object found again?
    #[arg(long, value_delimiter = ',', value_name = "FRAMES,...", conflicts_with = "dir")]
    hide: Vec<u32>,
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
    let folders = if args.dir.is_empty() { synthetic(args)? } else { args.dir.clone() };
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

/// Folders of the synthetic sequences asked for, made where they aren't there yet.
fn synthetic(args: &MaskArgs) -> anyhow::Result<Vec<PathBuf>> {
    /// Frames before the card hides all, and those with its way out and after it.
    const BEFORE: u32 = 36;
    const AFTER: u32 = 30;
    let mut folders = Vec::new();
    for name in synth::chosen(&args.names) {
        let whole = synth::variant(&name, args.variant)?;
        let mut sequences = Vec::new();
        for &frames in &args.hide {
            let hidden = whole.hidden_between(f64::from(BEFORE), f64::from(BEFORE + frames));
            let hidden = hidden.truncated((BEFORE + frames + AFTER) as usize);
            sequences.push((hidden, format!("hidden-{frames}")));
        }
        if sequences.is_empty() {
            sequences.push((whole, String::new()));
        }
        for (sequence, below) in sequences {
            let variant = if args.variant == 0 { String::new() } else { format!("variant-{}", args.variant) };
            let data = args.data.join(variant).join(below);
            folders.push(data.join(synth::make(&sequence, &data)?));
        }
    }
    Ok(folders)
}
