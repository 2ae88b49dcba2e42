//! Checks the rules of docs/architecture.md that a machine can check. Runs as a command and as a test.

mod code;
mod layers;
mod reliability;
mod rules;
mod tree;

use anyhow::Context;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// The repository's root folder.
pub(crate) fn root() -> PathBuf {
    let here = std::env::var_os("CARGO_MANIFEST_DIR")
        .map_or_else(|| env!("CARGO_MANIFEST_DIR").into(), PathBuf::from);
    here.parent().map_or_else(|| here.clone(), Path::to_path_buf)
}

/// Prints what is not tidy; fails if there is anything.
pub(crate) fn run() -> anyhow::Result<ExitCode> {
    let problems = check(&root())?;
    for problem in &problems {
        println!("{problem}");
    }
    println!("{} problems", problems.len());
    Ok(if problems.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Everything that is not tidy, one line each.
fn check(root: &Path) -> anyhow::Result<Vec<String>> {
    let tree = tree::Tree::read(root).with_context(|| format!("{} can't be listed", root.display()))?;
    let mut problems = layers::check(&tree);
    problems.extend(rules::check(&tree));
    problems.extend(reliability::check(&tree));
    problems.sort();
    Ok(problems)
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_tree_is_tidy() {
        let problems = super::check(&super::root()).unwrap();
        assert!(problems.is_empty(), "cargo xtask tidy:\n{}", problems.join("\n"));
    }
}
