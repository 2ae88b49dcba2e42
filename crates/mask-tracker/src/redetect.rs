//! Looking for a lost object in the whole image.

use nalgebra::{Isometry3, Translation3};
use rgbd_io::RgbdFrame;

use crate::appearance::{Appearance, bin};
use crate::grid::{Camera, Grid, Window};
use crate::warp::{Sample, color_match, image_translation, moved};

/// Cells of the search grid, at most.
const CELLS: usize = 7_000;
const PROBES: usize = 90;

/// The camera-frame translation that brings the remembered object to the place in the image that most resembles
/// it in colour and relief; `None` when no place is half as good as the object itself would be.
pub(crate) fn search(
    frame: &RgbdFrame,
    appearance: &Appearance,
    samples: &[Sample],
    motion: &Isometry3<f32>,
    camera: &Camera,
) -> Option<Translation3<f32>> {
    let (width, height) = frame.color.size();
    let all = [0.0, 0.0, width as f32 - 1.0, height as f32 - 1.0];
    let window = Window::around(all, 0.0, (width, height), CELLS)?;
    let grid = Grid::new(frame, window);
    let log_ratio: Vec<f32> = grid.colors().map(|c| appearance.log_ratio_anywhere(bin(c))).collect();
    let count = samples.iter().filter(|s| s.object).count();
    let mut probes = Vec::with_capacity(PROBES + 1);
    let mut mean = [0.0f32; 3];
    let (mut left, mut top, mut right, mut bottom) = (i32::MAX, i32::MAX, i32::MIN, i32::MIN);
    for s in samples.iter().filter(|s| s.object).step_by(count.div_ceil(PROBES).max(1)) {
        let p = moved(s.point, motion);
        let Some([u, v]) = camera.project(p) else { continue };
        let (x, y) = window.cell(u, v);
        (left, top, right, bottom) = (left.min(x), top.min(y), right.max(x), bottom.max(y));
        mean = [mean[0] + u, mean[1] + v, mean[2] + p[2]];
        probes.push((x, y, if s.measured { p[2] } else { 0.0 }, s.color));
    }
    if probes.is_empty() {
        return None;
    }
    let mean = mean.map(|m| m / probes.len() as f32);
    let (half_w, half_h) = ((right - left) / 2, (bottom - top) / 2);
    let mut best: Option<(f32, (i32, i32), f32)> = None;
    for dy in -(top + half_h)..(window.h as i32 - bottom + half_h) {
        for dx in -(left + half_w)..(window.w as i32 - right + half_w) {
            let center = window.index(((left + right) / 2 + dx, (top + bottom) / 2 + dy));
            if center.is_none_or(|i| log_ratio[i] < -2.5) {
                continue;
            }
            let (mut dz_sum, mut dz_count) = (0.0, 0);
            for &(x, y, z, _) in &probes {
                if let Some(i) = window.index((x + dx, y + dy))
                    && z > 0.0
                    && grid.depth[i] > 0.0
                    && log_ratio[i] > 0.0
                {
                    dz_sum += grid.depth[i] - z;
                    dz_count += 1;
                }
            }
            let dz = if dz_count > 0 { dz_sum / dz_count as f32 } else { 0.0 };
            let mut score = 0.0;
            for &(x, y, z, color) in &probes {
                let Some(i) = window.index((x + dx, y + dy)) else { continue };
                let relief = if z > 0.0 && grid.depth[i] > 0.0 {
                    let r = (grid.depth[i] - z - dz) / 0.02;
                    1.0 / (1.0 + r * r)
                } else {
                    0.4
                };
                let color =
                    0.5 * color_match(color, grid.color(i)) + 0.5 * (log_ratio[i] / 2.0).clamp(-0.5, 1.0);
                score += color * relief;
            }
            score /= probes.len() as f32;
            if best.is_none_or(|(s, _, _)| score > s) {
                best = Some((score, (dx, dy), dz));
            }
        }
    }
    let (score, (dx, dy), dz) = best?;
    let pixels = window.step as f32;
    (score > 0.3).then(|| image_translation(camera, mean, [dx as f32 * pixels, dy as f32 * pixels], dz))
}
