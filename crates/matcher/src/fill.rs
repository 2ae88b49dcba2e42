//! Smooth continuation of the object over its background, so that the silhouette is no feature.
//!
//! Push-pull (Gortler et al., *The Lumigraph*, 1996): average the known pixels into coarser and coarser images, then
//! fill what is unknown from the next coarser one.

use rgbd_io::{Image, Mask};

/// `gray` with the pixels outside `mask` replaced by a smooth continuation of those inside. Unchanged for an empty
/// mask or if the sizes differ.
pub(crate) fn fill_background(gray: &Image<f32>, mask: &Mask) -> Image<f32> {
    if mask.size() != gray.size() || mask.pixels().iter().all(|&m| m == 0) {
        return gray.clone();
    }
    let known = mask.map(|&m| if m != 0 { 1.0_f32 } else { 0.0 });
    pull(gray.clone(), &known)
}

fn pull(mut values: Image<f32>, known: &Image<f32>) -> Image<f32> {
    if known.pixels().iter().all(|&k| k > 0.0) {
        return values;
    }
    let (half, half_known) = push(&values, known);
    let coarse = pull(half, &half_known);
    let width = values.width();
    for (y, line) in values.pixels_mut().chunks_exact_mut(width).enumerate() {
        for (x, (value, &k)) in line.iter_mut().zip(known.row(y)).enumerate() {
            if k == 0.0 {
                // Pixel x lies at (x - 0.5) / 2 of the coarser image: bilinear with weights 3/4 and 1/4.
                *value = crate::gray::sample_clamped(&coarse, 0.5 * x as f32 - 0.25, 0.5 * y as f32 - 0.25);
            }
        }
    }
    values
}

/// Means of the known pixels of each 2x2 block, and whether there are any.
fn push(values: &Image<f32>, known: &Image<f32>) -> (Image<f32>, Image<f32>) {
    let (width, height) = values.size();
    let (half_w, half_h) = (width.div_ceil(2), height.div_ceil(2));
    let mut half = Image::filled(half_w, half_h, 0.0);
    let mut half_known = Image::filled(half_w, half_h, 0.0);
    for y in 0..half_h {
        let span = y * half_w..(y + 1) * half_w;
        let sums = &mut half.pixels_mut()[span.clone()];
        let counts = &mut half_known.pixels_mut()[span];
        for row in 2 * y..(2 * y + 2).min(height) {
            for (x, (v, k)) in values.row(row).iter().zip(known.row(row)).enumerate() {
                sums[x / 2] += v * k;
                counts[x / 2] += k;
            }
        }
        for (s, k) in sums.iter_mut().zip(counts) {
            if *k > 0.0 {
                *s /= *k;
                *k = 1.0;
            }
        }
    }
    (half, half_known)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inside_is_kept_and_the_continuation_has_no_edge() {
        let mask = Mask::from_fn(60, 50, |x, y| u8::from((x as f32 - 30.0).hypot(y as f32 - 25.0) < 14.0));
        let gray = Image::from_fn(60, 50, |x, y| if mask[(x, y)] != 0 { 100.0 + x as f32 } else { 0.0 });
        let filled = fill_background(&gray, &mask);
        for y in 0..50 {
            for x in 0..60 {
                if mask[(x, y)] != 0 {
                    assert_eq!(filled[(x, y)], gray[(x, y)]);
                }
                assert!((110.0..150.0).contains(&filled[(x, y)]));
            }
        }
        assert_eq!(fill_background(&gray, &Mask::filled(60, 50, 0)), gray);
    }
}
