//! A small valid folder to start from.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used)]

use std::path::Path;

use rgbd_io::{CustomWriter, Image, Intrinsics, Mask};

pub const SIZE: (usize, usize) = (40, 30);

pub fn camera() -> Intrinsics {
    Intrinsics { fx: 40.0, fy: 42.0, cx: 19.5, cy: 14.25 }
}

pub fn color(seed: usize) -> Image<[u8; 3]> {
    Image::from_fn(SIZE.0, SIZE.1, |x, y| [(x * 6 + seed) as u8, (y * 8) as u8, (x * y + 17 * seed) as u8])
}

/// The object at 0.5 m and more, a wall at 1.2 m, a column without depth.
pub fn depth() -> Image<f32> {
    let mask = mask();
    Image::from_fn(SIZE.0, SIZE.1, |x, y| match (x, mask[(x, y)]) {
        (39, _) => 0.0,
        (_, 0) => 1.2,
        _ => 0.5 + 0.001 * (x + y) as f32,
    })
}

/// 24 x 18 pixels in the middle.
pub fn mask() -> Mask {
    Image::from_fn(SIZE.0, SIZE.1, |x, y| if (8..32).contains(&x) && (6..24).contains(&y) { 255 } else { 0 })
}

pub fn write(dir: &Path, frames: usize, masks: usize) {
    let writer = CustomWriter::create(dir, &camera()).unwrap();
    for i in 0..frames {
        let mask = mask();
        writer.write_frame(&format!("{i:04}"), &color(i), &depth(), (i < masks).then_some(&mask)).unwrap();
    }
}

/// A PNG file of 8-bit grey, 0 or 255 everywhere.
pub fn png_grey8(width: usize, height: usize, value: u8) -> Vec<u8> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.png");
    rgbd_io::write_png_mask(&path, &Mask::filled(width, height, value)).unwrap();
    std::fs::read(path).unwrap()
}

/// A PNG file with the size in its header replaced, and the header's checksum made right.
pub fn with_header_size(mut png: Vec<u8>, width: u32, height: u32) -> Vec<u8> {
    png[16..20].copy_from_slice(&width.to_be_bytes());
    png[20..24].copy_from_slice(&height.to_be_bytes());
    let crc = crc32(&png[12..29]);
    png[29..33].copy_from_slice(&crc.to_be_bytes());
    png
}

fn crc32(bytes: &[u8]) -> u32 {
    let mut crc = u32::MAX;
    for byte in bytes {
        crc ^= u32::from(*byte);
        for _ in 0..8 {
            crc = (crc >> 1) ^ (0xedb8_8320 & (crc & 1).wrapping_neg());
        }
    }
    !crc
}
