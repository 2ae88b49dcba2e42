//! Builds the binary and runs it on one sequence.

use super::{How, Schedule};
use anyhow::Context;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Builds `bundlesdf` in release mode and returns the program's path.
pub(super) fn build() -> anyhow::Result<PathBuf> {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let output = Command::new(cargo)
        .args(["build", "--release", "--package", "bundlesdf", "--bin", "bundlesdf"])
        .arg("--message-format=json-render-diagnostics")
        .arg("--manifest-path")
        .arg(crate::tidy::root().join("Cargo.toml"))
        .stderr(Stdio::inherit())
        .output()
        .context("cargo can't be started; run this as `cargo xtask`")?;
    anyhow::ensure!(output.status.success(), "the bundlesdf binary doesn't build");
    String::from_utf8_lossy(&output.stdout)
        .lines()
        .filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok())
        .filter(|message| message["target"]["name"] == "bundlesdf")
        .find_map(|message| message["executable"].as_str().map(PathBuf::from))
        .context("cargo built no bundlesdf binary; does crates/bundlesdf still have a src/main.rs?")
}

/// Runs the system on `dir`; its messages go to `<out>.log`.
pub(super) fn run(
    program: &Path,
    args: &How,
    dir: &Path,
    masks: &[std::ffi::OsString],
    out: &Path,
) -> anyhow::Result<()> {
    std::fs::create_dir_all(&args.out).with_context(|| {
        format!("{} can't be created; choose another folder with --out", args.out.display())
    })?;
    // A run that fails early must not pass for the one before it.
    let report = out.join("run.json");
    if report.exists() {
        std::fs::remove_file(&report).with_context(|| format!("{} can't be removed", report.display()))?;
    }
    let mut command = Command::new(program);
    command.arg("run").arg(dir).arg("--out").arg(out).arg("--force").args(masks);
    command.args([
        "--schedule",
        match args.schedule {
            Schedule::Lockstep => "lockstep",
            Schedule::Realtime => "realtime",
        },
    ]);
    if args.stride > 1 {
        command.arg("--stride").arg(args.stride.to_string());
    }
    if let Some(config) = &args.config {
        command.arg("--config").arg(config);
    }
    eprintln!("running {}", dir.display());
    let output = command.stdin(Stdio::null()).output().context("the bundlesdf binary can't be started")?;

    let mut log = out.as_os_str().to_owned();
    log.push(".log");
    let text = [output.stdout.as_slice(), output.stderr.as_slice()].concat();
    std::fs::write(&log, text).with_context(|| format!("{} can't be written", log.display()))?;

    if !output.status.success() {
        let errors = String::from_utf8_lossy(&output.stderr);
        let last = errors.lines().rev().map(str::trim).find(|l| !l.is_empty()).unwrap_or("no message");
        anyhow::bail!("{last} ({}, see {})", output.status, log.display());
    }
    Ok(())
}
