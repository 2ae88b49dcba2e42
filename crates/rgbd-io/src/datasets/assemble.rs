//! What the datasets have in common when their files are put together.

use std::path::Path;

use super::sequence::Frame;
use crate::{Error, MaskSource};

/// Fails when the camera isn't usable.
pub(super) fn check_camera(frame: &Frame, source: &str) -> Result<(), Error> {
    if frame.intrinsics.is_valid() {
        return Ok(());
    }
    Err(Error::new(&frame.color, format!("has an unusable camera {:?}", frame.intrinsics), source))
}

/// Leaves the masks that were asked for. The first frame's must be there, unless the dataset has no masks.
pub(super) fn choose_masks(frames: &mut [Frame], root: &Path, masks: &MaskSource) -> Result<(), Error> {
    if let MaskSource::Folder(dir) = masks {
        let inside = root.join(dir);
        let dir = if inside.is_dir() { inside } else { dir.clone() };
        for frame in frames.iter_mut() {
            frame.mask = Some(dir.join(format!("{}.png", frame.id)));
        }
    }
    for (index, frame) in frames.iter_mut().enumerate() {
        if *masks == MaskSource::None || (*masks == MaskSource::First && index > 0) {
            frame.mask = None;
        }
    }
    match frames.first().and_then(|f| f.mask.as_ref()) {
        Some(path) if !path.is_file() => Err(Error::new(
            path,
            "is missing: the first frame needs a mask",
            "put the masks there (they are often a download of their own), name another folder of masks, or ask for none",
        )),
        _ => Ok(()),
    }
}
