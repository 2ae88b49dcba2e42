//! Separable Gaussian filter, edges replicated.

use rgbd_io::Image;

const LANES: usize = 16;

/// A Gaussian of one width, with the buffers that filtering needs.
pub(crate) struct Gaussian {
    /// Weights at offsets 0, 1, 2 ...; the other side is the mirror image.
    taps: Vec<f32>,
}

impl Gaussian {
    /// Cut off at three standard deviations; `sigma` in pixels.
    pub(crate) fn new(sigma: f32) -> Self {
        let radius = (3.0 * sigma).ceil().clamp(0.0, 64.0) as usize;
        let mut taps: Vec<f32> = (0..=radius).map(|i| (-0.5 * (i as f32 / sigma).powi(2)).exp()).collect();
        if radius == 0 {
            taps[0] = 1.0;
        }
        let sum = 2.0 * taps.iter().sum::<f32>() - taps[0];
        taps.iter_mut().for_each(|t| *t /= sum);
        Self { taps }
    }

    /// `image` filtered along both axes.
    pub(crate) fn filter(&self, image: &Image<f32>, scratch: &mut Vec<f32>) -> Image<f32> {
        let (width, height) = image.size();
        let mut out = Image::filled(width, height, 0.0);
        if width == 0 || height == 0 {
            return out;
        }
        let radius = self.taps.len() - 1;
        let padded = width + 2 * radius;
        scratch.clear();
        scratch.resize(padded, 0.0);
        for y in 0..height {
            self.vertical(image, y, &mut scratch[radius..radius + width]);
            let (first, last) = (scratch[radius], scratch[radius + width - 1]);
            scratch[..radius].fill(first);
            scratch[radius + width..].fill(last);
            self.horizontal(scratch, &mut out.pixels_mut()[y * width..(y + 1) * width]);
        }
        out
    }

    fn vertical(&self, image: &Image<f32>, y: usize, out: &mut [f32]) {
        let (width, height) = image.size();
        let px = image.pixels();
        let mut at = 0;
        while at < width {
            let n = LANES.min(width - at);
            let mut sum = [0.0_f32; LANES];
            for (i, &tap) in self.taps.iter().enumerate() {
                let above = &px[y.saturating_sub(i) * width + at..][..n];
                let below = &px[(y + i).min(height - 1) * width + at..][..n];
                // The centre row is seen twice.
                let tap = if i == 0 { 0.5 * tap } else { tap };
                if let (Ok(a), Ok(b)) = (<&[f32; LANES]>::try_from(above), <&[f32; LANES]>::try_from(below)) {
                    for k in 0..LANES {
                        sum[k] += tap * (a[k] + b[k]);
                    }
                } else {
                    for k in 0..n {
                        sum[k] += tap * (above[k] + below[k]);
                    }
                }
            }
            out[at..at + n].copy_from_slice(&sum[..n]);
            at += n;
        }
    }

    fn horizontal(&self, line: &[f32], out: &mut [f32]) {
        let radius = self.taps.len() - 1;
        let width = out.len();
        let mut at = 0;
        while at < width {
            let n = LANES.min(width - at);
            let mut sum = [0.0_f32; LANES];
            for (i, &tap) in self.taps.iter().enumerate() {
                let left = &line[at + radius - i..][..n];
                let right = &line[at + radius + i..][..n];
                let tap = if i == 0 { 0.5 * tap } else { tap };
                if let (Ok(a), Ok(b)) = (<&[f32; LANES]>::try_from(left), <&[f32; LANES]>::try_from(right)) {
                    for k in 0..LANES {
                        sum[k] += tap * (a[k] + b[k]);
                    }
                } else {
                    for k in 0..n {
                        sum[k] += tap * (left[k] + right[k]);
                    }
                }
            }
            out[at..at + n].copy_from_slice(&sum[..n]);
            at += n;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_constant_stays_and_an_impulse_gets_the_variance() {
        let mut scratch = Vec::new();
        let flat = Gaussian::new(2.0).filter(&Image::filled(37, 19, 5.0), &mut scratch);
        assert!(flat.pixels().iter().all(|v| (v - 5.0).abs() < 1e-4));

        let mut impulse = Image::filled(61, 61, 0.0);
        impulse[(30, 30)] = 1.0;
        let out = Gaussian::new(2.0).filter(&impulse, &mut scratch);
        let variance: f32 = (0..61)
            .flat_map(|y| (0..61).map(move |x| (x, y)))
            .map(|(x, y)| (x as f32 - 30.0).powi(2) * out[(x, y)])
            .sum();
        assert!((variance - 4.0).abs() < 0.15, "variance {variance}");
        assert!(Gaussian::new(0.0).filter(&impulse, &mut scratch) == impulse);
    }
}
