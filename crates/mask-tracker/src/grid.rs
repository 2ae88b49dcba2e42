//! The working grid: a window of the frame at the object's resolution.

use rgbd_io::{Intrinsics, RgbdFrame};

use crate::math::floor;

/// Opponent colour: luminance and two chroma axes, all in about 0..255 units. Shading moves the first axis most,
/// which is why [`color_distance2`] trusts it least.
pub(crate) type Color = [f32; 3];

#[inline]
pub(crate) fn opponent(rgb: [f32; 3]) -> Color {
    let [r, g, b] = rgb;
    [0.25 * r + 0.5 * g + 0.25 * b, 0.7 * (r - b), 0.7 * (g - 0.5 * (r + b))]
}

#[inline]
pub(crate) fn color_distance2(a: Color, b: Color) -> f32 {
    let d = [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
    0.4 * d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
}

/// A measured depth, or 0 for anything a sensor can't have meant.
#[inline]
pub(crate) fn sane_depth(z: f32) -> f32 {
    if z.is_finite() && z > 0.0 && z < 100.0 { z } else { 0.0 }
}

/// Depth noise (m, about one sigma) of consumer sensors: a floor plus the quadratic growth of triangulation.
#[inline]
pub(crate) fn depth_noise(z: f32) -> f32 {
    0.002 + 0.003 * z * z
}

/// Intrinsics in f32, replaced by a plausible camera when they are unusable.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Camera {
    pub(crate) fx: f32,
    pub(crate) fy: f32,
    pub(crate) cx: f32,
    pub(crate) cy: f32,
}

impl Camera {
    pub(crate) fn new(k: &Intrinsics, size: (usize, usize)) -> Self {
        if k.is_valid() {
            Self { fx: k.fx as f32, fy: k.fy as f32, cx: k.cx as f32, cy: k.cy as f32 }
        } else {
            let (w, h) = (size.0.max(1) as f32, size.1.max(1) as f32);
            Self { fx: w.max(h), fy: w.max(h), cx: 0.5 * (w - 1.0), cy: 0.5 * (h - 1.0) }
        }
    }

    #[inline]
    pub(crate) fn project(&self, p: [f32; 3]) -> Option<[f32; 2]> {
        (p[2] > 1e-3).then(|| {
            let inverse = 1.0 / p[2];
            [self.fx * p[0] * inverse + self.cx, self.fy * p[1] * inverse + self.cy]
        })
    }

    #[inline]
    pub(crate) fn unproject(&self, u: f32, v: f32, z: f32) -> [f32; 3] {
        [(u - self.cx) / self.fx * z, (v - self.cy) / self.fy * z, z]
    }
}

/// A box in pixels, `[left, top, right, bottom]`.
pub(crate) type Bounds = [f32; 4];

pub(crate) const EMPTY_BOUNDS: Bounds = [f32::INFINITY, f32::INFINITY, f32::NEG_INFINITY, f32::NEG_INFINITY];

pub(crate) fn include(bounds: &mut Bounds, u: f32, v: f32) {
    if u.is_finite() && v.is_finite() {
        bounds[0] = bounds[0].min(u);
        bounds[1] = bounds[1].min(v);
        bounds[2] = bounds[2].max(u);
        bounds[3] = bounds[3].max(v);
    }
}

/// Cells of `step` x `step` pixels from pixel `(x0, y0)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Window {
    pub(crate) x0: usize,
    pub(crate) y0: usize,
    pub(crate) step: usize,
    pub(crate) w: usize,
    pub(crate) h: usize,
}

impl Window {
    /// The part of an image of `size` within `margin` pixels of `bounds`, in the finest cells of which it has at most
    /// `max_cells`; `None` when the two don't meet.
    pub(crate) fn around(
        bounds: Bounds,
        margin: f32,
        size: (usize, usize),
        max_cells: usize,
    ) -> Option<Self> {
        let clamp = |v: f32, hi: usize| v.clamp(0.0, hi as f32) as usize;
        let x0 = clamp((bounds[0] - margin).floor(), size.0);
        let y0 = clamp((bounds[1] - margin).floor(), size.1);
        let x1 = clamp((bounds[2] + margin).ceil() + 1.0, size.0);
        let y1 = clamp((bounds[3] + margin).ceil() + 1.0, size.1);
        if x1 <= x0 || y1 <= y0 {
            return None;
        }
        let fits = |step: &usize| (x1 - x0).div_ceil(*step) * (y1 - y0).div_ceil(*step) <= max_cells.max(64);
        let step = (1..=size.0.max(size.1)).find(fits)?;
        Some(Self { x0, y0, step, w: (x1 - x0).div_ceil(step), h: (y1 - y0).div_ceil(step) })
    }

    pub(crate) fn len(&self) -> usize {
        self.w * self.h
    }

    /// Column and row (may lie outside) of the cell of pixel `(u, v)`.
    #[inline]
    pub(crate) fn cell(&self, u: f32, v: f32) -> (i32, i32) {
        let scale = 1.0 / self.step as f32;
        (floor((u + 0.5 - self.x0 as f32) * scale), floor((v + 0.5 - self.y0 as f32) * scale))
    }

    #[inline]
    pub(crate) fn index(&self, cell: (i32, i32)) -> Option<usize> {
        (cell.0 >= 0 && cell.1 >= 0 && (cell.0 as usize) < self.w && (cell.1 as usize) < self.h)
            .then(|| cell.1 as usize * self.w + cell.0 as usize)
    }

