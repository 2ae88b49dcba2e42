//! Extraction speed in lattice points per second: dense 256^3, and the sparse grid around the same surface.
#![allow(missing_docs, clippy::unwrap_used)]

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use marching_cubes::{SparseGrid, extract_dense};
use std::hint::black_box;

const N: usize = 256;

fn sphere(p: [f32; 3]) -> f32 {
    p.iter().map(|v| v * v).sum::<f32>().sqrt() - 0.4
}

/// About ten times the surface of the sphere.
fn gyroid(p: [f32; 3]) -> f32 {
    let [x, y, z] = p.map(|v| v * 30.0);
    x.sin() * y.cos() + y.sin() * z.cos() + z.sin() * x.cos()
}

fn sampled(field: fn([f32; 3]) -> f32) -> Vec<f32> {
    let at = |i: usize| i as f32 / (N - 1) as f32 - 0.5;
    (0..N * N * N).map(|i| field([at(i % N), at(i / N % N), at(i / (N * N))])).collect()
}

fn dense(c: &mut Criterion) {
    let mut group = c.benchmark_group("dense 256^3");
    group.sample_size(10).throughput(Throughput::Elements((N * N * N) as u64));
    for (name, field) in [("sphere", sphere as fn(_) -> _), ("gyroid", gyroid)] {
        let values = sampled(field);
        let h = 1.0 / (N - 1) as f32;
        group.bench_function(name, |b| {
            b.iter(|| extract_dense([N; 3], black_box(&values), [-0.5; 3], h, 0.0));
        });
    }
    group.finish();
}

fn sparse(c: &mut Criterion) {
    let boxes = || {
        (0..50 * 50 * 50)
            .map(|i| [i % 50, i / 50 % 50, i / 2500].map(|c| c as f32 * 0.02 - 0.5))
            .filter(|lo| sphere(lo.map(|v| v + 0.01)).abs() < 0.03)
            .map(|lo| (lo, lo.map(|v| v + 0.02)))
    };
    let cover = || SparseGrid::covering(boxes(), 1.0 / 255.0, usize::MAX).unwrap();
    let grid = cover();
    let values: Vec<f32> = grid.points().into_iter().map(sphere).collect();
    let mut group = c.benchmark_group("sparse sphere shell");
    group.sample_size(10).throughput(Throughput::Elements(grid.len() as u64));
    group.bench_function("covering", |b| b.iter(cover));
    group.bench_function("points", |b| b.iter(|| grid.points()));
    group.bench_function("extract", |b| b.iter(|| grid.extract(black_box(&values), 0.0)));
    group.finish();
}

criterion_group!(benches, dense, sparse);
criterion_main!(benches);
