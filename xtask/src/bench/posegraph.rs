//! `cargo xtask bench posegraph`: public pose graphs to their optimum, beside GTSAM if a Python with it is named.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

use anyhow::Context;
use posegraph::g2o;
use posegraph::sparse::{Options, solve};
use serde::{Deserialize, Serialize};

use crate::python;

/// The peer's script, from the workspace's root.
const SCRIPT: &str = "xtask/peers/gtsam_pose_graph.py";
/// Optima this close, relative to the larger, are the same: GTSAM stops at a relative decrease of 1e-5.
const SAME: f64 = 1e-3;

/// What to measure and how.
#[derive(clap::Args)]
pub(crate) struct PosegraphArgs {
    /// Graphs in the g2o format; without any, sphere2500 and parking-garage of the folder `--data`.
    #[arg(value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Folder with sphere2500.g2o and parking-garage.g2o, see docs/benchmarks.md; a missing file is skipped.
    #[arg(long, default_value = "../shared/data/g2o", value_name = "DIR")]
    data: PathBuf,
    /// Python with GTSAM (pip install gtsam), to measure it in the same call.
    #[arg(long, value_name = "PYTHON")]
    peer: Option<PathBuf>,
    /// Solves of each graph; the table has their median.
    #[arg(long, default_value_t = 5, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    repeat: u16,
    /// Also write the figures to this file.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// One solver on one graph.
#[derive(Serialize, Deserialize)]
struct Solved {
    poses: usize,
    /// Half of chi squared at the start and at the end.
    before: f64,
    after: f64,
    iterations: usize,
    /// Of each solve, reading the file not included.
    milliseconds: Vec<f64>,
}

/// One graph's figures.
#[derive(Serialize)]
struct Row {
    file: PathBuf,
    ours: Solved,
    gtsam: Option<Solved>,
}

/// Solves every graph and prints a table.
pub(super) fn run(args: &PosegraphArgs) -> anyhow::Result<ExitCode> {
    let mut files = args.files.clone();
    if files.is_empty() {
        for name in ["sphere2500.g2o", "parking-garage.g2o"] {
            let path = args.data.join(name);
            if path.is_file() {
                files.push(path);
            } else {
                eprintln!("skipped: {} is not there (--data names its folder)", path.display());
            }
        }
    }
    let mut rows = Vec::new();
    for file in files {
        let ours = ours(&file, args.repeat)?;
        let gtsam =
            args.peer.as_deref().map(|python| gtsam(python, &file, args.repeat)).transpose()?.flatten();
        rows.push(Row { file, ours, gtsam });
    }
    print!("{}", table(&rows));
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_string_pretty(&rows)?)
            .with_context(|| format!("{} can't be written", path.display()))?;
    }
    Ok(ExitCode::SUCCESS)
}

fn ours(path: &Path, repeat: u16) -> anyhow::Result<Solved> {
    let bytes = std::fs::read(path).with_context(|| format!("{} can't be read", path.display()))?;
    let file = g2o::parse(&bytes).with_context(|| format!("{} is no 3-D g2o file", path.display()))?;
    let mut milliseconds = Vec::new();
    let mut solution = None;
    for _ in 0..repeat {
        let start = Instant::now();
        solution = Some(solve(&file.graph, &Options::default())?);
        milliseconds.push(start.elapsed().as_secs_f64() * 1e3);
    }
    let solution = solution.context("nothing was solved")?;
    Ok(Solved {
        poses: file.graph.poses.len(),
        before: solution.cost_initial,
        after: solution.cost_final,
        iterations: solution.iterations,
        milliseconds,
    })
}

/// GTSAM's figures; `None`, with a line that says so, if that Python has none.
fn gtsam(python: &Path, file: &Path, repeat: u16) -> anyhow::Result<Option<Solved>> {
    if !python::has(python, "gtsam") {
        eprintln!("skipped: {} has no gtsam (pip install gtsam)", python.display());
        return Ok(None);
    }
    let printed =
        python::output(python, Path::new(SCRIPT), &[repeat.to_string().as_ref(), file.as_os_str()])?;
    let solved = serde_json::from_slice(&printed).with_context(|| format!("{SCRIPT} printed no figures"))?;
    Ok(Some(solved))
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
}

fn table(rows: &[Row]) -> String {
    let mut text = format!(
        "{:<18} {:<7} {:>6} {:>14} {:>12} {:>6} {:>10} {:>9}\n",
        "graph", "solver", "poses", "before", "optimum", "steps", "median ms", "best ms"
    );
    for row in rows {
        let name = row.file.file_stem().unwrap_or_default().to_string_lossy();
        for (solver, solved) in [("ours", Some(&row.ours)), ("GTSAM", row.gtsam.as_ref())] {
            let Some(s) = solved else { continue };
            let best = s.milliseconds.iter().copied().fold(f64::INFINITY, f64::min);
            text += &format!(
                "{name:<18} {solver:<7} {:>6} {:>14.3} {:>12.4} {:>6} {:>10.1} {best:>9.1}\n",
                s.poses,
                s.before,
                s.after,
                s.iterations,
                median(&s.milliseconds)
            );
        }
        if let Some(gtsam) = &row.gtsam {
            let (a, b) = (row.ours.after, gtsam.after);
            let same = (a - b).abs() <= SAME * a.abs().max(b.abs());
            let ratio = median(&row.ours.milliseconds) / median(&gtsam.milliseconds);
            let verdict = if same {
                "the same optimum"
            } else if a < b {
                "a lower cost than GTSAM's"
            } else {
                "a HIGHER cost than GTSAM's"
            };
            text += &format!("{name:<18} {verdict}, in {ratio:.2} of its time\n");
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_graph_is_solved_and_reported() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("line.g2o");
        let information = "100 0 0 0 0 0 100 0 0 0 0 100 0 0 0 400 0 0 400 0 400";
        let text = format!(
            "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1.2 0 0 0 0 0 1\n\
             EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {information}\n"
        );
        std::fs::write(&file, text).unwrap();
        let solved = ours(&file, 3).unwrap();
        assert_eq!((solved.poses, solved.milliseconds.len()), (2, 3));
        assert!((solved.before - 2.0).abs() < 1e-9 && solved.after < 1e-9, "half of 100 * 0.2^2");
        let peer = Solved { poses: 2, before: 2.0, after: 1.0, iterations: 1, milliseconds: vec![1.0] };
        let text = table(&[Row { file, ours: solved, gtsam: Some(peer) }]);
        assert!(text.contains("a lower cost than GTSAM's"), "{text}");
    }

    #[test]
    fn a_python_without_gtsam_is_skipped() {
        assert!(gtsam(Path::new("no-such-python"), Path::new("a.g2o"), 1).unwrap().is_none());
    }
}
