//! What can go wrong with an input.

use std::path::PathBuf;

/// An input that can't be used: which file, what is wrong, and what to do about it. Prints as one line.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
#[error("{}: {problem}; {remedy}", path.display())]
pub struct Error {
    /// The file or folder.
    pub path: PathBuf,
    /// What is wrong with it, lower case.
    pub problem: String,
    /// What the user can do, lower case.
    pub remedy: String,
}

impl Error {
    /// An error about `path`; line breaks in the two texts become spaces.
    pub fn new(path: impl Into<PathBuf>, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { path: path.into(), problem: one_line(problem.into()), remedy: one_line(remedy.into()) }
    }

    /// What to do about a failed read or write of `path`, from the kind of failure.
    pub(crate) fn io(path: impl Into<PathBuf>, what: &str, error: &std::io::Error) -> Self {
        use std::io::ErrorKind as Kind;
        let remedy = match error.kind() {
            Kind::NotFound => "check the path and that its folder exists",
            Kind::PermissionDenied => "check the permissions of the file and its folder",
            Kind::StorageFull | Kind::QuotaExceeded => "the disk is full: free some space or write elsewhere",
            Kind::ReadOnlyFilesystem => "the file system is read-only: write elsewhere",
            Kind::IsADirectory | Kind::AlreadyExists => {
                "a folder or file of this name is in the way: remove it"
            }
            Kind::NotADirectory => "a part of the path is a file and not a folder: check the path",
            _ => "check the disk, the path and its permissions",
        };
        Self::new(path, format!("{what} failed ({error})"), remedy)
    }
}

fn one_line(text: String) -> String {
    if text.contains(['\n', '\r']) {
        text.split(['\n', '\r']).map(str::trim).filter(|s| !s.is_empty()).collect::<Vec<_>>().join(" ")
    } else {
        text
    }
}
