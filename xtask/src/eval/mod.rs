//! `cargo xtask eval`: runs methods on sequences with known poses and mesh, and puts their scores under the published
//! ones.
//!
//! A job is a method on a sequence. It runs in a process of its own ([`queue`]) and leaves its results, what was asked
//! and its score in a folder of its own ([`job`]), so that a crash is a line of the table, and an evaluation that was
//! stopped goes on where it was.

mod args;
mod benchmark;
mod grid;
mod job;
mod json;
mod layout;
mod method;
mod peer;
mod published;
mod queue;
mod report;
mod score;
pub(crate) mod synth;
mod table;
mod track;
mod video;

use anyhow::Context;
use args::Plan;
pub(crate) use args::Target;
use job::Build;
use queue::{Outcome, Queue};
use std::io::IsTerminal;
use std::process::{Command, ExitCode};
use table::{Entry, Metric, Tables};

/// Evaluates on one dataset, or does one job of that.
pub(crate) fn run(target: &Target) -> anyhow::Result<ExitCode> {
    match (target, target.plan()?) {
        (Target::Job(args), _) => {
            queue::end_with_parent();
            if let Err(error) = job::work(&args.folder, args.no_run) {
                // In one line: the last one is what the table shows.
                eprintln!("{error:#}");
                return Ok(ExitCode::FAILURE);
            }
            Ok(ExitCode::SUCCESS)
        }
        (_, Some(plan)) => evaluate(&plan),
        (_, None) => Ok(ExitCode::SUCCESS),
    }
}

/// A job that fails is a line with its error, and fails the command at the end.
fn evaluate(plan: &Plan<'_>) -> anyhow::Result<ExitCode> {
    let queue = Queue {
        parallel: usize::from(plan.how.jobs),
        force: plan.how.force,
        only_score: plan.how.no_run,
        build: this_build(),
    };
    let outcomes = queue.run(&plan.jobs)?;
    let entries: Vec<Entry> = plan.jobs.iter().zip(&outcomes).filter_map(|(j, o)| entry(j, o)).collect();
    let tables = Tables::new(
        plan.benchmark,
        &entries,
        &published::table(plan.benchmark)?,
        published::ablations(plan.benchmark)?,
    );
    let notes = layout::notes(&tables, &entries, &plan.masks);
    print(&tables, &entries, &notes);
    if let Some(path) = &plan.how.json {
        json::write(path, &tables, &entries, &notes)?;
    }
    if let Some(dir) = &plan.how.report {
        let page = report::write(dir, &tables, &entries, &notes, &queue.build)?;
        println!("report: {}", page.display());
    }
    let stopped = outcomes.iter().filter(|o| **o == Outcome::Stopped).count();
    if stopped > 0 {
        eprintln!("stopped with {stopped} of {} jobs not done; the same command goes on", outcomes.len());
        return Ok(ExitCode::from(130));
    }
    Ok(if entries.iter().any(|e| e.score.is_err()) { ExitCode::FAILURE } else { ExitCode::SUCCESS })
}

fn entry(job: &job::Job, outcome: &Outcome) -> Option<Entry> {
    let (score, other_build) = match outcome {
        Outcome::Stopped => return None,
        Outcome::Failed(error) => (Err(error.clone()), None),
        Outcome::Done(build) => (job.score().map_err(|e| format!("{e:#}")), build.clone()),
    };
    Some(Entry { asked: job.asked.clone(), score, other_build })
}

fn print(tables: &Tables, entries: &[Entry], notes: &[String]) {
    if entries.is_empty() {
        return;
    }
    let bold = std::io::stdout().is_terminal();
    println!("{}", layout::details(entries).terminal(bold));
    if tables.columns.len() > 1 {
        Metric::ALL.iter().for_each(|m| println!("{}", layout::by_group(tables, *m).terminal(bold)));
    }
    for grid in layout::ablations(tables).into_iter().chain(layout::pooled(tables)) {
        println!("{}", grid.terminal(bold));
    }
    println!("{}", layout::means(tables).terminal(bold));
    notes.iter().for_each(|note| println!("{note}"));
    for entry in entries {
        if let Err(error) = &entry.score {
            println!("{} on {} failed: {error}", entry.asked.method.name(), entry.asked.place.name);
        }
    }
}

/// This program, with the commit that the working tree is at.
fn this_build() -> Build {
    let git = |arguments: &[&str]| {
        let output = Command::new("git").arg("-C").arg(crate::tidy::root()).args(arguments).output().ok()?;
        output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
    };
    let is_changed = git(&["status", "--porcelain", "--untracked-files=no"]).is_some_and(|s| !s.is_empty());
    let commit = git(&["rev-parse", "--short", "HEAD"]);
    let commit = commit.map(|c| if is_changed { format!("{c}+") } else { c });
    Build { version: env!("CARGO_PKG_VERSION").to_owned(), commit }
}

/// Writes a file whose folder may not be there yet.
fn write_text(path: &std::path::Path, text: &str) -> anyhow::Result<()> {
    if let Some(folder) = path.parent().filter(|f| !f.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).with_context(|| format!("{} can't be created", folder.display()))?;
    }
    std::fs::write(path, text).with_context(|| format!("{} can't be written", path.display()))
}
