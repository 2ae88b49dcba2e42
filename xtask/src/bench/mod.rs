//! Benchmarks of single parts.

mod mask;

use clap::Subcommand;
use std::process::ExitCode;

/// The parts that can be measured alone.
#[derive(Subcommand)]
pub(crate) enum Part {
    /// The built-in segmenter: region J, boundary F and time per frame, with the true poses in place of a tracker.
    Mask(mask::MaskArgs),
}

/// Measures one part.
pub(crate) fn run(part: &Part) -> anyhow::Result<ExitCode> {
    match part {
        Part::Mask(args) => mask::run(args),
    }
}
