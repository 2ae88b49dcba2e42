//! The synthetic suite as folders on disk.

use anyhow::Context;
use rgbd_io::write_png_mask;
use rgbd_synth::{MaskFaults, Sequence, write_custom};
use std::path::Path;

/// Written last: a folder without it was interrupted and is made anew.
const COMPLETE: &str = "complete";
/// The masks that a method gets where they differ from the true ones in `masks/`.
pub(super) const GIVEN: &str = "given_masks";

/// Names of the suite's sequences below `data`, made if they aren't there yet; all of the suite when `names` is empty.
pub(crate) fn prepare(names: &[String], data: &Path) -> anyhow::Result<Vec<String>> {
    let all = || Sequence::suite().map(str::to_owned).collect();
    let names: Vec<String> = if names.is_empty() { all() } else { names.to_vec() };
    names.iter().map(|name| make(name, data)).collect()
}

fn make(name: &str, data: &Path) -> anyhow::Result<String> {
    let sequence = Sequence::named(name).with_context(|| {
        let known: Vec<_> = Sequence::suite().collect();
        format!("there is no synthetic sequence {name}; there are {}", known.join(", "))
    })?;
    let folder = data.join(sequence.name());
    if !folder.join(COMPLETE).exists() {
        eprintln!("making {}, {} frames", folder.display(), sequence.len());
        write_custom(&sequence, &folder)?;
        mark(&folder)?;
    }
    let given = folder.join(GIVEN);
    if sequence.spec().mask_faults != MaskFaults::none() && !given.join(COMPLETE).exists() {
        eprintln!("making {}", given.display());
        write_given_masks(&sequence, &given)?;
        mark(&given)?;
    }
    Ok(sequence.name().to_owned())
}

/// The masks with their faults.
fn write_given_masks(sequence: &Sequence, folder: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("{} can't be created", folder.display()))?;
    for index in 0..sequence.len() {
        let frame = sequence.render(index).frame;
        let mask = frame.mask.with_context(|| format!("{} has frames without masks", sequence.name()))?;
        write_png_mask(&folder.join(format!("{}.png", frame.id)), &mask)?;
    }
    Ok(())
}

fn mark(folder: &Path) -> anyhow::Result<()> {
    std::fs::write(folder.join(COMPLETE), "")
        .with_context(|| format!("{} can't be written; choose another --root", folder.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_name_is_refused_with_the_known_ones() {
        let error = prepare(&["nonesuch".into()], Path::new("unused")).unwrap_err().to_string();
        assert!(error.contains("nonesuch") && error.contains("texture-less"), "{error}");
    }
}
