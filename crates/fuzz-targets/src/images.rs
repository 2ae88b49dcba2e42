//! Colour, depth and masks: PNG and JPEG files. The first byte chooses the reader.

use crate::bytes::Bytes;
use crate::files;
use rgbd_io::{read_color, read_depth_u16, read_mask};
use std::path::PathBuf;
use tempfile::TempDir;

thread_local! {
    static PLACE: Option<(TempDir, PathBuf)> = files::folder().map(|dir| {
        let path = dir.path().join("image");
        (dir, path)
    });
}

pub(crate) fn run(data: &[u8]) {
    let mut bytes = Bytes(data);
    let reader = bytes.below(3);
    PLACE.with(|place| {
        let Some((_, path)) = place else { return };
        if std::fs::write(path, bytes.rest()).is_err() {
            return;
        }
        match reader {
            0 => {
                let Ok(color) = read_color(path) else { return };
                assert!(!color.is_empty());
            }
            1 => {
                let Ok(depth) = read_depth_u16(path) else { return };
                assert!(!depth.is_empty() && depth.pixels().iter().all(|raw| *raw != u16::MAX));
            }
            _ => {
                let Ok(mask) = read_mask(path) else { return };
                assert!(!mask.is_empty() && mask.pixels().iter().all(|v| [0, 255].contains(v)));
            }
        }
    });
}
