//! What the fuzzer feeds with hostile bytes: one function for every kind of input that comes from outside.
//!
//! The bodies live here and not in `fuzz/`, so that libFuzzer (see `fuzz/README.md`) and the smoke test under plain
//! `cargo test` run the very same code. A body never fails on an error that a parser returns; it fails when a parser
//! panics, and when what it accepted breaks the parser's own promise: a pose that is not finite, a face without its
//! vertices, a file that does not read back as it was written.
//!
//! ```
//! let target = fuzz_targets::TARGETS.iter().find(|target| target.name == "mesh").ok_or("no such target")?;
//! (target.run)(b"v 0 0 0\nf 1 2 3\n");
//! # Ok::<(), &str>(())
//! ```

mod bytes;
mod datasets;
mod files;
mod images;
mod json;
mod mesh;
mod mutate;
mod pickle;
mod pose_graph;
mod text;
mod tracker;
mod weights;

pub use mutate::mutate;

/// A kind of input.
#[derive(Clone, Copy, Debug)]
pub struct Target {
    /// Name of the target, of its folder in `fuzz/seeds/`, and of its program in `fuzz/fuzz_targets/`.
    pub name: &'static str,
    /// Takes one input; panics where there is a fault.
    pub run: fn(&[u8]),
}

/// All of them.
pub const TARGETS: [Target; 10] = [
    Target { name: "images", run: images::run },
    Target { name: "pickle", run: pickle::run },
    Target { name: "json", run: json::run },
    Target { name: "text", run: text::run },
    Target { name: "mesh", run: mesh::run },
    Target { name: "weights", run: weights::run_files },
    Target { name: "networks", run: weights::run_networks },
    Target { name: "g2o", run: pose_graph::run },
    Target { name: "datasets", run: datasets::run },
    Target { name: "tracker", run: tracker::run },
];

/// Runs the target of that name; an unknown name is a fault of the caller and shows as such.
pub fn run(name: &str, data: &[u8]) {
    let target = TARGETS.iter().find(|target| target.name == name);
    assert!(target.is_some(), "there is no target {name}");
    if let Some(target) = target {
        (target.run)(data);
    }
}

/// The promise of every reader of poses: finite, and a rotation up to rounding.
fn check_pose(pose: &nalgebra::Isometry3<f64>) {
    let m = pose.to_homogeneous();
    assert!(m.iter().all(|v| v.is_finite()), "pose isn't finite: {pose}");
    assert!((pose.rotation.norm() - 1.0).abs() < 1e-6, "rotation isn't one: {pose}");
}
