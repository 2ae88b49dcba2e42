//! Masks that come with the frames.

use rgbd_io::{Image, Mask, RgbdFrame};

use crate::{Prior, Segmentation, VideoSegmenter};

/// Uses each frame's own mask ([`RgbdFrame::mask`]), for sequences that were segmented beforehand.
///
/// A frame without a mask gives an empty one with confidence 0, a mask of another size than the frame's colour
/// counts as none.
#[derive(Clone, Copy, Debug, Default)]
pub struct GivenMasks;

impl VideoSegmenter for GivenMasks {
    fn start(&mut self, _frame: &RgbdFrame, _mask: &Mask) {}

    fn next(&mut self, frame: &RgbdFrame, _prior: &Prior<'_>) -> Segmentation {
        match &frame.mask {
            Some(mask) if mask.size() == frame.color.size() => Segmentation::new(mask.clone(), 1.0),
            _ => Segmentation::new(Image::filled(frame.color.width(), frame.color.height(), 0), 0.0),
        }
    }

    fn refine(&mut self, _frame: &RgbdFrame, found: Segmentation, _prior: &Prior<'_>) -> Segmentation {
        found
    }
}
