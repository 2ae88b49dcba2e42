//! Builds an octree around a sphere shell, casts rays at it and prints counts and the time a ray takes.
#![allow(clippy::print_stdout)]

use octree_sampler::{VoxelOctree, sampling};
use rand::{RngExt, SeedableRng};
use std::time::{Duration, Instant};

/// The least disturbed of a few runs.
fn best_of_five(mut work: impl FnMut()) -> Duration {
    let time = |_| {
        let start = Instant::now();
        work();
        start.elapsed()
    };
    (0..5).map(time).min().unwrap_or_default()
}

fn main() {
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(7);
    let points: Vec<[f32; 3]> = (0..200_000)
        .map(|_| {
            let z: f32 = rng.random_range(-1.0..1.0);
            let (sin, cos) = rng.random_range(0.0..std::f32::consts::TAU).sin_cos();
            let r = (1.0 - z * z).sqrt();
            [0.15 * r * cos, 0.15 * r * sin, 0.15 * z]
        })
        .collect();
    for voxel_size in [0.02, 0.01, 0.005, 0.0025] {
        let start = Instant::now();
        let Some(octree) = VoxelOctree::from_points(&points, voxel_size, 1) else { return };
        let build = start.elapsed();
        let rays: Vec<[f32; 3]> =
            (0..100_000).map(|_| [rng.random_range(-0.2..0.2), rng.random_range(-0.2..0.2), 1.0]).collect();
        let (mut out, mut depths, mut hits) = (Vec::new(), Vec::new(), 0);
        let walk = best_of_five(|| {
            hits = 0;
            for ray in &rays {
                octree.intervals([0.0, 0.0, -0.8], *ray, 0.1, 3.0, &mut out);
                hits += usize::from(!out.is_empty());
            }
        });
        let both = best_of_five(|| {
            for ray in &rays {
                octree.intervals([0.0, 0.0, -0.8], *ray, 0.1, 3.0, &mut out);
                depths.clear();
                sampling::stratified(&out, 128, || rng.random(), &mut depths);
            }
        });
        println!(
            "voxel {voxel_size:.4} m: {} voxels built in {build:.1?}, {hits} of {} rays hit, {:.0} ns a ray, \
             {:.0} ns with 128 samples",
            octree.len(),
            rays.len(),
            walk.as_nanos() as f64 / rays.len() as f64,
            both.as_nanos() as f64 / rays.len() as f64,
        );
    }
}
