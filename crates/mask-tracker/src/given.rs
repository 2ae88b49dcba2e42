//! Masks that come with the frames.

use rgbd_io::{Image, Mask, RgbdFrame};

use crate::{Prior, Segmentation, VideoSegmenter};

/// The mask at another size: each pixel takes the one at its place. An empty mask stays empty.
pub fn resample(mask: &Mask, (width, height): (usize, usize)) -> Mask {
    let (w, h) = mask.size();
    if (w, h) == (width, height) {
        return mask.clone();
    }
    // Pixel centres at the same share of both images.
    let place =
        |i: usize, from: usize, to: usize| ((2 * i + 1) * from / (2 * to)).min(from.saturating_sub(1));
    Image::from_fn(width, height, |x, y| {
        mask.get(place(x, w, width), place(y, h, height)).copied().unwrap_or(0)
    })
}

/// Uses each frame's own mask ([`RgbdFrame::mask`]), for sequences that were segmented beforehand.
///
/// A mask of another size than the frame's colour is resampled; a frame without one gives an empty mask with
/// confidence 0.
#[derive(Clone, Copy, Debug, Default)]
pub struct GivenMasks;

impl VideoSegmenter for GivenMasks {
    fn start(&mut self, _frame: &RgbdFrame, _mask: &Mask) {}

    fn next(&mut self, frame: &RgbdFrame, _prior: &Prior<'_>) -> Segmentation {
        match &frame.mask {
            Some(mask) if !mask.is_empty() => Segmentation::new(resample(mask, frame.color.size()), 1.0),
            _ => Segmentation::new(Image::filled(frame.color.width(), frame.color.height(), 0), 0.0),
        }
    }

    fn refine(&mut self, _frame: &RgbdFrame, found: Segmentation, _prior: &Prior<'_>) -> Segmentation {
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn resampling_keeps_places() {
        let mask = Image::from_fn(4, 2, |x, y| u8::from(x == 1 && y == 0));
        let large = resample(&mask, (8, 4));
        let set: Vec<_> =
            (0..4).flat_map(|y| (0..8).map(move |x| (x, y))).filter(|p| large[*p] != 0).collect();
        assert_eq!(set, [(2, 0), (3, 0), (2, 1), (3, 1)]);
        assert_eq!(resample(&large, (4, 2)), mask);
        assert!(resample(&Mask::default(), (3, 3)).pixels().iter().all(|m| *m == 0));
    }
}
