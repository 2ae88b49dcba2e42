//! The project's own commands: `cargo xtask eval` scores the system on sequences with known truth, `cargo xtask bench`
//! measures single parts, `cargo xtask tidy` checks the rules of the tree.
#![allow(clippy::print_stdout, reason = "a command line tool reports on standard output")]

mod bench;
mod eval;
mod python;
mod tidy;

use clap::{Parser, Subcommand};
use std::process::ExitCode;

#[derive(Parser)]
#[command(name = "cargo xtask", about = "The project's own commands")]
struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Run the system, its ablations and other methods on sequences with known poses and mesh, and print their scores
    /// under the published ones.
    Eval {
        #[command(subcommand)]
        target: Box<eval::Target>,
    },
    /// Measure the speed of single parts, against a peer where one is given.
    Bench {
        #[command(subcommand)]
        part: bench::Part,
    },
    /// Check the rules of the tree: layers, docs, file sizes, what code may touch.
    Tidy,
}

fn main() -> anyhow::Result<ExitCode> {
    match Args::parse().command {
        Command::Eval { target } => eval::run(&target),
        Command::Bench { part } => bench::run(&part),
        Command::Tidy => tidy::run(),
    }
}
