//! From the working grid back to pixels.

use rgbd_io::{Image, Mask, RgbdFrame};

use crate::grid::{Grid, Window, opponent, sane_depth};

/// Cells around a pixel's own that vote on it: this many on each side.
const REACH: usize = 2;
const VOTERS: usize = (2 * REACH + 1) * (2 * REACH + 1);
/// Pixels that are decided together.
const LANES: usize = 4;

/// Brings labels to full resolution: cells away from the outline are copied, pixels next to it take the label of the
/// surrounding cells that they resemble in colour and depth (joint bilateral vote, Kopf et al. 2007).
pub(crate) fn upsample(frame: &RgbdFrame, grid: &Grid, labels: &[bool]) -> Mask {
    let (width, height) = frame.color.size();
    let mut mask = Image::filled(width, height, 0u8);
    decide(frame, grid, labels, &mut mask, |_| true);
    mask
}

/// Brings a mask that [`upsample`] made from the labels `before` up to date.
pub(crate) fn update(frame: &RgbdFrame, grid: &Grid, before: &[bool], labels: &[bool], mask: &mut Mask) {
    let Window { w, h, .. } = grid.window;
    // A pixel's vote depends on the labels within reach of its cell.
    let mut stale = vec![false; labels.len()];
    for i in (0..labels.len()).filter(|&i| labels[i] != before[i]) {
        let (x, y) = (i % w, i / w);
        for y in y.saturating_sub(REACH)..(y + REACH + 1).min(h) {
            stale[y * w + x.saturating_sub(REACH)..y * w + (x + REACH + 1).min(w)].fill(true);
        }
    }
    decide(frame, grid, labels, mask, |i| stale[i]);
}

/// Decides the pixels of the cells that are `stale`.
fn decide(frame: &RgbdFrame, grid: &Grid, labels: &[bool], mask: &mut Mask, stale: impl Fn(usize) -> bool) {
    let (width, height) = mask.size();
    let window = &grid.window;
    let (w, h, step) = (window.w, window.h, window.step);
    let groups = Group::all(step);
    for cy in 0..h {
        let rows = [cy.saturating_sub(1), cy, (cy + 1).min(h - 1)].map(|y| &labels[y * w..(y + 1) * w]);
        let y0 = window.y0 + cy * step;
        let y1 = (y0 + step).min(height);
        for cx in (0..w).filter(|cx| stale(cy * w + cx)) {
            let object = rows[1][cx];
            let (left, right) = (cx.saturating_sub(1), (cx + 1).min(w - 1));
            let uniform =
                rows.iter().all(|row| row[left] == object && row[cx] == object && row[right] == object);
            let x0 = window.x0 + cx * step;
            let x1 = (x0 + step).min(width);
            let value = if object && (uniform || step == 1) { 255 } else { 0 };
            (y0..y1).for_each(|y| (x0..x1).for_each(|x| mask[(x, y)] = value));
            if uniform || step == 1 {
                continue;
            }
            for group in &groups {
                group.decide(frame, grid, labels, (cx, cy), |x, y| mask[(x, y)] = 255);
            }
        }
    }
}

/// Some pixels of a cell, the same in every cell.
struct Group {
    /// Places in the cell; repeated where there are fewer pixels than lanes.
    pixels: [(usize, usize); LANES],
    used: usize,
    /// Weight of each voter by its distance.
    near: [[f32; LANES]; VOTERS],
}

impl Group {
    /// Groups of all pixels of a cell of `step` x `step`.
    fn all(step: usize) -> Vec<Self> {
        let pixels: Vec<(usize, usize)> = (0..step * step).map(|k| (k % step, k / step)).collect();
        pixels.chunks(LANES).map(|pixels| Self::new(pixels, step)).collect()
    }

