//! Scripts that do the same work with other software.

use std::path::Path;
use std::process::Command;

use anyhow::{Context, bail};

/// Whether this Python can import `module`.
pub(crate) fn has(python: &Path, module: &str) -> bool {
    let import = format!("import {module}");
    Command::new(python).args(["-c", &import]).output().is_ok_and(|output| output.status.success())
}

/// What `script` prints.
pub(crate) fn output<S: AsRef<std::ffi::OsStr>>(
    python: &Path,
    script: &Path,
    arguments: &[S],
) -> anyhow::Result<Vec<u8>> {
    let output = Command::new(python)
        .arg(script)
        .args(arguments)
        .output()
        .with_context(|| format!("{} can't be started", python.display()))?;
    if !output.status.success() {
        let errors = String::from_utf8_lossy(&output.stderr);
        bail!("{} failed: {}", script.display(), errors.lines().last().unwrap_or("no message"));
    }
    Ok(output.stdout)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_python_has_no_modules_and_runs_nothing() {
        let none = Path::new("no-such-python");
        assert!(!has(none, "sys"));
        let error = output(none, Path::new("a.py"), &["1"]).unwrap_err().to_string();
        assert!(error.contains("no-such-python"), "{error}");
    }
}
