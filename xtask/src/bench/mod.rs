//! Benchmarks of single parts, each with its peer where there is one.

mod field;
mod marching_cubes;
mod mask;
mod peer;

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
}

/// Measures one part.
pub(crate) fn run(part: &Part) -> anyhow::Result<ExitCode> {
    match part {
        Part::Field(args) => field::run(args),
        Part::MarchingCubes(args) => marching_cubes::run(args),
        Part::Mask(args) => mask::run(args),
    }
}
