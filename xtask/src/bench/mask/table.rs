//! The figures of a sequence and how they are printed.

use std::fmt::Write;
use std::path::Path;
use std::time::Duration;

use mask_tracker::StageTimes;
use serde::Serialize;

use super::follow::Followed;

/// A frame that a row points at.
#[derive(Clone, Serialize)]
pub(super) struct Worst {
    index: usize,
    j: f64,
    confidence: f32,
}

/// One sequence's figures.
#[derive(Serialize)]
pub(super) struct Row {
    name: String,
    frames: usize,
    j: f64,
    f: f64,
    j_before_pose: f64,
    j_lowest: f64,
    reappearances: usize,
    found_in_time: usize,
    /// CPU milliseconds of both passes together.
    ms_median: f64,
    ms_p95: f64,
    /// Share of the time per stage.
    stages: Vec<(&'static str, f64)>,
    worst: Vec<Worst>,
}

impl Row {
    pub(super) fn new(folder: &Path, run: &Followed) -> Self {
        let n = run.frames.len().max(1) as f64;
        let mut times: Vec<Duration> = run.frames.iter().map(|f| f.time).collect();
        times.sort_unstable();
        let quantile = |q: f64| {
            let i = (q * times.len().saturating_sub(1) as f64).round() as usize;
            times.get(i).map_or(0.0, |t| t.as_secs_f64() * 1e3)
        };
        let mut worst: Vec<Worst> = run
            .frames
            .iter()
            .map(|f| Worst { index: f.index, j: f.region[1], confidence: f.confidence })
            .collect();
        worst.sort_by(|a, b| a.j.total_cmp(&b.j));
        worst.truncate(8);
        Self {
            name: folder.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            frames: run.frames.len(),
            j: run.frames.iter().map(|f| f.region[1]).sum::<f64>() / n,
            f: run.frames.iter().map(|f| f.boundary).sum::<f64>() / n,
            j_before_pose: run.frames.iter().map(|f| f.region[0]).sum::<f64>() / n,
            j_lowest: worst.first().map_or(0.0, |w| w.j),
            reappearances: run.reappearances.0,
            found_in_time: run.reappearances.1,
            ms_median: quantile(0.5),
            ms_p95: quantile(0.95),
            stages: shares(&run.stages),
            worst,
        }
    }

    /// The row, with its worst frames.
    pub(super) fn line(&self) -> String {
        let worst: Vec<String> =
            self.worst.iter().map(|w| format!("{}:{:.2}({:.2})", w.index, w.j, w.confidence)).collect();
        format!("{}  worst {}", self.figures(), worst.join(" "))
    }

    fn figures(&self) -> String {
        let back = if self.reappearances == 0 {
            "-".to_owned()
        } else {
            format!("{}/{}", self.found_in_time, self.reappearances)
        };
        format!(
            "{:<18} {:>6} {:>7.3} {:>7.3} {:>7.3} {:>7.3} {:>6} {:>7.1} {:>7.1}",
            self.name,
            self.frames,
            self.j,
            self.f,
            self.j_before_pose,
            self.j_lowest,
            back,
            self.ms_median,
            self.ms_p95
        )
    }
}

fn shares(stages: &StageTimes) -> Vec<(&'static str, f64)> {
    let total: Duration = stages.named().iter().map(|s| s.1).sum();
    stages
        .named()
        .iter()
        .map(|(name, time)| (*name, time.as_secs_f64() / total.as_secs_f64().max(1e-9)))
        .collect()
}

/// All rows, their means, and where the time goes.
pub(super) fn text(rows: &[Row]) -> String {
    let mut text = format!(
        "{:<18} {:>6} {:>7} {:>7} {:>7} {:>7} {:>6} {:>7} {:>7}\n",
        "sequence", "frames", "J", "F", "J first", "J min", "back", "ms", "ms p95"
    );
    for row in rows {
        let _ = writeln!(text, "{}", row.figures());
    }
    let n = rows.len().max(1) as f64;
    let mean = |f: fn(&Row) -> f64| rows.iter().map(f).sum::<f64>() / n;
    let back = rows.iter().fold((0, 0), |sum, r| (sum.0 + r.found_in_time, sum.1 + r.reappearances));
    let _ = writeln!(
        text,
        "{:<18} {:>6} {:>7.3} {:>7.3} {:>7.3} {:>7.3} {:>6} {:>7.1} {:>7.1}",
        "mean",
        rows.iter().map(|r| r.frames).sum::<usize>(),
        mean(|r| r.j),
        mean(|r| r.f),
        mean(|r| r.j_before_pose),
        rows.iter().map(|r| r.j_lowest).fold(1.0, f64::min),
        format!("{}/{}", back.0, back.1),
        mean(|r| r.ms_median),
        mean(|r| r.ms_p95)
    );
    if let Some(first) = rows.first() {
        let _ = write!(text, "share of the time:");
        for (k, (name, _)) in first.stages.iter().enumerate() {
            let share = rows.iter().filter_map(|r| r.stages.get(k)).map(|s| s.1).sum::<f64>() / n;
            let _ = write!(text, " {name} {:.0} %", 100.0 * share);
        }
        text.push('\n');
    }
    text
}
