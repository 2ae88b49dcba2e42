//! Image files: colour, depth and masks in, PNG out.

#![warn(clippy::indexing_slicing)]

use std::io::Cursor;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use ::image::codecs::jpeg::JpegEncoder;
use ::image::codecs::png::{CompressionType, FilterType, PngEncoder};
use ::image::{
    DynamicImage, ExtendedColorType, ImageDecoder, ImageEncoder, ImageError, ImageFormat, ImageReader,
};

use crate::poses::write_atomic;
use crate::{Error, Image, Mask};

/// No RGB-D camera comes near; a header that claims more is damaged or hostile.
const MAX_PIXELS: u64 = 64_000_000;
const MAX_FILE_BYTES: u64 = 512 << 20;

/// Most that a byte of a file can hold, decoded. Deflate repeats at most 1032 bytes per byte, of which each may hold
/// eight pixels of one bit; JPEG stays below. A header that claims more lies, and no memory is taken for it.
const MAX_EXPANSION: u64 = 8 * 1032;

const EXPORT_AGAIN: &str = "export this image again";
const DEPTH_REMEDY: &str = "save depth as a single-channel 16-bit PNG in millimetres, 0 where missing";

/// Reads an RGB image from a PNG or JPEG file; an alpha channel is dropped, grey becomes RGB.
///
/// # Errors
/// When the file is missing, damaged, truncated, not an image, or larger than 64 megapixels or 512 MiB.
pub fn read_color(path: &Path) -> Result<Image<[u8; 3]>, Error> {
    let (_, decoded) = decode(path)?;
    let rgb = decoded.into_rgb8();
    let (width, height) = (rgb.width() as usize, rgb.height() as usize);
    let pixels = rgb.into_raw().as_chunks::<3>().0.to_vec();
    sized(path, width, height, pixels)
}

/// Reads a raw depth image from a single-channel 16-bit PNG, in the file's units; `0` and the saturated `65535`
/// both mean missing and come back as `0`.
///
/// # Errors
/// As [`read_color`], and for images of eight bits or of colour.
pub fn read_depth_u16(path: &Path) -> Result<Image<u16>, Error> {
    let (_, decoded) = decode(path)?;
    let wrong = |kind: &str| Err(Error::new(path, format!("is {kind} and not 16-bit depth"), DEPTH_REMEDY));
    match decoded {
        DynamicImage::ImageLuma16(grey) => {
            let (width, height) = (grey.width() as usize, grey.height() as usize);
            let mut pixels = grey.into_raw();
            for p in &mut pixels {
                *p = if *p == u16::MAX { 0 } else { *p };
            }
            sized(path, width, height, pixels)
        }
        DynamicImage::ImageLuma8(_) | DynamicImage::ImageLumaA8(_) => wrong("an 8-bit image"),
        DynamicImage::ImageLumaA16(_) => wrong("an image with an alpha channel"),
        DynamicImage::ImageRgb32F(_) | DynamicImage::ImageRgba32F(_) => wrong("a float image"),
        _ => wrong("a colour image"),
    }
}

/// Reads a mask from a PNG file: object wherever a colour channel isn't zero, except where fully transparent.
/// Pixels come back as 0 and 255.
///
/// # Errors
/// As [`read_color`], and for JPEG files, whose compression leaves non-zero specks all over the background.
pub fn read_mask(path: &Path) -> Result<Mask, Error> {
    let (format, decoded) = decode(path)?;
    if format == ImageFormat::Jpeg {
        return Err(Error::new(path, "is a JPEG and too lossy for a mask", "save the mask as PNG"));
    }
    nonzero(path, decoded)
}

