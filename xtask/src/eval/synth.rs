//! The synthetic suite as folders on disk.

use anyhow::Context;
use rgbd_synth::{Sequence, write_custom};
use std::path::{Path, PathBuf};

/// Written last: a folder without it was interrupted and is made anew.
const COMPLETE: &str = "complete";

/// One folder per sequence below `data`, made if it isn't there yet; all of the suite when `names` is empty.
pub(crate) fn folders(names: &[String], data: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let all = || Sequence::suite().map(str::to_owned).collect();
    let names: Vec<String> = if names.is_empty() { all() } else { names.to_vec() };
    names.iter().map(|name| folder(name, data)).collect()
}

fn folder(name: &str, data: &Path) -> anyhow::Result<PathBuf> {
    let sequence = Sequence::named(name).with_context(|| {
        let known: Vec<_> = Sequence::suite().collect();
        format!("there is no synthetic sequence {name}; there are {}", known.join(", "))
    })?;
    let folder = data.join(sequence.name());
    if !folder.join(COMPLETE).exists() {
        eprintln!("making {}, {} frames", folder.display(), sequence.len());
        write_custom(&sequence, &folder)?;
        std::fs::write(folder.join(COMPLETE), "")
            .with_context(|| format!("{} can't be written; choose another --data", folder.display()))?;
    }
    Ok(folder)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_name_is_refused_with_the_known_ones() {
        let error = folders(&["nonesuch".into()], Path::new("unused")).unwrap_err().to_string();
        assert!(error.contains("nonesuch") && error.contains("texture-less"), "{error}");
    }
}
