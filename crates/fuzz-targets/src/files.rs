//! A place for the readers that take paths.

use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// A folder of one's own, in memory where the system has such a place; `None` where none can be made.
pub(crate) fn folder() -> Option<TempDir> {
    let memory = Path::new("/dev/shm");
    let in_memory = if memory.is_dir() { tempfile::tempdir_in(memory).ok() } else { None };
    in_memory.or_else(|| tempfile::tempdir().ok())
}

/// All files below `dir`, sorted.
pub(crate) fn files_below(dir: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let Ok(entries) = std::fs::read_dir(dir) else { return found };
    for path in entries.flatten().map(|entry| entry.path()) {
        if path.is_dir() {
            found.extend(files_below(&path));
        } else {
            found.push(path);
        }
    }
    found.sort();
    found
}
