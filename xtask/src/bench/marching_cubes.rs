//! `cargo xtask bench marching-cubes`.

use super::peer::{PeerArgs, number_after};
use serde::Serialize;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Instant;

#[derive(clap::Args)]
pub(crate) struct MarchingCubesArgs {
    /// Write all figures to this file.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    #[command(flatten)]
    peer: PeerArgs,
}

/// One lattice of `side` points an axis.
#[derive(Serialize)]
struct Row {
    side: usize,
    faces: usize,
    /// By number of threads: all, and one.
    mvoxels_per_s: Vec<(usize, f64)>,
    scikit_image_mvoxels_per_s: Option<f64>,
}

pub(super) fn run(args: &MarchingCubesArgs) -> anyhow::Result<ExitCode> {
    let all = std::thread::available_parallelism()?.get();
    let peer = args.peer.output(&[]);
    let mut rows = Vec::new();
    for side in [128usize, 256] {
        let values = bumpy_torus(side);
        let h = 2.0 / (side - 1) as f32;
        let mut row = Row { side, faces: 0, mvoxels_per_s: Vec::new(), scikit_image_mvoxels_per_s: None };
        for threads in if all > 1 { vec![all, 1] } else { vec![1] } {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
            let mut best = f64::MAX;
            for _ in 0..5 {
                let start = Instant::now();
                let mesh =
                    pool.install(|| marching_cubes::extract_dense([side; 3], &values, [-1.0; 3], h, 0.0));
                best = best.min(start.elapsed().as_secs_f64());
                row.faces = mesh.triangles.len();
            }
            let rate = values.len() as f64 / best / 1e6;
            println!("{side}^3 on {threads} threads: {rate:.1} Mvoxel/s, {} faces", row.faces);
            row.mvoxels_per_s.push((threads, rate));
        }
        let line = peer.as_deref().and_then(|text| {
            text.lines().find(|l| l.starts_with(&format!("{side} ")) && l.contains("skimage"))
        });
        // The peer prints its time in milliseconds.
        row.scikit_image_mvoxels_per_s = line
            .and_then(|l| number_after(l, "lewiner "))
            .filter(|ms| *ms > 0.0)
            .map(|ms| values.len() as f64 / ms / 1e3);
        if let (Some(peer), Some((_, ours))) = (row.scikit_image_mvoxels_per_s, row.mvoxels_per_s.first()) {
            println!("  scikit-image: {peer:.1} Mvoxel/s, ours is {:.1} times as fast", ours / peer);
        }
        rows.push(row);
    }
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_string_pretty(&rows)?)?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Distance to a torus with bumps, on `side` points an axis in -1..1, x fastest.
fn bumpy_torus(side: usize) -> Vec<f32> {
    let at = |i: usize| 2.0 * i as f32 / (side - 1) as f32 - 1.0;
    (0..side * side * side)
        .map(|i| {
            let [x, y, z] = [at(i % side), at(i / side % side), at(i / (side * side))];
            let ring = (x * x + y * y).sqrt() - 0.55;
            let bumps = 0.02 * (20.0 * x).sin() * (20.0 * y).sin() * (20.0 * z).sin();
            (ring * ring + z * z).sqrt() - 0.25 + bumps
        })
        .collect()
}