    /// Pixel coordinates of the cells' centres, in their order.
    pub(crate) fn centers(&self) -> impl Iterator<Item = (f32, f32)> {
        let Self { x0, y0, step, w, h } = *self;
        let half = 0.5 * (step as f32 - 1.0);
        let at = move |origin: usize, cell: usize| (origin + cell * step) as f32 + half;
        (0..h).flat_map(move |y| (0..w).map(move |x| (at(x0, x), at(y0, y))))
    }

    /// Pixel coordinates of the centre of cell `i`.
    #[inline]
    pub(crate) fn center(&self, i: usize) -> (f32, f32) {
        let half = 0.5 * (self.step as f32 - 1.0);
        ((self.x0 + i % self.w * self.step) as f32 + half, (self.y0 + i / self.w * self.step) as f32 + half)
    }
}

/// Mean colour and a representative depth of every cell of a window.
pub(crate) struct Grid {
    pub(crate) window: Window,
    /// One plane for each axis of [`Color`].
    planes: [Vec<f32>; 3],
    /// The valid depth next to the cell's centre, 0 when the cell has none (no mean: it would invent surface
    /// between foreground and background).
    pub(crate) depth: Vec<f32>,
}

impl Grid {
    pub(crate) fn new(frame: &RgbdFrame, window: Window) -> Self {
        let (width, height) = frame.color.size();
        let x1 = (window.x0 + window.w * window.step).min(width);
        let mut planes: [Vec<f32>; 3] = std::array::from_fn(|_| Vec::with_capacity(window.len()));
        let mut depth = Vec::with_capacity(window.len());
        let mut sums: Vec<[u32; 3]> = vec![[0; 3]; window.w];
        for cy in 0..window.h {
            let y0 = window.y0 + cy * window.step;
            let y1 = (y0 + window.step).min(height);
            sums.fill([0; 3]);
            for y in y0..y1 {
                let pixels = frame.color.row(y).get(window.x0..x1).unwrap_or(&[]);
                for (sum, cell) in sums.iter_mut().zip(pixels.chunks(window.step)) {
                    for c in cell {
                        *sum = std::array::from_fn(|k| sum[k] + u32::from(c[k]));
                    }
                }
            }
            let whole = 1.0 / (window.step * (y1 - y0)).max(1) as f32;
            for (cx, sum) in sums.iter().enumerate() {
                let x0 = window.x0 + cx * window.step;
                let right = (x0 + window.step).min(width);
                let scale = if right - x0 == window.step {
                    whole
                } else {
                    1.0 / ((right - x0) * (y1 - y0)).max(1) as f32
                };
                let color = opponent(sum.map(|s| s as f32 * scale));
                planes.iter_mut().zip(color).for_each(|(plane, c)| plane.push(c));
                depth.push(cell_depth(frame, x0, y0, right, y1));
            }
        }
        Self { window, planes, depth }
    }

    #[cfg(test)]
    pub(crate) fn from_cells(window: Window, color: &[Color], depth: Vec<f32>) -> Self {
        let planes = std::array::from_fn(|k| color.iter().map(|c| c[k]).collect());
        Self { window, planes, depth }
    }

    /// Colour of cell `i`.
    #[inline]
    pub(crate) fn color(&self, i: usize) -> Color {
        [self.planes[0][i], self.planes[1][i], self.planes[2][i]]
    }

    pub(crate) fn colors(&self) -> impl Iterator<Item = Color> {
        (0..self.depth.len()).map(|i| self.color(i))
    }

    /// Colours of the cells of a range, axis by axis.
    pub(crate) fn color_rows(&self, cells: std::ops::Range<usize>) -> [&[f32]; 3] {
        self.planes.each_ref().map(|plane| plane.get(cells.clone()).unwrap_or(&[]))
    }
}

fn cell_depth(frame: &RgbdFrame, x0: usize, y0: usize, x1: usize, y1: usize) -> f32 {
    let at = |x: usize, y: usize| frame.depth.get(x, y).map_or(0.0, |&z| sane_depth(z));
    let center = at((x0 + x1) / 2, (y0 + y1) / 2);
    if center > 0.0 {
        return center;
    }
    for y in y0..y1 {
        for x in x0..x1 {
            let z = at(x, y);
            if z > 0.0 {
                return z;
            }
        }
    }
    0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_window_has_the_finest_cells_of_which_there_are_few_enough() {
        for (bounds, max_cells) in [
            ([0.0, 0.0, 639.0, 479.0], 12_000),
            ([100.0, 50.0, 180.0, 400.0], 12_000),
            ([300.0, 200.0, 330.0, 240.0], 12_000),
            ([0.0, 0.0, 639.0, 479.0], 1),
        ] {
            let window = Window::around(bounds, 5.0, (640, 480), max_cells).unwrap();
            assert!(window.len() <= max_cells.max(64), "{window:?}");
            let finer = window.step - 1;
            assert!(finer == 0 || window.len() * window.step.pow(2) / finer.pow(2) > max_cells, "{window:?}");
        }
        assert_eq!(Window::around([700.0, 0.0, 720.0, 20.0], 5.0, (640, 480), 12_000), None);
    }
}
