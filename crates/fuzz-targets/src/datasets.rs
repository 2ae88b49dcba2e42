//! Whole folders of every dataset's layout with one file changed.
//!
//! The first byte chooses the layout, the second the file, the third the options. With the highest bit of the options the
//! rest of the input replaces the file (without a rest, the file is removed); else it is a list of changes to it. This reaches the readers that take no bytes, and what happens between files: sizes that differ,
//! cameras of another image.

use crate::bytes::Bytes;
use crate::{check_pose, files};
use rgbd_io::datasets::{Dataset, DatasetOptions};
use rgbd_io::{CustomOptions, FrameSource, MaskSource};
use rgbd_synth::{Sequence, SequenceSpec};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// A dataset of one sequence.
struct Folder {
    dataset: Dataset,
    place: TempDir,
    name: String,
    files: Vec<(PathBuf, Vec<u8>)>,
}

thread_local! {
    static FOLDERS: Vec<Folder> = folders();
}

/// Two frames of 24 x 18 pixels.
fn sequence() -> Option<Sequence> {
    let tiny = Sequence::tiny().spec().clone();
    let intrinsics = tiny.intrinsics.scaled(0.15, 0.15);
    Sequence::new(SequenceSpec { width: 24, height: 18, frames: 2, intrinsics, ..tiny }).ok()
}

fn folders() -> Vec<Folder> {
    let Some(sequence) = sequence() else { return Vec::new() };
    let make = |dataset: Dataset| {
        let place = files::folder()?;
        let root = place.path();
        let name = match dataset {
            Dataset::Ho3d => rgbd_synth::write_ho3d(&sequence, root),
            Dataset::YcbInEoat => rgbd_synth::write_ycbineoat(&sequence, root),
            Dataset::Behave => rgbd_synth::write_behave(&sequence, root),
            Dataset::Bop => rgbd_synth::write_bop(&sequence, root),
            Dataset::Tum => rgbd_synth::write_tum(&sequence, root),
            _ => rgbd_synth::write_custom(&sequence, root.join("tiny")).map(|()| "tiny".to_owned()),
        };
        shrink_models(root);
        let stored =
            |path: PathBuf| std::fs::read(&path).map_or((PathBuf::new(), Vec::new()), |bytes| (path, bytes));
        let files = files::files_below(root).into_iter().map(stored).collect();
        Some(Folder { dataset, name: name.ok()?, files, place })
    };
    Dataset::ALL.into_iter().filter_map(make).collect()
}

/// Models of a few bytes: the `mesh` target has the large ones.
fn shrink_models(root: &Path) {
    for path in files::files_below(root) {
        let text = match path.extension().and_then(|e| e.to_str()) {
            Some("obj") => "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 3\n",
            Some("ply") => {
                "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
                 element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n9 0 0\n0 9 0\n3 0 1 2\n"
            }
            _ => continue,
        };
        // The readers' errors about a model that is missing are wanted, too.
        let _ = std::fs::write(&path, text);
    }
}

pub(crate) fn run(data: &[u8]) {
    let mut bytes = Bytes(data);
    FOLDERS.with(|folders| {
        assert_eq!(folders.len(), Dataset::ALL.len(), "the folders can't be written");
        let Some(folder) = folders.get(bytes.below(folders.len())) else { return };
        let Some((path, original)) = folder.files.get(bytes.below(folder.files.len())) else { return };
        let options = bytes.byte();
        let changed = match options & 0x80 {
            0 => std::fs::write(path, edited(original, &mut bytes)),
            _ if bytes.is_empty() => std::fs::remove_file(path),
            _ => std::fs::write(path, bytes.rest()),
        };
        assert!(changed.is_ok(), "{changed:?}");
        read(folder, options);
        let restored = std::fs::write(path, original);
        assert!(restored.is_ok(), "{restored:?}");
    });
}

/// The file with a few changes: four bytes say where (two of them), what, and with which value.
fn edited(original: &[u8], bytes: &mut Bytes<'_>) -> Vec<u8> {
    let mut file = original.to_vec();
    while !bytes.is_empty() && !file.is_empty() {
        let at = (usize::from(bytes.byte()) << 8 | usize::from(bytes.byte())) % file.len();
        let (change, value) = (bytes.byte() % 5, bytes.byte());
        let end = (at + usize::from(value)).min(file.len());
        match change {
            0 => file.truncate(at),
            1 => drop(file.drain(at..end)),
            2 => file.insert(at, value),
            3 => {
                let copy: Vec<u8> = file.iter().skip(at).take(end - at).copied().collect();
                file.splice(at..at, copy);
            }
            _ => {
                if let Some(byte) = file.get_mut(at) {
                    *byte = value;
                }
            }
        }
    }
    file
}

fn read(folder: &Folder, choice: u8) {
    let options = DatasetOptions {
        masks: if choice & 1 == 0 { MaskSource::All } else { MaskSource::First },
        stride: usize::from(choice >> 1 & 3),
        scale_divisor: usize::from(choice >> 3 & 3),
        ..DatasetOptions::default()
    };
    let root = folder.place.path();
    let _ = folder.dataset.sequences(root);
    if folder.dataset == Dataset::Custom {
        assert!(!rgbd_io::inspect(root.join("tiny"), &CustomOptions::default()).to_string().is_empty());
    }
    let Ok(sequence) = folder.dataset.open(root, &folder.name, &options) else { return };
    assert!(!sequence.is_empty(), "opened without frames");
    for index in 0..sequence.len().min(3) {
        if let Ok(frame) = sequence.frame(index) {
            assert_eq!((frame.color.size(), frame.depth.size()), (sequence.size(), sequence.size()));
            assert!(frame.mask.is_none_or(|mask| mask.size() == sequence.size()));
            assert!(frame.intrinsics.fx > 0.0 && frame.depth.pixels().iter().all(|z| z.is_finite()));
        }
        let _ = sequence.occluder_mask(index);
    }
    if let Ok(truth) = sequence.truth() {
        truth.cam_from_obj.iter().flatten().for_each(check_pose);
        let _ = truth.read_model();
    }
}
