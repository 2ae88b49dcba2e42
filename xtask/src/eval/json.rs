//! The scores as a JSON file.

use super::table::{Column, Entry, Tables, Values};
use serde::Serialize;
use std::path::Path;

#[derive(Serialize)]
struct Document<'a> {
    dataset: &'static str,
    /// One per run.
    rows: Vec<Row<'a>>,
    /// One per method, published ones included.
    mean: Vec<Mean<'a>>,
    notes: &'a [String],
}

#[derive(Serialize)]
struct Row<'a> {
    video: &'a str,
    method: &'static str,
    repeat: u64,
    /// Zero for a run that failed: its poses count as entirely wrong.
    add_s: f64,
    add: f64,
    cd_cm: Option<f64>,
    cd_icp_cm: Option<f64>,
    cd_seen_cm: Option<f64>,
    normals_deg: Option<f64>,
    region_j: Option<f64>,
    boundary_f: Option<f64>,
    lost: Option<usize>,
    hz: Option<f64>,
    round_s: Option<f64>,
    wall_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<&'a str>,
}

#[derive(Serialize)]
struct Mean<'a> {
    method: &'a str,
    published: bool,
    add_s: Option<f64>,
    add: Option<f64>,
    cd_cm: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pooled_add_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pooled_add: Option<f64>,
}

pub(super) fn write(path: &Path, tables: &Tables, entries: &[Entry], notes: &[String]) -> anyhow::Result<()> {
    let document = Document {
        dataset: tables.benchmark.name(),
        rows: entries.iter().map(row).collect(),
        mean: tables.columns.iter().map(mean).collect(),
        notes,
    };
    super::write_text(path, &(serde_json::to_string_pretty(&document)? + "\n"))
}

fn row(entry: &Entry) -> Row<'_> {
    let (video, method, repeat) =
        (entry.asked.place.name.as_str(), entry.asked.method.name(), entry.asked.repeat);
    let score = entry.score.as_ref().ok();
    Row {
        video,
        method,
        repeat,
        add_s: score.map_or(0.0, |s| s.add_s),
        add: score.map_or(0.0, |s| s.add),
        cd_cm: score.and_then(|s| s.cd_cm),
        cd_icp_cm: score.and_then(|s| s.cd_icp_cm),
        cd_seen_cm: score.and_then(|s| s.cd_seen_cm),
        normals_deg: score.and_then(|s| s.normals_deg),
        region_j: score.and_then(|s| s.region_j),
        boundary_f: score.and_then(|s| s.boundary_f),
        lost: score.map(|s| s.lost),
        hz: score.and_then(|s| s.hz),
        round_s: score.and_then(|s| s.round_s),
        wall_s: score.and_then(|s| s.wall_s),
        error: entry.score.as_ref().err().map(String::as_str),
    }
}

fn mean(column: &Column) -> Mean<'_> {
    let Values { add_s, add, cd_cm } = column.mean;
    let method = column.method.map_or(column.name.as_str(), |m| m.name());
    let (pooled_add_s, pooled_add) = (column.pooled.and_then(|p| p.add_s), column.pooled.and_then(|p| p.add));
    Mean { method, published: column.method.is_none(), add_s, add, cd_cm, pooled_add_s, pooled_add }
}
