//! Enlarging the crop of a small object.

use rgbd_io::Image;

/// Objects with a smaller larger side are enlarged (pixels).
const WANTED_SIDE: usize = 100;
const MAX_ZOOM: usize = 3;

/// How many times the crop around `[x0, y0, x1, y1]` (inclusive) is enlarged.
pub(crate) fn zoom_for([x0, y0, x1, y1]: [usize; 4]) -> usize {
    let side = (x1 - x0).max(y1 - y0) + 1;
    WANTED_SIDE.div_ceil(side).clamp(1, MAX_ZOOM)
}

/// Every pixel `zoom` times in both directions: for depth and masks, whose values must not mix.
pub(crate) fn zoom_nearest<T: Clone>(image: Image<T>, zoom: usize) -> Image<T> {
    if zoom == 1 {
        return image;
    }
    let (width, height) = image.size();
    Image::from_fn(width * zoom, height * zoom, |x, y| image[(x / zoom, y / zoom)].clone())
}

/// Bilinear between pixel centres, which are at integers.
pub(crate) fn zoom_bilinear(image: Image<[u8; 3]>, zoom: usize) -> Image<[u8; 3]> {
    if zoom == 1 || image.is_empty() {
        return image;
    }
    let (width, height) = image.size();
    // Lower neighbour, upper neighbour and the upper one's share.
    let around = |x: usize, size: usize| {
        let at = ((x as f32 + 0.5) / zoom as f32 - 0.5).max(0.0);
        let low = (at as usize).min(size - 1);
        (low, (low + 1).min(size - 1), at - low as f32)
    };
    Image::from_fn(width * zoom, height * zoom, |x, y| {
        let ((x0, x1, fx), (y0, y1, fy)) = (around(x, width), around(y, height));
        let corners = [image[(x0, y0)], image[(x1, y0)], image[(x0, y1)], image[(x1, y1)]];
        std::array::from_fn(|c| {
            let [a, b, d, e] = corners.map(|p| f32::from(p[c]));
            let (top, bottom) = (a + (b - a) * fx, d + (e - d) * fx);
            (top + (bottom - top) * fy).round() as u8
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ramp_stays_a_ramp_and_labels_stay_labels() {
        let ramp = Image::from_fn(8, 2, |x, _| [20 * x as u8; 3]);
        let large = zoom_bilinear(ramp, 2);
        assert_eq!(large.size(), (16, 4));
        for x in 1..15 {
            let expected = 20.0 * ((x as f32 + 0.5) / 2.0 - 0.5);
            assert!((f32::from(large[(x, 1)][0]) - expected).abs() <= 0.5);
        }
        let labels = zoom_nearest(Image::from_fn(2, 1, |x, _| x as u8), 3);
        assert_eq!(labels.row(2), [0, 0, 0, 1, 1, 1]);
    }

    #[test]
    fn only_small_objects_are_enlarged() {
        assert_eq!(zoom_for([10, 10, 110, 20]), 1);
        assert_eq!(zoom_for([10, 10, 69, 20]), 2);
        assert_eq!(zoom_for([10, 10, 20, 20]), 3);
    }
}
