//! Distances to a mask's border, on both sides of it.

use crate::frame::FieldImages;

/// In place of a pixel, where none is near.
pub(crate) const NOWHERE: [u32; 2] = [u32::MAX; 2];

/// For every pixel within about `radius` pixels of the mask the masked one nearest to it, [`NOWHERE`] further away.
pub(crate) fn nearest_masked(frame: &FieldImages, radius: usize) -> Vec<[u32; 2]> {
    nearest(frame, radius, |m| m != 0)
}

/// The same for the background: for every pixel within about `radius` pixels of it the nearest one that isn't masked.
pub(crate) fn nearest_background(frame: &FieldImages, radius: usize) -> Vec<[u32; 2]> {
    nearest(frame, radius, |m| m == 0)
}

/// Two sweeps in which pixels hand on what is nearest to them (Danielsson, Euclidean Distance Mapping, Computer Graphics
/// and Image Processing 14, 1980); distances are exact up to a fraction of a pixel.
fn nearest(frame: &FieldImages, radius: usize, wanted: impl Fn(u8) -> bool) -> Vec<[u32; 2]> {
    let (width, height) = (frame.width, frame.height);
    let mut near = vec![NOWHERE; width * height];
    for (i, pixel) in near.iter_mut().enumerate().filter(|(i, _)| wanted(frame.mask[*i])) {
        *pixel = [(i % width) as u32, (i / width) as u32];
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
        let near = nearest_masked(&frame, radius);
        for v in 0..height {
            for u in 0..width {
                let true_distance = masked.iter().map(|&(x, y)| squared([x as u32, y as u32], (u, v))).min();
                let (found, best) = (squared(near[v * width + u], (u, v)), true_distance.unwrap());
                if best <= ((radius - 1) * (radius - 1)) as i64 {
                    assert!((found as f64).sqrt() - (best as f64).sqrt() < 0.3, "{u} {v}");
                }
                assert!(found == i64::MAX || (best..=(radius * radius) as i64).contains(&found));
            }
        }
    }
}
