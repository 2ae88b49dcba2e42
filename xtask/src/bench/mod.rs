//! Benchmarks of single parts, each with its peer where there is one.

mod field;
mod marching_cubes;
mod peer;

use std::process::ExitCode;

/// The parts that can be measured alone.
#[derive(clap::Subcommand)]
pub(crate) enum Part {
    /// The neural field's training step: speed, share of each kernel, and how near it comes to the machine's peak.
    Field(field::FieldArgs),
    /// Surface extraction in voxels per second.
    MarchingCubes(marching_cubes::MarchingCubesArgs),
}

/// Measures one part.
pub(crate) fn run(part: &Part) -> anyhow::Result<ExitCode> {
    match part {
        Part::Field(args) => field::run(args),
        Part::MarchingCubes(args) => marching_cubes::run(args),
    }
}
