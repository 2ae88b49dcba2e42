//! Gray images: conversion, sub-pixel sampling, gradients and the pyramid.

use rgbd_io::{Image, Mask};

/// An axis-aligned rectangle of pixels, `x..x + width` by `y..y + height`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rect {
    /// Left column.
    pub x: usize,
    /// Top row.
    pub y: usize,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

impl Rect {
    /// The tight box of the mask's object pixels, widened by `margin` pixels on each side and clipped to the image;
    /// `None` for an empty mask.
    pub fn around_mask(mask: &Mask, margin: usize) -> Option<Self> {
        let (width, height) = mask.size();
        let (mut left, mut right, mut top, mut bottom) = (usize::MAX, 0, usize::MAX, 0);
        for y in 0..height {
            let row = mask.row(y);
            let Some(first) = row.iter().position(|&v| v != 0) else { continue };
            let last = row.iter().rposition(|&v| v != 0).unwrap_or(first);
            left = left.min(first);
            right = right.max(last);
            top = top.min(y);
            bottom = y;
        }
        if top == usize::MAX {
            return None;
        }
        let (x, y) = (left.saturating_sub(margin), top.saturating_sub(margin));
        let x_end = right.saturating_add(margin).saturating_add(1).min(width);
        let y_end = bottom.saturating_add(margin).saturating_add(1).min(height);
        Some(Self { x, y, width: x_end - x, height: y_end - y })
    }

    /// The part of `image` inside the rectangle (clipped to the image).
    pub fn cut<T: Copy + Default>(self, image: &Image<T>) -> Image<T> {
        let rect = self.clipped(image.width(), image.height());
        let mut pixels = Vec::with_capacity(rect.width * rect.height);
        for y in rect.y..rect.y + rect.height {
            pixels.extend_from_slice(&image.row(y)[rect.x..rect.x + rect.width]);
        }
        Image::from_vec(rect.width, rect.height, pixels).unwrap_or_default()
    }

    fn clipped(self, width: usize, height: usize) -> Self {
        let (x, y) = (self.x.min(width), self.y.min(height));
        Self { x, y, width: self.width.min(width - x), height: self.height.min(height - y) }
    }
}

/// Luma of an RGB image, 0 to 255 (Rec. 601 weights).
pub fn to_gray(color: &Image<[u8; 3]>) -> Image<f32> {
    color.map(luma)
}

/// [`to_gray`] of the part of `color` inside `rect` (clipped to the image).
pub fn to_gray_rect(color: &Image<[u8; 3]>, rect: Rect) -> Image<f32> {
    to_gray(&rect.cut(color))
}

#[inline]
fn luma(rgb: &[u8; 3]) -> f32 {
    0.299 * f32::from(rgb[0]) + 0.587 * f32::from(rgb[1]) + 0.114 * f32::from(rgb[2])
}

/// The bilinearly interpolated value at pixel `(x, y)`; `None` outside the hull of the pixel centres and for NaN.
pub fn sample_bilinear(image: &Image<f32>, x: f32, y: f32) -> Option<f32> {
    let (width, height) = image.size();
    if width == 0 || height == 0 {
        return None;
    }
    let inside = x >= 0.0 && y >= 0.0 && x <= (width - 1) as f32 && y <= (height - 1) as f32;
    inside.then(|| sample_clamped(image, x, y))
}

/// Bilinear value at `(x, y)` moved to the nearest point of the image. The image must not be empty; NaN gives NaN.
#[inline]
pub(crate) fn sample_clamped(image: &Image<f32>, x: f32, y: f32) -> f32 {
    let (width, height) = image.size();
    let x = x.clamp(0.0, (width - 1) as f32);
    let y = y.clamp(0.0, (height - 1) as f32);
    let (x0, y0) = (x as usize, y as usize);
    let (fx, fy) = (x - x0 as f32, y - y0 as f32);
    let right = usize::from(x0 + 1 < width);
    let below = if y0 + 1 < height { width } else { 0 };
    let at = y0 * width + x0;
    let px = image.pixels();
    let top = px[at] + fx * (px[at + right] - px[at]);
    let bottom = px[at + below] + fx * (px[at + below + right] - px[at + below]);
    top + fy * (bottom - top)
}

/// Whether every point up to `reach` from `p` has four pixels around it.
#[inline]
pub(crate) fn is_interior(image: &Image<f32>, p: [f32; 2], reach: [f32; 2]) -> bool {
    let (width, height) = image.size();
    p[0] - reach[0] >= 0.0
        && p[1] - reach[1] >= 0.0
        && p[0] + reach[0] < width as f32 - 1.01
        && p[1] + reach[1] < height as f32 - 1.01
}

