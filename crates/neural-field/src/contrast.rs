//! Colour relative to the brightness around it, which light moves less than colour itself.
//!
//! Seen by a still camera, an object that turns is lit from another side in every frame. Shading is smooth and texture is
//! not, so that dividing an image by its own blur takes most of the first away and leaves the second (the centre and
//! surround of Jobson, Rahman and Woodell, "Properties and Performance of a Center/Surround Retinex", IEEE TIP 1997).

use crate::frame::FieldImages;
use crate::rays::FrameRays;
use crate::volume::Volume;
use crate::window::Window;
use nalgebra::{Isometry3, Point3};

/// Added to all brightness (0..1): what is darker than this has no contrast.
const DARK: f32 = 4.0 / 255.0;
/// Cells per axis of the lattice that remembers brightness.
const CELLS: usize = 32;

/// For every pixel of the window twice the mean brightness (0..1) of the masked ones within a [`reach`]; the window must hold
/// all pixels that are masked. 1 everywhere if there is no reach.
pub(crate) fn surround(frame: &FieldImages, window: Window, reach: usize) -> Vec<f32> {
    if reach == 0 {
        return vec![1.0; window.len()];
    }
    let brightness = |c: &[u8; 3]| c.iter().map(|v| f32::from(*v)).sum::<f32>() / 765.0 + DARK;
    let pixels = || window.pixels().map(|(u, v)| v * frame.width + u);
    let masked = |i: &usize| frame.mask[*i] != 0;
    let mut sum: Vec<f32> =
        pixels().map(|i| if masked(&i) { brightness(&frame.color[i]) } else { 0.0 }).collect();
    let mut weight: Vec<f32> = pixels().map(|i| f32::from(u8::from(masked(&i)))).collect();
    // Two passes of a box of half the reach: a tent.
    let (width, height) = (window.width, window.height);
    let mut line = Vec::new();
    for image in [&mut sum, &mut weight] {
        for _ in 0..2 {
            for v in 0..height {
                average(&mut image[v * width..], (width, 1), reach / 2, &mut line);
            }
            for u in 0..width {
                average(&mut image[u..], (height, width), reach / 2, &mut line);
            }
        }
    }
    sum.iter().zip(&weight).map(|(s, w)| if *w > 1e-6 { 2.0 * s / w } else { 1.0 }).collect()
}

/// How far a pixel's surround reaches, pixels: about `window` times the larger side of the mask's box `[u0, v0, u1, v1]`; 0
/// if `window` is.
pub(crate) fn reach(frame: &FieldImages, [u0, v0, u1, v1]: [usize; 4], window: f64) -> usize {
    if window <= 0.0 {
        return 0;
    }
    let side = (u1 - u0).max(v1 - v0) as f64;
    2 * ((0.5 * window * side).ceil() as usize).clamp(1, frame.width.max(frame.height))
}

/// Replaces `count` values, `step` apart, by the means of those within `radius`; beyond the ends all are zero.
fn average(values: &mut [f32], (count, step): (usize, usize), radius: usize, sums: &mut Vec<f64>) {
    sums.clear();
    sums.push(0.0);
    let mut total = 0.0;
    for i in 0..count {
        total += f64::from(values[i * step]);
        sums.push(total);
    }
    for i in 0..count {
        let (from, to) = (i.saturating_sub(radius), (i + radius + 1).min(count));
        values[i * step] = ((sums[to] - sums[from]) / (2 * radius + 1) as f64) as f32;
    }
}

/// The brightness that was divided out of the colours, as the mean of what the frames saw: a lattice over the cube of the
/// field. It gives colours back to a network that knows their contrast.
#[derive(Clone, Debug)]
pub(crate) struct Brightness {
    center: [f64; 3],
    edge: f64,
    /// Sum and number of what was seen about each vertex.
    seen: Vec<[f32; 2]>,
    mean: f32,
}

impl Brightness {
    /// What the surface rays of all frames saw under these poses.
    pub(crate) fn new(volume: &Volume, rays: &[FrameRays], poses: &[Isometry3<f64>]) -> Self {
        let (center, edge) = (volume.center, volume.edge);
        let mut lattice = Self { center, edge, seen: vec![[0.0; 2]; (CELLS + 1).pow(3)], mean: 1.0 };
        let mut all = [0.0f64; 2];
        for (rays, pose) in rays.iter().map(|r| &r.surface).zip(poses) {
            for ((dir, distance), value) in rays.dir.iter().zip(&rays.distance).zip(&rays.surround) {
                let p = pose * Point3::from(dir.map(|c| f64::from(c * distance)));
                for (vertex, share) in lattice.around([p.x as f32, p.y as f32, p.z as f32]) {
                    lattice.seen[vertex][0] += share * value;
                    lattice.seen[vertex][1] += share;
                }
                all[0] += f64::from(*value);
                all[1] += 1.0;
            }
        }
        if all[1] > 0.0 {
            lattice.mean = (all[0] / all[1]) as f32;
        }
        lattice
    }

    /// A colour (0..1) of this contrast at a point of the object frame.
    pub(crate) fn color(&self, point: [f32; 3], contrast: [f32; 3]) -> [f32; 3] {
        let [sum, weight] =
            self.around(point).into_iter().fold([0.0; 2], |[sum, weight], (vertex, share)| {
                let [s, w] = self.seen[vertex];
                [sum + share * s, weight + share * w]
            });
        let surround = if weight > 1e-6 { sum / weight } else { self.mean };
        contrast.map(|c| (c * surround).min(1.0))
    }