/// Reads a mask like [`read_mask`], but accepts JPEG too: object where it is brighter than half.
#[cfg(feature = "datasets")]
pub(crate) fn read_mask_thresholded(path: &Path) -> Result<Mask, Error> {
    let (format, decoded) = decode(path)?;
    if format != ImageFormat::Jpeg {
        return nonzero(path, decoded);
    }
    let grey = decoded.into_luma8();
    let (width, height) = (grey.width() as usize, grey.height() as usize);
    let pixels = grey.into_raw().into_iter().map(|v| if v > 127 { 255 } else { 0 }).collect();
    sized(path, width, height, pixels)
}

/// Reads an 8-bit RGB image that has to be exact, and therefore a PNG.
#[cfg(feature = "datasets")]
pub(crate) fn read_png_rgb(path: &Path) -> Result<Image<[u8; 3]>, Error> {
    match decode(path)? {
        (ImageFormat::Png, DynamicImage::ImageRgb8(rgb)) => {
            let (width, height) = (rgb.width() as usize, rgb.height() as usize);
            sized(path, width, height, rgb.into_raw().as_chunks::<3>().0.to_vec())
        }
        _ => Err(Error::new(path, "isn't an 8-bit RGB PNG", "download or copy this image again")),
    }
}

fn nonzero(path: &Path, decoded: DynamicImage) -> Result<Mask, Error> {
    let (width, height) = (decoded.width() as usize, decoded.height() as usize);
    let object = |on: bool| if on { 255 } else { 0 };
    let pixels = match decoded {
        DynamicImage::ImageLuma8(grey) => grey.into_raw().into_iter().map(|v| object(v != 0)).collect(),
        // In 16 bits per channel, so that small 16-bit labels don't round to zero.
        other => {
            let rgba = other.into_rgba16().into_raw();
            let object_at = |[r, g, b, a]: &[u16; 4]| object(*a != 0 && (*r | *g | *b) != 0);
            rgba.as_chunks::<4>().0.iter().map(object_at).collect()
        }
    };
    sized(path, width, height, pixels)
}

/// The image at another size, each pixel from the nearest one.
pub(crate) fn resize_nearest(mask: &Mask, (width, height): (usize, usize)) -> Mask {
    let (w, h) = mask.size();
    // Centre to centre: the pixel under (x + 0.5) / width.
    Mask::from_fn(width, height, |x, y| {
        mask.get((2 * x + 1) * w / (2 * width), (2 * y + 1) * h / (2 * height)).copied().unwrap_or(0)
    })
}

fn sized<T>(path: &Path, width: usize, height: usize, pixels: Vec<T>) -> Result<Image<T>, Error> {
    Image::from_vec(width, height, pixels)
        .ok_or_else(|| Error::new(path, "holds too few pixels", EXPORT_AGAIN))
}

/// Reads and decodes a file, with every size checked before memory is taken for it.
fn decode(path: &Path) -> Result<(ImageFormat, DynamicImage), Error> {
    let bytes = read_bytes(path)?;
    survive(path, || decode_bytes(path, &bytes))
}

/// A damaged image may overflow what decodes it: with checked arithmetic that is a panic, here an error.
fn survive<T>(path: &Path, decode: impl FnOnce() -> Result<T, Error>) -> Result<T, Error> {
    catch_unwind(AssertUnwindSafe(decode)).unwrap_or_else(|_| {
        let problem = "can't be decoded (the decoder failed)";
        Err(Error::new(path, problem, "the image is damaged: export or copy it again"))
    })
}