/// Bilinear value at a point that [`is_interior`]: several times as fast as [`sample_clamped`].
#[inline]
pub(crate) fn sample_interior(image: &Image<f32>, x: f32, y: f32) -> f32 {
    // Through i32, for which there is an instruction.
    let (xi, yi) = (x as i32, y as i32);
    let (fx, fy) = (x - xi as f32, y - yi as f32);
    let width = image.width();
    let at = yi as usize * width + xi as usize;
    let Some(&[a, b]) = image.pixels().get(at..at + 2).and_then(|p| p.first_chunk()) else { return 0.0 };
    let Some(&[c, d]) = image.pixels().get(at + width..at + width + 2).and_then(|p| p.first_chunk()) else {
        return 0.0;
    };
    let (top, bottom) = (a + fx * (b - a), c + fx * (d - c));
    top + fy * (bottom - top)
}

/// Horizontal and vertical derivatives in gray levels per pixel by the Scharr operator, edges replicated.
pub fn scharr(image: &Image<f32>) -> (Image<f32>, Image<f32>) {
    let (width, height) = image.size();
    let mut dx = Image::filled(width, height, 0.0);
    let mut dy = Image::filled(width, height, 0.0);
    if width == 0 || height == 0 {
        return (dx, dy);
    }
    // Vertical smoothing (3, 10, 3)/16 and difference (-1, 0, 1)/2 with one replicated column on each side.
    let mut smooth = vec![0.0_f32; width + 2];
    let mut diff = vec![0.0_f32; width + 2];
    for y in 0..height {
        let above = image.row(y.saturating_sub(1));
        let here = image.row(y);
        let below = image.row((y + 1).min(height - 1));
        for x in 0..width {
            smooth[x + 1] = (3.0 * (above[x] + below[x]) + 10.0 * here[x]) * (1.0 / 16.0);
            diff[x + 1] = 0.5 * (below[x] - above[x]);
        }
        for line in [&mut smooth, &mut diff] {
            line[0] = line[1];
            line[width + 1] = line[width];
        }
        let span = y * width..(y + 1) * width;
        let (out_x, out_y) = (&mut dx.pixels_mut()[span.clone()], &mut dy.pixels_mut()[span]);
        let (s0, s2) = (&smooth[..width], &smooth[2..width + 2]);
        let (d0, d1, d2) = (&diff[..width], &diff[1..width + 1], &diff[2..width + 2]);
        for x in 0..width {
            out_x[x] = 0.5 * (s2[x] - s0[x]);
            out_y[x] = (3.0 * (d0[x] + d2[x]) + 10.0 * d1[x]) * (1.0 / 16.0);
        }
    }
    (dx, dy)
}

/// Half the size: binomial filter (1, 4, 6, 4, 1)/16 along both axes, then every second pixel. Pixel `(x, y)` of the
/// result lies on pixel `(2x, 2y)` of `image`. Edges are replicated.
pub fn downsample(image: &Image<f32>) -> Image<f32> {
    let (width, height) = image.size();
    let (half_w, half_h) = (width.div_ceil(2), height.div_ceil(2));
    let mut out = Image::filled(half_w, half_h, 0.0);
    if width == 0 || height == 0 {
        return out;
    }
    let mut line = vec![0.0_f32; width + 4];
    for y in 0..half_h {
        let row = |dy: isize| image.row((2 * y).saturating_add_signed(dy).min(height - 1));
        let rows = [row(-2), row(-1), row(0), row(1), row(2)];
        for x in 0..width {
            line[x + 2] =
                (rows[0][x] + rows[4][x] + 4.0 * (rows[1][x] + rows[3][x]) + 6.0 * rows[2][x]) * (1.0 / 16.0);
        }
        line[0] = line[2];
        line[1] = line[2];
        line[width + 2] = line[width + 1];
        line[width + 3] = line[width + 1];
        for (value, p) in
            out.pixels_mut()[y * half_w..(y + 1) * half_w].iter_mut().zip(line.windows(5).step_by(2))
        {
            *value = (p[0] + p[4] + 4.0 * (p[1] + p[3]) + 6.0 * p[2]) * (1.0 / 16.0);
        }
    }
    out
}

/// A gray image at full, half, quarter ... resolution.
///
/// The pyramid may cover only a rectangle of the frame (an object's box); its points are pixels of the **whole** frame
/// all the same, through the origin.
#[derive(Clone, Debug)]
pub struct Pyramid {
    levels: Vec<Image<f32>>,
    origin: [f32; 2],
}

