//! Benchmarks of single parts, each with its peer where there is one.

mod field;
mod marching_cubes;
mod mask;
mod peer;
mod posegraph;
mod surface;
mod texture;
mod tracker;

use clap::Subcommand;
use std::process::ExitCode;

/// The parts that can be measured alone.
#[derive(Subcommand)]
pub(crate) enum Part {
    /// The neural field's training step: speed, share of each kernel, and how near it comes to the machine's peak.
    Field(field::FieldArgs),
    /// Surface extraction in voxels per second.
    MarchingCubes(marching_cubes::MarchingCubesArgs),
    /// The built-in segmenter: region J, boundary F and time per frame, with the true poses in place of a tracker.
    Mask(mask::MaskArgs),
    /// Public pose graphs to their optimum: cost, steps and time, beside GTSAM's.
    Posegraph(posegraph::PosegraphArgs),
    /// The tracker: frames per second and milliseconds by stage, alone and beside the field's training.
    Tracker(tracker::TrackerArgs),
    /// The field's surface and poses against the true ones, apart from the tracker.
    Surface(surface::SurfaceArgs),
    /// The texture: how far its colours are from the true ones in frames that it wasn't made from.
    Texture(texture::TextureArgs),
}

/// Measures one part.
pub(crate) fn run(part: &Part) -> anyhow::Result<ExitCode> {
    match part {
        Part::Field(args) => field::run(args),
        Part::MarchingCubes(args) => marching_cubes::run(args),
        Part::Mask(args) => mask::run(args),
        Part::Posegraph(args) => posegraph::run(args),
        Part::Tracker(args) => tracker::run(args),
        Part::Surface(args) => surface::run(args),
        Part::Texture(args) => texture::run(args),
    }
}
