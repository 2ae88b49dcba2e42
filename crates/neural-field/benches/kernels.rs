//! The kernels of a training step one by one: `cargo bench -p neural-field --features bench --bench kernels`.
#![allow(missing_docs, clippy::unwrap_used)]

#[path = "../tests/scene/mod.rs"]
mod scene;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use neural_field::FieldConfig;
use neural_field::bench::Kernels;
use scene::{Shape, views};

fn kernels(c: &mut Criterion) {
    let (frames, poses) = views(&Shape::Sphere { radius: 0.1 }, 12, 80);
    for (name, config) in [
        ("realtime", FieldConfig::realtime()),
        ("paper", FieldConfig::paper()),
        ("refine", FieldConfig::refine()),
    ] {
        let mut k = Kernels::new(&config, &frames, &poses).unwrap();
        let mut group = c.benchmark_group(format!("one tile, {name}"));
        group.sample_size(20).throughput(Throughput::Elements(k.lanes() as u64));
        group.bench_function("sampler", |b| b.iter(|| k.sample()));
        group.bench_function("encode", |b| b.iter(|| k.encode()));
        group.bench_function("hidden layer", |b| b.iter(|| k.layer()));
        group.bench_function("forward and backward", |b| b.iter(|| k.tile()));
        group.bench_function("adam of the networks", |b| b.iter(|| k.adam()));
        group.finish();
    }
}

criterion_group!(benches, kernels);
criterion_main!(benches);