impl Pyramid {
    /// A pyramid of up to `levels` levels (at least one) on `gray`; levels under 12 pixels a side are left out.
    pub fn new(gray: Image<f32>, levels: usize) -> Self {
        const SMALLEST: usize = 12;
        let mut all = vec![gray];
        while all.len() < levels {
            let Some(finest) = all.last() else { break };
            if finest.width().min(finest.height()) < 2 * SMALLEST {
                break;
            }
            let next = downsample(finest);
            all.push(next);
        }
        Self { levels: all, origin: [0.0, 0.0] }
    }

    /// A pyramid on the part of a colour frame inside `rect`, with points in pixels of the whole frame.
    pub fn from_rect(color: &Image<[u8; 3]>, rect: Rect, levels: usize) -> Self {
        let rect = rect.clipped(color.width(), color.height());
        Self::new(to_gray_rect(color, rect), levels).with_origin([rect.x as f32, rect.y as f32])
    }

    /// The same pyramid for an image whose top-left pixel is pixel `origin` of the frame.
    #[must_use]
    pub fn with_origin(mut self, origin: [f32; 2]) -> Self {
        self.origin = origin;
        self
    }

    /// The images, finest first; pixel `x` of level `l` lies on pixel `x * 2^l` of level 0.
    pub fn levels(&self) -> &[Image<f32>] {
        &self.levels
    }

    /// Frame pixel on which pixel (0, 0) of level 0 lies.
    pub fn origin(&self) -> [f32; 2] {
        self.origin
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_of_a_ramp_are_its_slopes() {
        let ramp = Image::from_fn(9, 7, |x, y| 2.0 * x as f32 - 3.0 * y as f32);
        let (dx, dy) = scharr(&ramp);
        for y in 1..6 {
            for x in 1..8 {
                assert!((dx[(x, y)] - 2.0).abs() < 1e-5 && (dy[(x, y)] + 3.0).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn downsampling_keeps_a_ramp_on_even_pixels() {
        let ramp = Image::from_fn(21, 16, |x, y| x as f32 + 10.0 * y as f32);
        let half = downsample(&ramp);
        assert_eq!(half.size(), (11, 8));
        for y in 1..7 {
            for x in 1..10 {
                assert!((half[(x, y)] - (2 * x) as f32 - 20.0 * y as f32).abs() < 1e-3);
            }
        }
    }

    #[test]
    fn bilinear_sampling_is_exact_on_a_plane_and_refuses_the_outside() {
        let plane = Image::from_fn(5, 4, |x, y| x as f32 + 2.0 * y as f32);
        assert!((sample_bilinear(&plane, 1.25, 2.5).unwrap() - 6.25).abs() < 1e-6);
        assert!((sample_bilinear(&plane, 4.0, 3.0).unwrap() - 10.0).abs() < 1e-6);
        for (x, y) in [(-0.1, 0.0), (4.1, 0.0), (0.0, 3.1), (f32::NAN, 1.0)] {
            assert_eq!(sample_bilinear(&plane, x, y), None);
        }
        assert_eq!(sample_bilinear(&Image::default(), 0.0, 0.0), None);
    }

    #[test]
    fn empty_and_single_pixel_images_are_fine() {
        for image in [Image::default(), Image::filled(1, 1, 3.0_f32)] {
            let (dx, dy) = scharr(&image);
            assert!(dx.pixels().iter().chain(dy.pixels()).all(|&v| v == 0.0));
            assert_eq!(downsample(&image).size(), image.size());
            assert_eq!(Pyramid::new(image, 4).levels().len(), 1);
        }
    }

    #[test]
    fn the_rectangle_is_tight_and_clipped() {
        let mut mask = Mask::filled(20, 10, 0);
        mask[(4, 2)] = 1;
        mask[(7, 8)] = 1;
        assert_eq!(Rect::around_mask(&mask, 0), Some(Rect { x: 4, y: 2, width: 4, height: 7 }));
        assert_eq!(Rect::around_mask(&mask, 3), Some(Rect { x: 1, y: 0, width: 10, height: 10 }));
        assert_eq!(Rect::around_mask(&Mask::filled(5, 5, 0), 2), None);
        let color = Image::filled(20, 10, [255_u8, 255, 255]);
        let far = Rect { x: 18, y: 30, width: 9, height: 9 };
        assert!(to_gray_rect(&color, far).is_empty());
    }
}
