//! From the working grid back to pixels.

use rgbd_io::{Image, Mask, RgbdFrame};

use crate::grid::{Grid, color_distance2, opponent, sane_depth};

/// The mask at full resolution: cells away from the outline are copied, pixels next to it take the label of the
/// surrounding cells that they resemble in colour and depth (joint bilateral vote, Kopf et al. 2007).
pub(crate) fn upsample(frame: &RgbdFrame, grid: &Grid, labels: &[bool]) -> Mask {
    let (width, height) = frame.color.size();
    let mut mask = Image::filled(width, height, 0u8);
    let window = &grid.window;
    let (w, h, step) = (window.w, window.h, window.step);
    for cy in 0..h {
        for cx in 0..w {
            let i = cy * w + cx;
            let uniform = neighbours(cx, cy, w, h, 1).all(|j| labels[j] == labels[i]);
            if uniform && !labels[i] {
                continue;
            }
            let y1 = (window.y0 + (cy + 1) * step).min(height);
            let x1 = (window.x0 + (cx + 1) * step).min(width);
            for y in window.y0 + cy * step..y1 {
                for x in window.x0 + cx * step..x1 {
                    let object = if uniform || step == 1 {
                        labels[i]
                    } else {
                        vote(frame, grid, labels, (x, y), (cx, cy))
                    };
                    if object {
                        mask[(x, y)] = 255;
                    }
                }
            }
        }
    }
    mask
}

fn neighbours(cx: usize, cy: usize, w: usize, h: usize, r: usize) -> impl Iterator<Item = usize> {
    let (x0, x1) = (cx.saturating_sub(r), (cx + r).min(w - 1));
    (cy.saturating_sub(r)..=(cy + r).min(h - 1)).flat_map(move |y| (x0..=x1).map(move |x| y * w + x))
}

fn vote(
    frame: &RgbdFrame,
    grid: &Grid,
    labels: &[bool],
    pixel: (usize, usize),
    cell: (usize, usize),
) -> bool {
    let window = &grid.window;
    let color = opponent(frame.color[pixel].map(f32::from));
    let z = frame.depth.get(pixel.0, pixel.1).map_or(0.0, |&z| sane_depth(z));
    let mut score = 0.0;
    for j in neighbours(cell.0, cell.1, window.w, window.h, 2) {
        let (u, v) = window.center(j);
        let (du, dv) = ((pixel.0 as f32 - u) / window.step as f32, (pixel.1 as f32 - v) / window.step as f32);
        let near = 1.0 / (1.0 + (du * du + dv * dv) * (du * du + dv * dv));
        let alike = 1.0 / (1.0 + color_distance2(color, grid.color[j]) / 200.0);
        let zj = grid.depth[j];
        let level = if z > 0.0 && zj > 0.0 {
            let r = (z - zj) / 0.012;
            1.0 / (1.0 + r * r)
        } else {
            0.5
        };
        let weight = near * alike * level;
        score += if labels[j] { weight } else { -weight };
    }
    score > 0.0
}
