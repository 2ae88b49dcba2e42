//! Distances to a mask's border, on both sides of it.

use crate::frame::FieldImages;
use crate::window::Window;

/// In place of a pixel, where none is near.
pub(crate) const NOWHERE: [u32; 2] = [u32::MAX; 2];

/// For every pixel of the window within about `radius` pixels of the mask the masked one nearest to it, [`NOWHERE`] further
/// away. The window must hold all pixels that are masked.
pub(crate) fn nearest_masked(frame: &FieldImages, window: Window, radius: usize) -> Vec<[u32; 2]> {
    nearest(frame, window, radius, |m| m != 0)
}

/// The same for the background: for every pixel of the window within about `radius` pixels of it the nearest one that isn't
/// masked. Where the image goes on, the window must hold a pixel more than the mask on every side.
pub(crate) fn nearest_background(frame: &FieldImages, window: Window, radius: usize) -> Vec<[u32; 2]> {
    nearest(frame, window, radius, |m| m == 0)
}

/// Two sweeps in which pixels hand on what is nearest to them (Danielsson, Euclidean Distance Mapping, Computer Graphics
/// and Image Processing 14, 1980); distances are exact up to a fraction of a pixel.
fn nearest(frame: &FieldImages, window: Window, radius: usize, wanted: impl Fn(u8) -> bool) -> Vec<[u32; 2]> {
    let (width, height) = (window.width, window.height);
    // In pixels of the window until the end.
    let mut near = vec![NOWHERE; window.len()];
    for (i, (u, v)) in window.pixels().enumerate() {
        if wanted(frame.mask[v * frame.width + u]) {
            near[i] = [(i % width) as u32, (i / width) as u32];
        }
    }
    let reach = (radius * radius) as i64;
    let mut take = |(u, v): (usize, usize), neighbours: &[(i64, i64)]| {
        for (du, dv) in neighbours {
            let (x, y) = (u as i64 + du, v as i64 + dv);
            if (0..width as i64).contains(&x) && (0..height as i64).contains(&y) {
                let [own, other] = [(u, v), (x as usize, y as usize)].map(|(u, v)| near[v * width + u]);
                let distance = squared(other, (u, v));
                if distance <= reach && distance < squared(own, (u, v)) {
                    near[v * width + u] = other;
                }
            }
        }
    };
    for v in 0..height {
        (0..width).for_each(|u| take((u, v), &[(-1, 0), (-1, -1), (0, -1), (1, -1)]));
        (0..width).rev().for_each(|u| take((u, v), &[(1, 0)]));
    }
    for v in (0..height).rev() {
        (0..width).rev().for_each(|u| take((u, v), &[(1, 0), (1, 1), (0, 1), (-1, 1)]));
        (0..width).for_each(|u| take((u, v), &[(-1, 0)]));
    }
    let [left, top] = window.start().map(|c| c as u32);
    for pixel in near.iter_mut().filter(|p| **p != NOWHERE) {
        *pixel = [pixel[0] + left, pixel[1] + top];
    }
    near
}

fn squared(pixel: [u32; 2], (u, v): (usize, usize)) -> i64 {
    if pixel == NOWHERE {
        return i64::MAX;
    }
    let [x, y] = pixel.map(i64::from);
    (x - u as i64).pow(2) + (y - v as i64).pow(2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_pixel_is_found_up_to_the_radius() {
        let (width, height) = (40, 30);
        let mut mask = vec![0; width * height];
        let masked = [(5, 5), (6, 5), (20, 18), (21, 18), (33, 2)];
        for (u, v) in masked {
            mask[v * width + u] = 1;
        }
        let frame = FieldImages {
            id: 0,
            width,
            height,
            fx: 1.0,
            fy: 1.0,
            cx: 0.0,
            cy: 0.0,
            color: vec![[0; 3]; width * height],
            depth: vec![0.0; width * height],
            mask,
            mask_margin: 0.0,
        };
        let radius = 9;
        let all = Window::around([0, 0, width - 1, height - 1], 0, (width, height));
        let near = nearest_masked(&frame, all, radius);
        for ((u, v), near) in all.pixels().zip(&near) {
            let true_distance = masked.iter().map(|&(x, y)| squared([x as u32, y as u32], (u, v))).min();
            let (found, best) = (squared(*near, (u, v)), true_distance.unwrap());
            if best <= ((radius - 1) * (radius - 1)) as i64 {
                assert!((found as f64).sqrt() - (best as f64).sqrt() < 0.3, "{u} {v}");
            }
            assert!(found == i64::MAX || (best..=(radius * radius) as i64).contains(&found));
        }
        // A part of the image that holds all that is masked finds the same.
        let part = Window::around(frame.mask_box().unwrap(), radius, (width, height));
        let (inner, background) = (nearest_masked(&frame, part, radius), nearest_background(&frame, part, 2));
        let all_background = nearest_background(&frame, all, 2);
        for (i, pixel) in part.pixels().enumerate() {
            assert_eq!(inner[i], near[all.at(pixel)]);
            assert_eq!(background[i], all_background[all.at(pixel)]);
        }
    }
}
