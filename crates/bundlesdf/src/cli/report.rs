//! `bundlesdf report`, and the page at the end of a run.

use std::process::ExitCode;

use bundlesdf::{OutputFolder, html::write_page};

use super::{ReportArgs, log::Log, run::print};

/// Writes the page of a finished run.
pub(super) fn report(args: &ReportArgs) -> anyhow::Result<ExitCode> {
    let folder = OutputFolder::open(&args.results)?;
    print(&format!("{}\n", write_page(&folder)?.display()));
    Ok(ExitCode::SUCCESS)
}

/// Writes the page at the end of a run. The results are there without it: a failure is a warning.
pub(super) fn write_report(folder: &OutputFolder, log: Log) {
    if let Err(error) = write_page(folder) {
        log.warning(&format!("report.html is missing: {error}"));
    }
}
