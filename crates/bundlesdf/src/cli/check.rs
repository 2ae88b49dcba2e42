//! `bundlesdf check`.

use std::process::ExitCode;

use rgbd_io::inspect;

use super::{CheckArgs, EXIT_BAD_INPUT, run::custom_options};

/// Prints what a folder holds and what is wrong with it.
pub(super) fn check(args: &CheckArgs) -> anyhow::Result<ExitCode> {
    let inspection = inspect(&args.input, &custom_options(&args.input_options));
    super::run::print(&format!("{}\n", inspection.to_string().trim_end()));
    Ok(if inspection.has_errors() { ExitCode::from(EXIT_BAD_INPUT) } else { ExitCode::SUCCESS })
}
