//! How sharp an object's image is, whatever is printed on it.

use crate::{Image, Mask};

/// Pixels across which contrast is compared with that from one pixel to the next.
const SPAN: usize = 4;
/// Fewest pixels to measure on.
const PIXELS: usize = 200;
/// With less contrast (of 255) there is nothing to be blurred.
const CONTRAST: f64 = 6.0;

/// Below this [`sharpness`] an image is blurred: a sharp edge has 0.25, one smeared over 8 pixels 0.06.
pub const BLURRED: f64 = 0.055;

/// Contrast from one pixel to the next over contrast across four pixels (sums of squares) inside the mask, in the
/// direction in which it is smaller: blur along a motion takes the former and leaves the latter. `None` without
/// enough pixels or contrast, and when the sizes differ.
#[must_use]
pub fn sharpness(color: &Image<[u8; 3]>, mask: &Mask) -> Option<f64> {
    let (w, h) = mask.size();
    if color.size() != (w, h) {
        return None;
    }
    let gray = |x: usize, y: usize| {
        let [r, g, b] = color[(x, y)].map(f64::from);
        0.3 * r + 0.6 * g + 0.1 * b
    };
    let (mut near, mut far, mut count) = ([0.0; 2], [0.0; 2], 0usize);
    for y in 0..h.saturating_sub(SPAN) {
        let (row, below) = (mask.row(y), mask.row(y + SPAN));
        for x in 0..w.saturating_sub(SPAN) {
            if row[x] == 0 || row[x + SPAN] == 0 || below[x] == 0 {
                continue;
            }
            let here = gray(x, y);
            near[0] += (gray(x + 1, y) - here).powi(2);
            near[1] += (gray(x, y + 1) - here).powi(2);
            far[0] += (gray(x + SPAN, y) - here).powi(2);
            far[1] += (gray(x, y + SPAN) - here).powi(2);
            count += 1;
        }
    }
    let contrast = |k: usize| (far[k] / count.max(1) as f64).sqrt();
    if count < PIXELS || contrast(0).min(contrast(1)) < CONTRAST {
        return None;
    }
    Some((near[0] / far[0]).min(near[1] / far[1]))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A checkerboard of 16 pixels, smeared over `blur` pixels along x.
    fn board(blur: usize) -> Image<[u8; 3]> {
        let sharp = |x: usize, y: usize| if (x / 16 + y / 16).is_multiple_of(2) { 40.0 } else { 200.0 };
        Image::from_fn(128, 96, |x, y| {
            let sum: f64 = (0..blur).map(|i| sharp(x + i, y)).sum();
            [(sum / blur as f64) as u8; 3]
        })
    }

    #[test]
    fn blur_is_told_from_sharpness_and_from_plainness() {
        let mask = Image::filled(128, 96, 255);
        let of = |blur| sharpness(&board(blur), &mask).unwrap();
        assert!(of(1) > 0.2 && of(4) < of(1) && of(12) < BLURRED, "{} {} {}", of(1), of(4), of(12));
        assert_eq!(sharpness(&Image::filled(128, 96, [90; 3]), &mask), None);
        assert_eq!(sharpness(&board(1), &Image::filled(128, 96, 0)), None);
        assert_eq!(sharpness(&board(1), &Image::filled(12, 9, 255)), None);
    }
}
