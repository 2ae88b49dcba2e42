//! How sharp an object's image is, whatever is printed on it.

use crate::{Image, Mask};

/// Pixels across which contrast is compared with that from one pixel to the next.
const SPAN: usize = 8;
/// Fewest places with contrast to measure at.
const PLACES: usize = 100;
/// Differences across the span below this (of 255) are shading, which has no edge to be sharp.
const CONTRAST: f64 = 24.0;

/// Below this [`sharpness`] an image is blurred: a sharp edge has 0.125 and fine print more, an edge smeared over 9
/// pixels 0.02.
pub const BLURRED: f64 = 0.028;

/// Contrast from one pixel to the next over contrast across eight pixels (sums of squares, where the latter is
/// strong) inside the mask, in the direction in which it is smaller: blur along a motion takes the former and leaves
/// the latter. `None` with too few edges in either direction, and when the sizes differ.
#[must_use]
pub fn sharpness(color: &Image<[u8; 3]>, mask: &Mask) -> Option<f64> {
    let gray = color.map(|c| {
        let [r, g, b] = c.map(f32::from);
        0.3 * r + 0.6 * g + 0.1 * b
    });
    gray_sharpness(&gray, mask, 1)
}

/// [`sharpness`] of a gray image (0 to 255) of which `zoom` pixels are one of the sensor's.
#[must_use]
pub fn gray_sharpness(gray: &Image<f32>, mask: &Mask, zoom: usize) -> Option<f64> {
    let ((w, h), span) = (mask.size(), SPAN * zoom);
    if gray.size() != (w, h) || zoom == 0 || w <= span || h <= span {
        return None;
    }
    let along = |dx: usize, dy: usize| {
        let (mut near, mut far, mut count) = (0.0, 0.0, 0usize);
        for y in (0..h - span * dy).step_by(zoom) {
            for x in (0..w - span * dx).step_by(zoom) {
                let there = (x + span * dx, y + span * dy);
                if mask[(x, y)] == 0 || mask[there] == 0 {
                    continue;
                }
                let here = gray[(x, y)];
                let across = f64::from(gray[there] - here);
                if across.abs() > CONTRAST {
                    near += f64::from(gray[(x + zoom * dx, y + zoom * dy)] - here).powi(2);
                    far += across * across;
                    count += 1;
                }
            }
        }
        (count >= PLACES).then(|| near / far)
    };
    Some(along(1, 0)?.min(along(0, 1)?))
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
        assert!(of(1) > 0.12 && of(4) < 0.5 * of(1) && of(12) < BLURRED, "{} {} {}", of(1), of(4), of(12));
        assert_eq!(sharpness(&Image::filled(128, 96, [90; 3]), &mask), None);
        assert_eq!(sharpness(&board(1), &Image::filled(128, 96, 0)), None);
        assert_eq!(sharpness(&board(1), &Image::filled(12, 9, 255)), None);
    }

    #[test]
    fn an_enlarged_image_is_as_sharp() {
        let gray = board(3).map(|c| f32::from(c[0]));
        let large = Image::from_fn(256, 192, |x, y| gray[(x / 2, y / 2)]);
        let small = gray_sharpness(&gray, &Image::filled(128, 96, 255), 1);
        assert!(small.is_some());
        assert_eq!(gray_sharpness(&large, &Image::filled(256, 192, 255), 2), small);
    }
}
