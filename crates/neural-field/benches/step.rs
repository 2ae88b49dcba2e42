//! Cost of training steps and of the tracker's queries: `cargo bench -p neural-field`.
#![allow(missing_docs, clippy::unwrap_used)]

#[path = "../tests/scene/mod.rs"]
mod scene;

use criterion::{Criterion, criterion_group, criterion_main};
use neural_field::{Control, FieldConfig, train};
use scene::{Shape, noise, views};
use std::hint::black_box;

fn steps(c: &mut Criterion) {
    let (frames, poses) = views(&Shape::Sphere { radius: 0.1 }, 20, 120);
    let mut group = c.benchmark_group("train");
    group.sample_size(10);
    // The difference of the two is 20 steps; the first is mostly preparation and residuals.
    for steps in [1, 21] {
        let config = FieldConfig { steps, ..FieldConfig::realtime() };
        group.bench_function(format!("{steps} steps of the realtime configuration"), |b| {
            b.iter(|| train(&config, &frames, &poses, &Control::default()).unwrap());
        });
    }
    group.finish();
}

fn queries(c: &mut Criterion) {
    let shape = Shape::Sphere { radius: 0.1 };
    let (frames, poses) = views(&shape, 8, 80);
    let field =
        train(&FieldConfig { steps: 20, ..FieldConfig::realtime() }, &frames, &poses, &Control::default())
            .unwrap();
    let points: Vec<[f32; 3]> = (0..1000).map(|i| [0, 1, 2].map(|a| 0.1 * noise(3 * i + a) as f32)).collect();
    let (mut sdf, mut gradient) = (vec![0.0; 1000], vec![[0.0; 3]; 1000]);
    c.bench_function("sdf of 1000 points", |b| b.iter(|| field.sdf(black_box(&points), &mut sdf)));
    c.bench_function("sdf and gradient of 1000 points", |b| {
        b.iter(|| field.sdf_and_gradient(black_box(&points), &mut sdf, &mut gradient));
    });
}

criterion_group!(benches, steps, queries);
criterion_main!(benches);