fn decode_bytes(path: &Path, bytes: &[u8]) -> Result<(ImageFormat, DynamicImage), Error> {
    let failed = |e: ImageError| decode_error(path, &e);
    let mut reader = ImageReader::new(Cursor::new(bytes))
        .with_guessed_format()
        .map_err(|e| Error::io(path, "reading", &e))?;
    let format = match reader.format() {
        Some(format @ (ImageFormat::Png | ImageFormat::Jpeg)) => format,
        _ => {
            return Err(Error::new(
                path,
                "isn't a PNG or JPEG image",
                "convert it to PNG, or export it again",
            ));
        }
    };
    if format == ImageFormat::Jpeg && !jpeg_is_complete(bytes) {
        return Err(truncated(path));
    }
    let mut limits = ::image::Limits::default();
    // Sixteen bits in four channels of the most pixels allowed, and some for the decoder itself.
    limits.max_alloc = Some(MAX_PIXELS * 8 + (64 << 20));
    reader.limits(limits);
    let decoder = reader.into_decoder().map_err(failed)?;
    let (width, height) = decoder.dimensions();
    if u64::from(width) * u64::from(height) > MAX_PIXELS {
        let problem = format!("claims {width}x{height} pixels, more than {} million", MAX_PIXELS / 1_000_000);
        return Err(Error::new(
            path,
            problem,
            "resize the images, or export this one again if it is damaged",
        ));
    }
    if width == 0 || height == 0 {
        return Err(Error::new(path, "has no pixels", EXPORT_AGAIN));
    }
    if decoder.total_bytes() > MAX_EXPANSION * bytes.len() as u64 {
        let problem = format!("claims {width}x{height} pixels, which {} bytes can't hold", bytes.len());
        return Err(Error::new(path, problem, "the image is damaged: export or copy it again"));
    }
    Ok((format, DynamicImage::from_decoder(decoder).map_err(failed)?))
}

fn read_bytes(path: &Path) -> Result<Vec<u8>, Error> {
    let failed = |e: std::io::Error| Error::io(path, "reading", &e);
    let meta = std::fs::metadata(path).map_err(failed)?;
    if !meta.is_file() {
        return Err(Error::new(path, "isn't a file", "put an image file there"));
    }
    if meta.len() > MAX_FILE_BYTES {
        let problem = format!("has {} MiB, more than {}", meta.len() >> 20, MAX_FILE_BYTES >> 20);
        return Err(Error::new(
            path,
            problem,
            "resize the images, or export this one again if it is damaged",
        ));
    }
    if meta.len() == 0 {
        return Err(Error::new(path, "is empty (0 bytes)", EXPORT_AGAIN));
    }
    std::fs::read(path).map_err(failed)
}

fn truncated(path: &Path) -> Error {
    Error::new(path, "is truncated", "export or copy this image again, or leave the frame out")
}

fn decode_error(path: &Path, error: &ImageError) -> Error {
    let mut text = error.to_string();
    let mut source = std::error::Error::source(error);
    while let Some(inner) = source {
        text = format!("{text}: {inner}");
        source = inner.source();
    }
    let lower = text.to_lowercase();
    if ["unexpected end", "eof", "end of file", "truncated"].iter().any(|s| lower.contains(s)) {
        return truncated(path);
    }
    Error::new(path, format!("can't be decoded ({text})"), "the image is damaged: export or copy it again")
}

/// Whether a JPEG has its end marker. The decoder fills what is missing with grey, which would pass for colour.
fn jpeg_is_complete(bytes: &[u8]) -> bool {
    // Segments up to the first scan (a thumbnail with markers of its own lies inside one of them), then any end
    // marker: within a scan's data 0xFF is always followed by 0x00 or a restart marker.
    let mut at = 2;
    while let Some(&[a, marker, high, low]) = bytes.get(at..at + 4) {
        if a != 0xff {
            break;
        }
        if marker == 0xff {
            at += 1;
            continue;
        }
        at += 2 + usize::from(high) * 256 + usize::from(low);
        if marker == 0xda {
            return bytes.get(at..).is_some_and(|scan| scan.windows(2).any(|w| w == [0xff, 0xd9]));
        }
    }
    // Not the structure we know: the decoder says what is wrong.
    true
}

/// Writes an RGB image as PNG (fast compression), whole or not at all; for overlays too.
///
/// # Errors
/// When the file can't be written, or the image is empty.
pub fn write_png_rgb(path: &Path, image: &Image<[u8; 3]>) -> Result<(), Error> {
    write_png(path, image.size(), image.pixels().as_flattened(), ExtendedColorType::Rgb8)
}

