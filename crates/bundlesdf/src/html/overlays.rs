//! Frames spread over the video with the pose drawn on them, as JPEG.

use base64::{Engine, engine::general_purpose::STANDARD};
use image::{RgbImage, codecs::jpeg::JpegEncoder, imageops};
use nalgebra::Isometry3;
use rayon::prelude::*;
use rgbd_io::{FrameSource, Image, Intrinsics};

use crate::{
    RunReport,
    draw::{Layers, Overlay, View},
    output::OutputFolder,
};

/// Most frames on the page.
const FRAMES: usize = 12;
/// Widest picture (pixels).
const WIDTH: usize = 480;
const JPEG_QUALITY: u8 = 82;

/// Pictures, and why there are fewer than there should be.
#[derive(Default)]
pub(super) struct Overlays {
    pub(super) pictures: Vec<Picture>,
    pub(super) problem: Option<String>,
}

/// A frame with its overlay.
pub(super) struct Picture {
    /// Number of the frame in the video.
    pub(super) frame: usize,
    pub(super) width: usize,
    pub(super) height: usize,
    /// A `data:` URI.
    pub(super) uri: String,
}

/// Draws frames at equal distances, the first and the last among them.
pub(super) fn draw_overlays(
    folder: &OutputFolder,
    report: &RunReport,
    poses: &[Option<Isometry3<f64>>],
    overlay: &Overlay,
) -> Overlays {
    let Some(input) = &report.input else {
        let problem = "The run doesn't say where its frames came from: they were fed by a program.";
        return Overlays { problem: Some(problem.into()), ..Overlays::default() };
    };
    let source = match input.open() {
        Ok(source) => source,
        Err(error) => {
            let problem = format!("The video can't be opened any more: {error}");
            return Overlays { problem: Some(problem), ..Overlays::default() };
        }
    };
    let drawn: Vec<Result<Picture, String>> = spread(report.frames.len(), FRAMES)
        .into_par_iter()
        .map(|frame| picture(frame, folder, report, poses, overlay, source.as_ref()))
        .collect();
    let problem = drawn.iter().find_map(|p| p.as_ref().err().cloned());
    Overlays { pictures: drawn.into_iter().flatten().collect(), problem }
}

/// Up to `most` of `count` numbers at equal distances.
fn spread(count: usize, most: usize) -> Vec<usize> {
    if count <= most {
        return (0..count).collect();
    }
    (0..most).map(|i| (i * (count - 1) + (most - 1) / 2) / (most - 1)).collect()
}

fn picture(
    index: usize,
    folder: &OutputFolder,
    report: &RunReport,
    poses: &[Option<Isometry3<f64>>],
    overlay: &Overlay,
    source: &dyn FrameSource,
) -> Result<Picture, String> {
    let entry = report.frames.get(index).ok_or("The run has fewer frames than it says.")?;
    let pose = poses.get(index).copied().flatten();
    let pose = pose.ok_or_else(|| format!("Frame {} has no pose file.", entry.id))?;
    let frame = source.frame(index).map_err(|e| format!("A frame can't be read any more: {e}"))?;
    let (color, intrinsics) = smaller(frame.color, frame.intrinsics);
    let mask = folder.read_mask(&entry.id).ok();
    let view = View { color: &color, intrinsics, cam_from_obj: pose, status: entry.status, mask: mask.as_ref() };
    let drawn = overlay.draw(&view, Layers::POSE);
    let (width, height) = drawn.size();
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, JPEG_QUALITY)
        .encode(drawn.pixels().as_flattened(), width as u32, height as u32, image::ExtendedColorType::Rgb8)
        .map_err(|e| format!("Frame {} can't be put into the page: {e}", entry.id))?;
    let uri = format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg));
    Ok(Picture { frame: index, width, height, uri })
}

/// The frame at [`WIDTH`], unless it is smaller; drawn on after that, so that lines stay sharp.
fn smaller(color: Image<[u8; 3]>, intrinsics: Intrinsics) -> (Image<[u8; 3]>, Intrinsics) {
    let (width, height) = color.size();
    if width <= WIDTH {
        return (color, intrinsics);
    }
    let rows = (height * WIDTH).div_ceil(width).max(1);
    let raw = color.pixels().as_flattened().to_vec();
    let Some(full) = RgbImage::from_raw(width as u32, height as u32, raw) else { return (color, intrinsics) };
    let small = imageops::resize(&full, WIDTH as u32, rows as u32, imageops::FilterType::Triangle);
    let pixels = small.pixels().map(|p| p.0).collect();
    match Image::from_vec(WIDTH, rows, pixels) {
        Some(small) => {
            (small, intrinsics.scaled(WIDTH as f64 / width as f64, rows as f64 / height as f64))
        }
        None => (color, intrinsics),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_spread_from_the_first_to_the_last() {
        assert_eq!(spread(0, 12), Vec::<usize>::new());
        assert_eq!(spread(3, 12), [0, 1, 2]);
        let many = spread(1000, 12);
        assert_eq!((many.len(), many[0], many[11]), (12, 0, 999));
        assert!(many.windows(2).all(|w| (90..92).contains(&(w[1] - w[0]))), "{many:?}");
    }
}