    /// The vertices of the point's cell, and how near it is to each.
    fn around(&self, point: [f32; 3]) -> [(usize, f32); 8] {
        let cells = CELLS as f64;
        let at: [f64; 3] = std::array::from_fn(|a| {
            let x = ((f64::from(point[a]) - self.center[a]) / self.edge + 0.5) * cells;
            if x.is_finite() { x.clamp(0.0, cells) } else { 0.0 }
        });
        let low = at.map(|x| (x as usize).min(CELLS - 1));
        std::array::from_fn(|corner| {
            let bit = [corner & 1, corner >> 1 & 1, corner >> 2];
            let vertex = (0..3).fold(0, |v, a| v * (CELLS + 1) + low[a] + bit[a]);
            let share = |a: usize| {
                let t = at[a] - low[a] as f64;
                if bit[a] == 1 { t } else { 1.0 - t }
            };
            (vertex, (share(0) * share(1) * share(2)) as f32)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A textured image under light that falls off to one side, as bright as `light` says.
    fn lit(light: impl Fn(usize) -> f64) -> FieldImages {
        let (width, height) = (80, 60);
        let inside = |u: usize, v: usize| (10..70).contains(&u) && (8..52).contains(&v);
        let pixel = |i: usize| (i % width, i / width);
        let color = |i: usize| {
            let (u, v) = pixel(i);
            let paint = if (u / 3 + v / 3) % 2 == 0 { [1.0, 0.8, 0.6] } else { [0.5, 0.6, 0.7] };
            // What isn't masked is of no concern.
            paint.map(|c: f64| if inside(u, v) { (c * light(u)).round() as u8 } else { 255 })
        };
        FieldImages {
            id: 0,
            width,
            height,
            fx: 60.0,
            fy: 60.0,
            cx: 39.5,
            cy: 29.5,
            color: (0..width * height).map(color).collect(),
            depth: vec![0.5; width * height],
            mask: (0..width * height).map(|i| u8::from(inside(pixel(i).0, pixel(i).1))).collect(),
            mask_margin: 0.0,
        }
    }

    /// The surround in all pixels.
    fn everywhere(image: &FieldImages, window: f64) -> Vec<f32> {
        let size = (image.width, image.height);
        let all = Window::around([0, 0, size.0 - 1, size.1 - 1], 0, size);
        surround(image, all, reach(image, image.mask_box().unwrap(), window))
    }

    /// Median difference between the contrasts of two images inside the mask; without a window, between their colours.
    fn difference(a: &FieldImages, b: &FieldImages, window: f64) -> f32 {
        let (in_a, in_b) = (everywhere(a, window), everywhere(b, window));
        let mut errors: Vec<f32> = (0..a.mask.len())
            .filter(|i| a.mask[*i] != 0)
            .map(|i| {
                let value = |f: &FieldImages, s: &[f32]| f32::from(f.color[i][0]) / 255.0 / s[i];
                (value(a, &in_a) - value(b, &in_b)).abs()
            })
            .collect();
        errors.sort_by(f32::total_cmp);
        errors[errors.len() / 2]
    }

    #[test]
    fn contrast_is_the_same_under_another_light() {
        let from_left = lit(|u| 220.0 - 1.5 * u as f64);
        let from_right = lit(|u| 100.0 + 1.5 * u as f64);
        let (colors, contrast) =
            (difference(&from_left, &from_right, 0.0), difference(&from_left, &from_right, 0.1));
        assert!(colors > 0.1 && contrast < 0.02, "{contrast} of {colors}");
    }

    #[test]
    fn contrast_is_the_same_under_half_the_light() {
        let (bright, dim) = (lit(|_| 200.0), lit(|_| 100.0));
        assert!(difference(&bright, &dim, 0.1) < 0.02);
    }

    #[test]
    fn without_a_window_colours_stay() {
        let image = lit(|u| u as f64);
        assert_eq!(everywhere(&image, 0.0), vec![1.0; 80 * 60]);
    }

    #[test]
    fn what_is_further_off_than_the_reach_plays_no_part() {
        let image = lit(|u| u as f64);
        let bounds = image.mask_box().unwrap();
        let reach = reach(&image, bounds, 0.1);
        let part = Window::around(bounds, reach, (80, 60));
        let (found, all) = (surround(&image, part, reach), everywhere(&image, 0.1));
        for (pixel, found) in part.pixels().zip(found).filter(|((u, v), _)| image.masked(*u, *v)) {
            assert_eq!(found, all[pixel.1 * 80 + pixel.0]);
        }
    }

    #[test]
    fn a_window_of_any_size_gives_numbers() {
        let mut image = lit(|u| u as f64);
        for window in [1e-9, 0.1, 1.0, 100.0, f64::MAX] {
            let found = everywhere(&image, window);
            assert!(found.iter().all(|s| s.is_finite() && *s > 0.0), "{window}");
        }
        image.color.fill([0; 3]);
        assert!(everywhere(&image, 0.1).iter().all(|s| *s > 0.0));
    }
}