    fn new(some: &[(usize, usize)], step: usize) -> Self {
        let last = some.last().copied().unwrap_or_default();
        let pixels = std::array::from_fn(|k| some.get(k).copied().unwrap_or(last));
        let side = 2 * REACH + 1;
        let near = std::array::from_fn(|voter| {
            pixels.map(|(x, y)| {
                let apart = |pixel: usize, cell: usize| {
                    (pixel as f32 + 0.5) / step as f32 - 0.5 - (cell as f32 - REACH as f32)
                };
                let d2 = apart(x, voter % side).powi(2) + apart(y, voter / side).powi(2);
                1.0 / (1.0 + d2 * d2)
            })
        });
        Self { pixels, used: some.len(), near }
    }

    fn decide(
        &self,
        frame: &RgbdFrame,
        grid: &Grid,
        labels: &[bool],
        (cx, cy): (usize, usize),
        mut object: impl FnMut(usize, usize),
    ) {
        const ALIKE: f32 = 200.0;
        const LEVEL: f32 = 0.012 * 0.012;
        let Window { x0, y0, step, w, h } = grid.window;
        let (width, height) = frame.color.size();
        let at = self.pixels.map(|(x, y)| (x0 + cx * step + x, y0 + cy * step + y));
        let inside = at.map(|(x, y)| x < width && y < height);
        let mut color = [[0.0f32; LANES]; 3];
        let mut depth = [0.0f32; LANES];
        for k in (0..LANES).filter(|&k| inside[k]) {
            let c = opponent(frame.color[at[k]].map(f32::from));
            (0..3).for_each(|axis| color[axis][k] = c[axis]);
            depth[k] = frame.depth.get(at[k].0, at[k].1).map_or(0.0, |&z| sane_depth(z));
        }
        let mut score = [0.0f32; LANES];
        for (row, near) in self.near.chunks(2 * REACH + 1).enumerate() {
            let y = cy + row;
            if y < REACH || y >= h + REACH {
                continue;
            }
            for (column, near) in near.iter().enumerate() {
                let x = cx + column;
                if x < REACH || x >= w + REACH {
                    continue;
                }
                let j = (y - REACH) * w + x - REACH;
                let (c, z) = (grid.color(j), grid.depth[j]);
                let sign = if labels[j] { 1.0 } else { -1.0 };
                for k in 0..LANES {
                    let d: [f32; 3] = std::array::from_fn(|axis| color[axis][k] - c[axis]);
                    let unlike = ALIKE + 0.4 * d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
                    let r = depth[k] - z;
                    // A depth that is missing on either side speaks half for both.
                    let apart = if depth[k] > 0.0 && z > 0.0 { LEVEL + r * r } else { 2.0 * LEVEL };
                    score[k] += sign * near[k] * (ALIKE * LEVEL) / (unlike * apart);
                }
            }
        }
        for k in (0..self.used).filter(|&k| inside[k] && score[k] > 0.0) {
            object(at[k].0, at[k].1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rgbd_io::Intrinsics;

    #[test]
    fn an_updated_mask_is_that_of_the_new_labels() {
        let inside = |x: usize, y: usize| (14..31).contains(&x) && (9..23).contains(&y);
        let frame = RgbdFrame {
            id: String::new(),
            color: Image::from_fn(
                47,
                33,
                |x, y| if inside(x, y) { [200, 30, (x * 3) as u8] } else { [90; 3] },
            ),
            depth: Image::from_fn(47, 33, |x, y| if inside(x, y) { 0.5 } else { 0.8 }),
            mask: None,
            intrinsics: Intrinsics { fx: 60.0, fy: 60.0, cx: 23.0, cy: 16.0 },
        };
        for step in [1, 2, 3] {
            let (w, h) = (47usize.div_ceil(step), 33usize.div_ceil(step));
            let grid = Grid::new(&frame, Window { x0: 0, y0: 0, step, w, h });
            let labels = |x0: usize, x1: usize| -> Vec<bool> {
                (0..w * h)
                    .map(|i| (x0..x1).contains(&(i % w * step)) && (9..23).contains(&(i / w * step)))
                    .collect()
            };
            let (before, after) = (labels(11, 31), labels(15, 36));
            let mut mask = upsample(&frame, &grid, &before);
            update(&frame, &grid, &before, &after, &mut mask);
            assert_eq!(mask, upsample(&frame, &grid, &after), "step {step}");
        }
    }
}
