//! Pictures of masks for looking at.

use rgbd_io::{Image, Mask, RgbdFrame};

/// The image around the object, three times as large: the mask's outline red, the truth's green, both yellow.
pub(super) fn outlines(frame: &RgbdFrame, mask: &Mask, truth: &Mask) -> Image<[u8; 3]> {
    let (w, h) = frame.color.size();
    let (mut x0, mut y0, mut x1, mut y1) = (w, h, 0, 0);
    for y in 0..h {
        for x in 0..w {
            if mask[(x, y)] != 0 || truth[(x, y)] != 0 {
                (x0, y0, x1, y1) = (x0.min(x), y0.min(y), x1.max(x), y1.max(y));
            }
        }
    }
    let (x0, y0) = (x0.saturating_sub(20).min(w - 1), y0.saturating_sub(20).min(h - 1));
    let (x1, y1) = ((x1 + 20).clamp(x0, w - 1), (y1 + 20).clamp(y0, h - 1));
    Image::from_fn((x1 - x0 + 1) * 3, (y1 - y0 + 1) * 3, |x, y| {
        let (x, y) = (x0 + x / 3, y0 + y / 3);
        match (on_outline(mask, x, y), on_outline(truth, x, y)) {
            (true, true) => [255, 255, 0],
            (true, false) => [255, 0, 0],
            (false, true) => [0, 255, 0],
            _ => frame.color[(x, y)],
        }
    })
}

fn on_outline(mask: &Mask, x: usize, y: usize) -> bool {
    let (w, h) = mask.size();
    mask[(x, y)] != 0
        && (x == 0
            || y == 0
            || x + 1 == w
            || y + 1 == h
            || [(x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)].iter().any(|&p| mask[p] == 0))
}
