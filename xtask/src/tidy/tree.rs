//! The text files of the repository.

use std::io;
use std::path::Path;

/// What holds no sources; the same as in .gitignore. In a second working tree `.git` is a file.
const SKIPPED: [&str; 6] = ["target", ".git", "out", "bundlesdf-demo", "corpus", "artifacts"];
/// No source is larger than this, bytes.
const LARGEST: u64 = 2 << 20;

/// A text file; the path is relative to the root, with forward slashes.
pub(super) struct File {
    pub(super) path: String,
    pub(super) text: String,
}

impl File {
    /// Folder of the workspace member that the file belongs to: `crates/<name>` or `xtask`.
    pub(super) fn member(&self) -> Option<&str> {
        if let Some(rest) = self.path.strip_prefix("crates/") {
            let name = rest.split('/').next().filter(|name| name.len() < rest.len())?;
            return self.path.get(.."crates/".len() + name.len());
        }
        self.path.starts_with("xtask/").then_some("xtask")
    }

    /// The path within its member.
    pub(super) fn within(&self) -> &str {
        self.member().and_then(|m| self.path.get(m.len() + 1..)).unwrap_or(&self.path)
    }

    pub(super) fn name(&self) -> &str {
        self.path.rsplit('/').next().unwrap_or(&self.path)
    }
}

/// All text files, sorted by path.
#[derive(Default)]
pub(super) struct Tree {
    pub(super) files: Vec<File>,
}

impl Tree {
    pub(super) fn read(root: &Path) -> io::Result<Self> {
        let mut tree = Self::default();
        tree.visit(root, "")?;
        tree.files.sort_by(|a, b| a.path.cmp(&b.path));
        Ok(tree)
    }

    fn visit(&mut self, dir: &Path, prefix: &str) -> io::Result<()> {
        for entry in std::fs::read_dir(dir)? {
            let entry = entry?;
            let name = entry.file_name().to_string_lossy().into_owned();
            if SKIPPED.contains(&name.as_str()) {
                continue;
            }
            let (kind, path) = (entry.file_type()?, format!("{prefix}{name}"));
            // Links are followed nowhere: what they point to is visited in its own place.
            if kind.is_dir() {
                self.visit(&entry.path(), &format!("{path}/"))?;
            } else if kind.is_file()
                && entry.metadata()?.len() <= LARGEST
                && let Ok(text) = String::from_utf8(std::fs::read(entry.path())?)
            {
                self.files.push(File { path, text });
            }
        }
        Ok(())
    }

    pub(super) fn get(&self, path: &str) -> Option<&File> {
        self.files.iter().find(|file| file.path == path)
    }

    /// Folders with a Cargo.toml: `crates/<name>` and `xtask`.
    pub(super) fn members(&self) -> impl Iterator<Item = &str> {
        self.files.iter().filter(|f| f.within() == "Cargo.toml").filter_map(File::member)
    }

    #[cfg(test)]
    pub(super) fn of(files: &[(&str, &str)]) -> Self {
        let file = |(path, text): &(&str, &str)| File { path: (*path).into(), text: (*text).into() };
        Self { files: files.iter().map(file).collect() }
    }
}
