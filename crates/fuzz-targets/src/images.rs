//! Colour, depth and masks: PNG and JPEG files. The first byte chooses the reader.
//!
//! A PNG has a checksum on every part, which no mutation gets right: the target corrects them, so that the decoder sees
//! the damage and not the checksum. The highest bit of the first byte leaves them alone.

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
    let choice = bytes.byte();
    let reader = choice % 3;
    let mut file = bytes.rest().to_vec();
    if choice & 0x80 == 0 {
        correct_checksums(&mut file);
    }
    PLACE.with(|place| {
        let Some((_, path)) = place else { return };
        if std::fs::write(path, &file).is_err() {
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

/// Writes the right checksum after every part of a PNG (length, kind, content, checksum), as far as there are whole parts.
fn correct_checksums(png: &mut [u8]) {
    const SIGNATURE: usize = 8;
    let mut at = SIGNATURE;
    while let Some(length) = png.get(at..at + 4).and_then(|b| b.try_into().ok()).map(u32::from_be_bytes) {
        let end = at + 8 + length as usize;
        let Some(sum) = png.get(at + 4..end).map(crc32fast::hash) else { return };
        let Some(slot) = png.get_mut(end..end + 4) else { return };
        slot.copy_from_slice(&sum.to_be_bytes());
        at = end + 4;
    }
}
