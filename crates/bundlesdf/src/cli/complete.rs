//! `bundlesdf completions` and `bundlesdf man`.

use std::process::ExitCode;

use anyhow::Context;
use clap::CommandFactory;

use super::{Cli, CompletionsArgs, ManArgs, run::print};

/// Prints a shell's completion script.
pub(super) fn completions(args: &CompletionsArgs) -> anyhow::Result<ExitCode> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut Cli::command(), "bundlesdf", &mut script);
    print(&String::from_utf8_lossy(&script));
    Ok(ExitCode::SUCCESS)
}

/// Prints the manual page, or writes one for every command.
pub(super) fn man(args: &ManArgs) -> anyhow::Result<ExitCode> {
    if let Some(folder) = &args.out {
        let failed =
            || format!("{}: can't be written to; choose a folder you may write to", folder.display());
        std::fs::create_dir_all(folder).with_context(failed)?;
        clap_mangen::generate_to(Cli::command(), folder).with_context(failed)?;
        return Ok(ExitCode::SUCCESS);
    }
    let mut page = Vec::new();
    clap_mangen::Man::new(Cli::command()).render(&mut page)?;
    print(&String::from_utf8_lossy(&page));
    Ok(ExitCode::SUCCESS)
}
