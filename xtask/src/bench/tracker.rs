//! `cargo xtask bench tracker`: frames per second and milliseconds by stage, alone and beside the field's training.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use bundlesdf::{Ablation, Config, FrameResult, Schedule, Tracker};
use rgbd_io::{CustomFolder, CustomOptions, FrameSource, MaskSource, RgbdFrame};
use serde::Serialize;

use crate::eval::synth;

/// What to measure and how.
#[derive(clap::Args)]
pub(crate) struct TrackerArgs {
    /// Synthetic sequences; all of the suite when none is named.
    #[arg(value_name = "NAME")]
    names: Vec<String>,
    /// Measure on this folder instead (may be repeated): rgb/, depth/, cam_K.txt and masks/ or masks_derived/ of every
    /// frame.
    #[arg(long, value_name = "DIR")]
    dir: Vec<PathBuf>,
    /// Where the synthetic sequences are kept; made on first use.
    #[arg(long, default_value = "out/synth", value_name = "DIR")]
    root: PathBuf,
    /// Stop after this many frames of each sequence.
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// Only without a field.
    #[arg(long)]
    alone: bool,
    /// Configuration file for the system.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Also write the figures to this file.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// How the tracker is run.
#[derive(Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum Beside {
    /// The schedule `realtime`: the field trains on its own thread.
    Field,
    /// Without a field.
    Nothing,
}

impl Beside {
    fn label(self) -> &'static str {
        match self {
            Self::Field => "field",
            Self::Nothing => "alone",
        }
    }
}

/// Median and 95th percentile, milliseconds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
struct Spread {
    median: f64,
    p95: f64,
}

impl Spread {
    fn of(mut values: Vec<f64>) -> Self {
        values.sort_by(f64::total_cmp);
        let at = |q: f64| {
            let i = (q * values.len().saturating_sub(1) as f64).round() as usize;
            values.get(i).copied().unwrap_or(0.0)
        };
        Self { median: at(0.5), p95: at(0.95) }
    }
}

/// A sequence's figures in one way to run it.
#[derive(Serialize)]
struct Row {
    name: String,
    beside: Beside,
    /// Frames that are counted: those during which the field was training, or all without a field.
    frames: usize,
    /// Of the sequence.
    frames_of_all: usize,
    /// Frames per second at the median time of a frame.
    hz: f64,
    total: Spread,
    segment: Spread,
    #[serde(rename = "match")]
    matching: Spread,
    posegraph: Spread,
    /// Online rounds that the field finished.
    rounds: usize,
    lost: usize,
}

/// Tracks every sequence in each way and prints a table.
pub(super) fn run(args: &TrackerArgs) -> anyhow::Result<ExitCode> {
    let config = match &args.config {
        None => Config::default(),
        Some(path) => {
            let text =
                std::fs::read_to_string(path).with_context(|| format!("{} can't be read", path.display()))?;
            Config::from_toml(&text, &path.display().to_string())?
        }
    };
    let folders = if args.dir.is_empty() {
        let names = synth::prepare(&args.names, &args.root)?;
        names.iter().map(|name| args.root.join(name)).collect()
    } else {
        args.dir.clone()
    };
    let ways = if args.alone { vec![Beside::Nothing] } else { vec![Beside::Nothing, Beside::Field] };
    let mut rows = Vec::new();
    println!("{}", header());
    for folder in &folders {
        let frames = read(folder, args.frames)?;
        for &beside in &ways {
            let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let row = track(name, &frames, &config, beside)?;
            println!("{}", row.line());
            rows.push(row);
        }
    }
    for &beside in &ways {
        println!("{}", summary(&rows, beside));
    }
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_string_pretty(&rows)?)
            .with_context(|| format!("{} can't be written", path.display()))?;
    }
    Ok(ExitCode::SUCCESS)
}

/// The frames with their masks, in memory: reading is no part of what is measured.
fn read(folder: &Path, limit: Option<usize>) -> anyhow::Result<Vec<RgbdFrame>> {
    let is_complete = |masks: &Path| {
        let options = CustomOptions { masks: MaskSource::None, ..CustomOptions::default() };
        let source = CustomFolder::open(folder, &options)?;
        Ok::<bool, rgbd_io::Error>(
            (0..source.len()).all(|i| masks.join(format!("{}.png", source.id(i))).is_file()),
        )
    };
    let mut found = None;
    for name in ["masks", "masks_derived"] {
        if found.is_none() && is_complete(&folder.join(name))? {
            found = Some(name);
        }
    }
    let masks = found.with_context(|| {
        format!("{} has a mask for every frame neither in masks/ nor in masks_derived/", folder.display())
    })?;
    let options = CustomOptions { masks: MaskSource::Folder(masks.into()), ..CustomOptions::default() };
    let source = CustomFolder::open(folder, &options)?;
    let count = limit.unwrap_or(usize::MAX).min(source.len());
    (0..count).map(|i| source.frame(i).map_err(anyhow::Error::from)).collect()
}

