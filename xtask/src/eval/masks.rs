//! Which masks a sequence is tracked with.

use std::collections::HashSet;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// Folder of original masks, and of those derived from the truth.
const ORIGINAL: &str = "masks";
const DERIVED: &str = "masks_derived";

/// The arguments for `bundlesdf run` that stand for `--masks choice`; `ids` are the frames that will be used.
pub(super) fn arguments(choice: &str, dir: &Path, ids: &[String]) -> anyhow::Result<Vec<OsString>> {
    match choice {
        "all" => {
            let folder = [ORIGINAL, DERIVED].map(|name| dir.join(name));
            let Some(complete) = folder.iter().find(|folder| has_all(folder, ids)) else {
                let [original, derived] = folder.map(|folder| describe(&folder, ids));
                anyhow::bail!("{original}, {derived}; give the folder of a complete set with --masks FOLDER");
            };
            // Absolute: a relative folder would be looked up inside the sequence's.
            let complete = complete.canonicalize().unwrap_or_else(|_| complete.clone());
            Ok(vec!["--masks".into(), complete.into()])
        }
        "first" => {
            let first = ids.first().map(String::as_str).unwrap_or_default();
            let mut arguments: Vec<OsString> = vec!["--masks".into(), "first".into()];
            if mask_of(&dir.join(ORIGINAL), first).is_none() {
                // Without one here either, the system's own message says what is missing.
                if let Some(mask) = mask_of(&dir.join(DERIVED), first) {
                    arguments.extend(["--first-mask".into(), mask.into()]);
                }
            }
            Ok(arguments)
        }
        folder => Ok(vec!["--masks".into(), folder.into()]),
    }
}

fn mask_of(folder: &Path, id: &str) -> Option<PathBuf> {
    let path = folder.join(format!("{id}.png"));
    let path = path.canonicalize().ok()?;
    path.is_file().then_some(path)
}

/// Stems of the PNG files in a folder; none if it can't be read.
fn stems(folder: &Path) -> HashSet<String> {
    let Ok(entries) = std::fs::read_dir(folder) else { return HashSet::new() };
    entries
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| path.extension().is_some_and(|e| e.eq_ignore_ascii_case("png")))
        .filter_map(|path| Some(path.file_stem()?.to_string_lossy().into_owned()))
        .collect()
}

fn has_all(folder: &Path, ids: &[String]) -> bool {
    let stems = stems(folder);
    ids.iter().all(|id| stems.contains(id))
}

fn describe(folder: &Path, ids: &[String]) -> String {
    let stems = stems(folder);
    let found = ids.iter().filter(|id| stems.contains(*id)).count();
    format!("{} has masks of {found} of {} frames", folder.display(), ids.len())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    fn sequence(original: &[&str], derived: &[&str]) -> (tempfile::TempDir, Vec<String>) {
        let dir = tempfile::tempdir().unwrap();
        for (folder, ids) in [(ORIGINAL, original), (DERIVED, derived)] {
            fs::create_dir(dir.path().join(folder)).unwrap();
            for id in ids {
                fs::write(dir.path().join(folder).join(format!("{id}.png")), "").unwrap();
            }
        }
        (dir, vec!["0000".into(), "0001".into()])
    }

    #[test]
    fn all_takes_the_complete_folder() {
        let (dir, ids) = sequence(&["0000", "0001"], &["0000", "0001"]);
        assert!(arguments("all", dir.path(), &ids).unwrap()[1].to_string_lossy().ends_with("masks"));
        let (dir, ids) = sequence(&["0000"], &["0000", "0001"]);
        assert!(arguments("all", dir.path(), &ids).unwrap()[1].to_string_lossy().ends_with("masks_derived"));
        let (dir, ids) = sequence(&["0000"], &["0001"]);
        let error = arguments("all", dir.path(), &ids).unwrap_err().to_string();
        assert!(
            error.contains("masks has masks of 1 of 2") && error.contains("masks_derived has"),
            "{error}"
        );
    }

    #[test]
    fn first_falls_back_to_the_derived_mask() {
        let (dir, ids) = sequence(&["0000"], &["0000"]);
        assert_eq!(arguments("first", dir.path(), &ids).unwrap(), ["--masks", "first"]);
        let (dir, ids) = sequence(&["0001"], &["0000"]);
        let found = arguments("first", dir.path(), &ids).unwrap();
        assert_eq!(found[..3], ["--masks", "first", "--first-mask"]);
        assert!(Path::new(&found[3]).ends_with("masks_derived/0000.png"));
        let (dir, ids) = sequence(&[], &[]);
        assert_eq!(arguments("first", dir.path(), &ids).unwrap(), ["--masks", "first"]);
    }

    #[test]
    fn a_folder_is_passed_on() {
        assert_eq!(arguments("some/folder", Path::new("."), &[]).unwrap(), ["--masks", "some/folder"]);
    }
}
