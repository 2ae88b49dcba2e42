//! Scripts outside the repository that do the same work with other software.

use crate::python;
use std::path::PathBuf;

/// Where a peer is and what runs it.
#[derive(clap::Args)]
pub(super) struct PeerArgs {
    /// Python script of the peer; without it only our own speed is measured.
    #[arg(long, value_name = "PATH")]
    peer: Option<PathBuf>,
    /// Python that has what the peer needs.
    #[arg(long, value_name = "PROGRAM", default_value = "python3")]
    python: PathBuf,
}

impl PeerArgs {
    /// What the peer prints, or why there is nothing; the reason is printed.
    pub(super) fn output(&self, arguments: &[&str]) -> Option<String> {
        let Some(script) = &self.peer else {
            println!("peer: skipped, no --peer PATH");
            return None;
        };
        match python::output(&self.python, script, arguments) {
            Ok(bytes) => Some(String::from_utf8_lossy(&bytes).into_owned()),
            Err(reason) => {
                println!("peer: skipped, {reason:#}");
                None
            }
        }
    }
}

/// The number that follows `key` in `text`.
pub(super) fn number_after(text: &str, key: &str) -> Option<f64> {
    let rest = &text[text.find(key)? + key.len()..];
    let end = rest.find(|c: char| !(c.is_ascii_digit() || c == '.')).unwrap_or(rest.len());
    rest[..end].parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_found_by_their_key() {
        let line = "device=cpu s/step=1.2345 s/300 steps=370.3 loss=0.1";
        assert_eq!(number_after(line, "s/step="), Some(1.2345));
        assert_eq!(number_after(line, "steps="), Some(370.3));
        assert_eq!(number_after(line, "volts="), None);
    }
}