fn track(name: String, frames: &[RgbdFrame], config: &Config, beside: Beside) -> anyhow::Result<Row> {
    let mut config = config.clone();
    if beside == Beside::Nothing {
        Ablation::NoNof.apply(&mut config);
    }
    let mut tracker = Tracker::new(config, Schedule::Realtime)?;
    let mut results: Vec<(FrameResult, bool)> = Vec::new();
    for frame in frames {
        let was_busy = tracker.is_field_busy();
        let result = tracker.track(frame);
        results.push((result, was_busy));
    }
    // The first frame defines the object: there is nothing to track in it.
    let counts = |(_, busy): &&(FrameResult, bool)| beside == Beside::Nothing || *busy;
    let counted: Vec<&FrameResult> = results.iter().skip(1).filter(counts).map(|(r, _)| r).collect();
    let ms = |stage: fn(&FrameResult) -> std::time::Duration| {
        Spread::of(counted.iter().map(|r| stage(r).as_secs_f64() * 1e3).collect())
    };
    let total = ms(|r| r.times.total);
    Ok(Row {
        name,
        beside,
        frames: counted.len(),
        frames_of_all: results.len(),
        hz: if total.median > 0.0 { 1e3 / total.median } else { 0.0 },
        total,
        segment: ms(|r| r.times.segment),
        matching: ms(|r| r.times.matching),
        posegraph: ms(|r| r.times.posegraph),
        rounds: tracker.field_summary().rounds,
        lost: results.iter().filter(|(r, _)| r.status == bundlesdf::Status::Lost).count(),
    })
}

fn header() -> String {
    format!(
        "{:<18} {:<6} {:>9} {:>6} {:>15} {:>13} {:>13} {:>13} {:>6} {:>4}",
        "sequence",
        "beside",
        "frames",
        "Hz",
        "total ms (p95)",
        "segment",
        "match",
        "posegraph",
        "rounds",
        "lost"
    )
}

impl Row {
    fn line(&self) -> String {
        let spread = |s: Spread| format!("{:.1} ({:.1})", s.median, s.p95);
        format!(
            "{:<18} {:<6} {:>9} {:>6.1} {:>15} {:>13} {:>13} {:>13} {:>6} {:>4}",
            self.name,
            self.beside.label(),
            format!("{}/{}", self.frames, self.frames_of_all),
            self.hz,
            spread(self.total),
            spread(self.segment),
            spread(self.matching),
            spread(self.posegraph),
            self.rounds,
            self.lost
        )
    }
}

/// The slowest sequence decides.
fn summary(rows: &[Row], beside: Beside) -> String {
    let rows = rows.iter().filter(|r| r.beside == beside && r.frames > 0);
    let (mut sum, mut count, mut slowest, mut p95) = (0.0, 0, f64::INFINITY, 0.0f64);
    for row in rows {
        sum += row.hz;
        count += 1;
        slowest = slowest.min(row.hz);
        p95 = p95.max(row.total.p95);
    }
    format!(
        "{:<6} {count} sequences: mean {:.1} Hz, slowest {:.1} Hz, worst 95th percentile {p95:.1} ms",
        beside.label(),
        sum / f64::max(f64::from(count), 1.0),
        if slowest.is_finite() { slowest } else { 0.0 }
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use rgbd_synth::Sequence;

    #[test]
    fn percentiles_are_those_of_the_sorted_values() {
        let spread = Spread::of((0..=100).rev().map(f64::from).collect());
        assert_eq!(spread, Spread { median: 50.0, p95: 95.0 });
        assert_eq!(Spread::of(Vec::new()), Spread { median: 0.0, p95: 0.0 });
    }

    #[test]
    fn stages_add_up_to_no_more_than_the_frame() {
        let sequence = Sequence::named("depth-noise").unwrap();
        let frames: Vec<_> = (0..3).map(|i| sequence.render(i).frame).collect();
        let row = track("a".into(), &frames, &Config::default(), Beside::Nothing).unwrap();
        assert_eq!((row.frames, row.frames_of_all, row.lost, row.rounds), (2, 3, 0, 0));
        assert!(row.matching.median > 0.0 && row.posegraph.median > 0.0);
        assert!(row.matching.p95 <= row.total.p95 && (row.hz - 1e3 / row.total.median).abs() < 1e-9);
        assert!(summary(&[row], Beside::Nothing).contains("1 sequences"));
    }
}
