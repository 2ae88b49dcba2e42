//! Optimises a g2o file: `cargo run --release --features sparse --example g2o -- FILE`. Prints half of chi squared and
//! the time of the best of five solves.
#![allow(clippy::print_stdout)]

use std::time::Instant;

use posegraph::g2o;
use posegraph::sparse::{Options, solve};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args().nth(1).ok_or("usage: g2o FILE")?;
    let bytes = std::fs::read(&path)?;
    let start = Instant::now();
    let file = g2o::parse(&bytes)?;
    let parsed = start.elapsed();
    let mut best = f64::INFINITY;
    let mut solution = None;
    for _ in 0..5 {
        let start = Instant::now();
        solution = Some(solve(&file.graph, &Options::default())?);
        best = best.min(start.elapsed().as_secs_f64());
    }
    let Some(solution) = solution else { return Ok(()) };
    println!(
        "{path}: {} poses, {} edges, half chi squared {:.4} -> {:.4}, {} iterations, converged {}, {:.1} ms (read in {:.1} ms)",
        file.graph.poses.len(),
        file.graph.edges.len(),
        solution.cost_initial,
        solution.cost_final,
        solution.iterations,
        solution.converged,
        best * 1e3,
        parsed.as_secs_f64() * 1e3
    );
    Ok(())
}