/// Writes a mask as PNG, object pixels as 255.
///
/// # Errors
/// As [`write_png_rgb`].
pub fn write_png_mask(path: &Path, mask: &Mask) -> Result<(), Error> {
    let bytes: Vec<u8> = mask.pixels().iter().map(|v| if *v == 0 { 0 } else { 255 }).collect();
    write_png(path, mask.size(), &bytes, ExtendedColorType::L8)
}

/// Writes depth (metres) as 16-bit PNG in millimetres, rounded. What isn't finite, isn't positive or is past
/// 65.534 m is written as missing (`0`).
///
/// # Errors
/// As [`write_png_rgb`].
pub fn write_png_depth(path: &Path, depth: &Image<f32>) -> Result<(), Error> {
    let mut bytes = Vec::with_capacity(depth.pixels().len() * 2);
    for z in depth.pixels() {
        let mm = (f64::from(*z) * 1000.0).round();
        // NaN and infinity fall outside the range too.
        let mm = if (1.0..65535.0).contains(&mm) { mm as u16 } else { 0 };
        bytes.extend_from_slice(&mm.to_ne_bytes());
    }
    write_png(path, depth.size(), &bytes, ExtendedColorType::L16)
}

/// Writes a 16-bit image as PNG, for depth in other units than millimetres.
///
/// # Errors
/// As [`write_png_rgb`].
pub fn write_png_u16(path: &Path, image: &Image<u16>) -> Result<(), Error> {
    let bytes: Vec<u8> = image.pixels().iter().flat_map(|v| v.to_ne_bytes()).collect();
    write_png(path, image.size(), &bytes, ExtendedColorType::L16)
}

/// Writes an RGB image as JPEG of `quality` 1 to 100, whole or not at all.
///
/// # Errors
/// As [`write_png_rgb`].
pub fn write_jpeg_rgb(path: &Path, image: &Image<[u8; 3]>, quality: u8) -> Result<(), Error> {
    let failed = |problem: String| Error::new(path, problem, "write an image of 1 to 65535 pixels a side");
    let (Ok(width), Ok(height)) = (u16::try_from(image.width()), u16::try_from(image.height())) else {
        return Err(failed("would be too large for a JPEG".into()));
    };
    if width == 0 || height == 0 {
        return Err(failed("would have no pixels".into()));
    }
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, quality.clamp(1, 100))
        .write_image(image.pixels().as_flattened(), width.into(), height.into(), ExtendedColorType::Rgb8)
        .map_err(|e| failed(format!("can't be encoded ({e})")))?;
    write_atomic(path, &jpeg)
}

fn write_png(path: &Path, size: (usize, usize), bytes: &[u8], kind: ExtendedColorType) -> Result<(), Error> {
    let failed = |problem: String| Error::new(path, problem, "write an image of at least one pixel");
    let (Ok(width), Ok(height)) = (u32::try_from(size.0), u32::try_from(size.1)) else {
        return Err(failed("would be too large for a PNG".into()));
    };
    if width == 0 || height == 0 {
        return Err(failed("would have no pixels".into()));
    }
    let mut png = Vec::with_capacity(bytes.len() / 2 + 1024);
    PngEncoder::new_with_quality(&mut png, CompressionType::Fast, FilterType::Up)
        .write_image(bytes, width, height, kind)
        .map_err(|e| failed(format!("can't be encoded ({e})")))?;
    write_atomic(path, &png)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_decoder_that_panics_is_an_error_that_names_the_file() {
        let overflow = |a: u8| -> Result<u8, Error> { Ok(a.checked_mul(2).expect("overflow")) };
        assert_eq!(survive(Path::new("a.jpg"), || overflow(3)).ok(), Some(6));
        let error = survive(Path::new("a.jpg"), || overflow(200)).err().map(|e| e.to_string());
        assert!(error.is_some_and(|e| e.contains("a.jpg") && e.contains("decoder failed")));
    }
}
