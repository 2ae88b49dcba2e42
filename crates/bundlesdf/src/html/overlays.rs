//! Frames spread over the video with the pose drawn on them, as JPEG.

use base64::{Engine, engine::general_purpose::STANDARD};
use image::{RgbImage, codecs::jpeg::JpegEncoder, imageops};
use nalgebra::{Isometry3, Point3};
use rayon::prelude::*;
use rgbd_io::{FrameSource, Image, Intrinsics, RgbdFrame};

use crate::{
    RunReport,
    draw::{Layers, Overlay, View},
    output::OutputFolder,
};

/// Most frames on the page.
const FRAMES: usize = 12;
/// Width of the pictures (pixels).
const WIDTH: usize = 480;
/// How much wider than the object the part of the frame is that is shown.
const MARGIN: f64 = 1.7;
/// Least share of the frame's width that is shown: of fewer pixels only blur would be seen.
const LEAST_SHARE: f64 = 0.1;
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
    let source = match input.open_without_masks() {
        Ok(source) => source,
        Err(error) => {
            let problem = format!("The video can't be opened any more: {error}");
            return Overlays { problem: Some(problem), ..Overlays::default() };
        }
    };
    let chosen = spread(report.frames.len(), FRAMES);
    let drawn: Vec<Result<Picture, String>> = chosen
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
    let share = MARGIN * extent(overlay, &frame, &pose);
    let (color, intrinsics) = cut_out(frame, overlay, &pose, share);
    let mask = folder.read_mask(&entry.id).ok();
    let view =
        View { color: &color, intrinsics, cam_from_obj: pose, status: entry.status, mask: mask.as_ref() };
    let drawn = overlay.draw(&view, Layers::POSE);
    let (width, height) = drawn.size();
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, JPEG_QUALITY)
        .encode(drawn.pixels().as_flattened(), width as u32, height as u32, image::ExtendedColorType::Rgb8)
        .map_err(|e| format!("Frame {} can't be put into the page: {e}", entry.id))?;
    let uri = format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg));
    Ok(Picture { frame: index, width, height, uri })
}

/// Share of the frame's width or height, whichever is larger, that the object's box takes.
fn extent(overlay: &Overlay, frame: &RgbdFrame, pose: &Isometry3<f64>) -> f64 {
    let Some(bounds) = overlay.bounds() else { return 1.0 };
    let (width, height) = frame.color.size();
    let mut ends = Vec::with_capacity(24);
    for (edge, _) in bounds.edges(&Point3::origin()) {
        for p in edge {
            match frame.intrinsics.project((pose * p).coords.into()) {
                Some(at) => ends.push(at),
                None => return 1.0,
            }
        }
    }
    let span = |i: usize| {
        let values = || ends.iter().map(|p| p[i]);
        values().fold(f64::NEG_INFINITY, f64::max) - values().fold(f64::INFINITY, f64::min)
    };
    (span(0) / width as f64).max(span(1) / height as f64)
}

/// The part of the frame around the object, `share` as wide and high as the frame, at [`WIDTH`]. It is drawn on after
/// that, so that lines are sharp.
fn cut_out(
    frame: RgbdFrame,
    overlay: &Overlay,
    pose: &Isometry3<f64>,
    share: f64,
) -> (Image<[u8; 3]>, Intrinsics) {
    let (color, intrinsics) = (frame.color, frame.intrinsics);
    let (width, height) = color.size();
    let share = if share < 0.85 { share.max(LEAST_SHARE) } else { 1.0 };
    let part = |size: usize| ((size as f64 * share) as usize).clamp(1, size.max(1));
    let (columns, rows) = (part(width), part(height));
    let middle = overlay.bounds().map_or_else(Point3::origin, |b| b.centre());
    let middle = intrinsics.project((pose * middle).coords.into()).unwrap_or([intrinsics.cx, intrinsics.cy]);
    // Pixel centres are at integers: `at` lies half a pixel from the left border of its pixel.
    let start = |at: f64, part: usize, size: usize| {
        (at + 0.5 - part as f64 / 2.0).round().clamp(0.0, (size - part) as f64) as usize
    };
    let (x0, y0) = (start(middle[0], columns, width), start(middle[1], rows, height));
    let raw = color.pixels().as_flattened().to_vec();
    let Some(full) = RgbImage::from_raw(width as u32, height as u32, raw) else { return (color, intrinsics) };
    let cut = imageops::crop_imm(&full, x0 as u32, y0 as u32, columns as u32, rows as u32);
    let tall = (rows * WIDTH).div_ceil(columns).max(1);
    let sized = imageops::resize(&cut.to_image(), WIDTH as u32, tall as u32, imageops::FilterType::Triangle);
    match Image::from_vec(WIDTH, tall, sized.pixels().map(|p| p.0).collect()) {
        Some(sized) => {
            let scale = [WIDTH as f64 / columns as f64, tall as f64 / rows as f64];
            (sized, intrinsics.cropped(x0, y0).scaled(scale[0], scale[1]))
        }
        None => (color, intrinsics),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_object_is_in_the_middle_of_its_cut_out() {
        let sequence = rgbd_synth::Sequence::tiny();
        let overlay = Overlay::new(Some(sequence.mesh().clone()));
        let (frame, pose) = (sequence.render(0).frame, sequence.cam_from_obj(0));
        let centre = pose * overlay.bounds().unwrap().centre();
        let (color, camera) = cut_out(frame, &overlay, &pose, 0.5);
        let [u, v] = camera.project(centre.coords.into()).unwrap();
        let middle = [color.width() as f64 / 2.0, color.height() as f64 / 2.0];
        assert!((u - middle[0]).abs() < 8.0 && (v - middle[1]).abs() < 8.0, "{u} {v} {middle:?}");
    }

    #[test]
    fn a_small_object_is_magnified_and_a_large_one_not_cut() {
        let sequence = rgbd_synth::Sequence::tiny();
        let overlay = Overlay::new(Some(sequence.mesh().clone()));
        let pose = sequence.cam_from_obj(0);
        let given = sequence.intrinsics();
        let zoom = |share: f64| {
            let frame = sequence.render(0).frame;
            let width = frame.color.width() as f64;
            let (color, camera) = cut_out(frame, &overlay, &pose, share);
            (camera.fx / given.fx) / (color.width() as f64 / width)
        };
        assert!((zoom(0.02) - 1.0 / LEAST_SHARE).abs() < 0.5, "{}", zoom(0.02));
        assert_eq!((zoom(0.9), zoom(f64::NAN)), (1.0, 1.0));
    }

    #[test]
    fn frames_are_spread_from_the_first_to_the_last() {
        assert_eq!(spread(0, 12), Vec::<usize>::new());
        assert_eq!(spread(3, 12), [0, 1, 2]);
        let many = spread(1000, 12);
        assert_eq!((many.len(), many[0], many[11]), (12, 0, 999));
        assert!(many.windows(2).all(|w| (90..92).contains(&(w[1] - w[0]))), "{many:?}");
    }
}
