//! Errors and times of all methods on a synthetic sequence:
//! `cargo run --release -p bundlesdf-baselines --example compare -- [tiny|demo] [frames] [perfect]`.
#![allow(clippy::print_stdout)]

use baselines::{Baseline, BaselineConfig};
use eval_metrics::{MeshRef, ModelPoints, add, chamfer_distance, rebase, sample_surface};
use marching_cubes::TriMesh;
use nalgebra::{Isometry3, Point3};
use rgbd_synth::{Sensor, Sequence};
use std::time::Instant;

/// Surface points of a mesh.
fn points(mesh: &TriMesh) -> Vec<[f64; 3]> {
    let vertices: Vec<_> = mesh.vertices.iter().map(|v| v.map(f64::from)).collect();
    sample_surface(MeshRef::new(&vertices, &mesh.triangles), 5000, 0)
}

fn main() -> Result<(), &'static str> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let has = |word: &str| words.iter().any(|w| w == word);
    let mut sequence = if has("demo") { Sequence::demo() } else { Sequence::tiny() };
    if has("perfect") {
        sequence = sequence.with_sensor(Sensor::perfect());
    }
    let count = words.iter().find_map(|w| w.parse().ok()).unwrap_or(12);
    sequence = sequence.truncated(count);
    let frames: Vec<_> = (0..sequence.len()).map(|i| sequence.render(i)).collect();
    let truth: Vec<Option<Isometry3<f64>>> = frames.iter().map(|f| Some(f.cam_from_obj)).collect();
    let model = ModelPoints::new(points(sequence.mesh())).ok_or("the model is empty")?;

    println!("{}: {} frames", sequence.name(), frames.len());
    println!("method          tracked  ADD mean   at end   chamfer  ms/frame");
    for method in Baseline::ALL {
        let mut tracker = method.tracker(&BaselineConfig::default());
        let start = Instant::now();
        let poses: Vec<_> = frames.iter().map(|f| tracker.track(&f.frame)).collect();
        let ms = start.elapsed().as_secs_f64() * 1e3 / frames.len() as f64;
        let tracked = poses.iter().filter(|p| p.tracked).count();
        let found: Vec<_> = poses.iter().map(|p| Some(p.cam_from_obj)).collect();
        let errors: Vec<f64> = rebase(&found, &truth)
            .iter()
            .zip(&truth)
            .filter_map(|(p, t)| Some(1e3 * add(p.as_ref()?, t.as_ref()?, &model)))
            .collect();
        let gt_from_pred = eval_metrics::alignment(&found, &truth).ok_or("no pose")?.inverse();
        let mesh: Vec<[f64; 3]> =
            points(&tracker.mesh(0.003)).iter().map(|p| (gt_from_pred * Point3::from(*p)).into()).collect();
        let chamfer = chamfer_distance(&mesh, model.points()).map_or(f64::NAN, |d| 1e3 * d);
        println!(
            "{:<15} {tracked:>7} {:>6.2} mm {:>5.2} mm {chamfer:>6.2} mm {ms:>9.1}",
            method.name(),
            errors.iter().sum::<f64>() / errors.len().max(1) as f64,
            errors.last().copied().unwrap_or(f64::NAN),
        );
    }
    Ok(())
}
