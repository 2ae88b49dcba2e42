//! The first mask from a box or a few points.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use rgbd_io::{Mask, RgbdFrame};

use crate::appearance::{Appearance, bin};
use crate::cut::{Edges, cut};
use crate::grid::{Bounds, EMPTY_BOUNDS, Grid, Window, color_distance2, depth_noise, include};
use crate::memory::{band, frame_colors, object_depth};
use crate::upsample::upsample;

/// What a person says about the object; pixels of the colour image.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Hints {
    /// A box around the object, `[x, y, width, height]`: everything outside is background.
    pub rectangle: Option<[f32; 4]>,
    /// Points on the object.
    pub object: Vec<[f32; 2]>,
    /// Points beside it.
    pub background: Vec<[f32; 2]>,
}

/// Cells of the grids, at most.
const CELLS: usize = 32_000;
const SMOOTHNESS: f32 = 2.5;
const ROUNDS: usize = 6;
/// Preference of a cell that a hint settles.
const CERTAIN: f32 = 30.0;
/// Metres that crossing a clear colour edge is worth.
const CROSSING: f32 = 0.04;
/// Points reach surface this far away along it (metres).
const REACH: f32 = 0.2;

/// The object's mask in a frame: the cut between what is inside the box and what surrounds it, by colour and depth,
/// with models of both that are learnt from the last cut (Rother et al., GrabCut, 2004; here with depth).
///
/// Without a box the region that is connected with the object's points takes its place: along the surface, nearer to
/// them than to the background's points. `None` when nothing is found, or without a hint that lies in the image.
pub fn first_mask(frame: &RgbdFrame, hints: &Hints) -> Option<Mask> {
    let size = frame.color.size();
    let region = Region::grow(frame, hints)?;
    let rectangle = match hints.rectangle {
        Some([x, y, w, h]) => [x, y, x + w - 1.0, y + h - 1.0],
        None => region.bounds()?,
    };
    let longer = (rectangle[2] - rectangle[0]).max(rectangle[3] - rectangle[1]);
    if !(longer >= 4.0 && longer.is_finite()) {
        return None;
    }
    let window = Window::around(rectangle, 8.0 + 0.25 * longer, size, CELLS)?;
    let grid = Grid::new(frame, window);
    let fixed = fixed_cells(&grid, rectangle, hints);
    let place: Vec<f32> = if hints.object.is_empty() {
        enclosed(frame, &grid, rectangle, &fixed)
    } else {
        (0..window.len()).map(|i| region.place(window.center(i))).collect()
    };
    let mut labels: Vec<bool> =
        (0..window.len()).map(|i| fixed[i] > 0.0 || (fixed[i] == 0.0 && place[i] > 0.0)).collect();
    let edges = Edges::new(&grid, SMOOTHNESS);
    for _ in 0..ROUNDS {
        let evidence = evidence(&grid, &labels);
        let total: Vec<f32> = (0..window.len())
            .map(|i| if fixed[i] == 0.0 { evidence[i] + 0.5 * place[i] } else { fixed[i] })
            .collect();
        let next = cut(&edges, &total);
        if next == labels || !next.contains(&true) {
            break;
        }
        labels = next;
    }
    keep_large(&mut labels, window.w);
    let mask = upsample(frame, &grid, &labels);
    (mask.pixels().iter().filter(|m| **m != 0).count() >= 16).then_some(mask)
}

/// The middle of the box is object more often than its corners.
fn middle(rectangle: Bounds, u: f32, v: f32) -> f32 {
    let (u0, v0) = (0.5 * (rectangle[0] + rectangle[2]), 0.5 * (rectangle[1] + rectangle[3]));
    let (ru, rv) = (0.5 * (rectangle[2] - rectangle[0]) + 1.0, 0.5 * (rectangle[3] - rectangle[1]) + 1.0);
    0.6 - 1.2 * (((u - u0) / ru).powi(2) + ((v - v0) / rv).powi(2)).min(2.0)
}

/// Preference by the way from outside the box, along the surface: short for what reaches into the box, as a hand
/// does, long for what the box encloses. The threshold parts the ways best (Otsu 1979).
fn enclosed(frame: &RgbdFrame, grid: &Grid, rectangle: Bounds, fixed: &[f32]) -> Vec<f32> {
    let outside: Vec<usize> = (0..fixed.len()).filter(|&i| fixed[i] < 0.0).collect();
    let farthest = 0.3;
    let way = distances(grid, &outside, focal(frame), farthest, CROSSING);
    let way: Vec<f32> = way.into_iter().map(|d| d.min(farthest).sqrt()).collect();
    let mut sorted: Vec<f32> = (0..way.len()).filter(|&i| fixed[i] >= 0.0).map(|i| way[i]).collect();
    sorted.sort_by(f32::total_cmp);
    let threshold = otsu(&sorted);
    let preference = |i: usize| {
        let (u, v) = grid.window.center(i);
        ((way[i] - threshold) / 0.1).clamp(-1.5, 1.5) + 0.5 * middle(rectangle, u, v)
    };
    (0..way.len()).map(preference).collect()
}

/// The threshold with the largest variance between the two classes of sorted values.
fn otsu(sorted: &[f32]) -> f32 {
    let total: f32 = sorted.iter().sum();
    let n = sorted.len() as f32;
    let (mut below, mut best) = (0.0, (0.0, 0.0));
    for (k, v) in sorted.iter().enumerate() {
        below += v;
        let (a, b) = ((k + 1) as f32, n - (k + 1) as f32);
        if b > 0.0 {
            let between = a * b * (below / a - (total - below) / b).powi(2);
            if between > best.0 {
                best = (between, *v);
            }
        }
    }
    best.1
}

fn focal(frame: &RgbdFrame) -> f32 {
    if frame.intrinsics.is_valid() { frame.intrinsics.fx as f32 } else { frame.color.width() as f32 }
}

/// What the hints settle: positive = object, 0 = open.
fn fixed_cells(grid: &Grid, rectangle: Bounds, hints: &Hints) -> Vec<f32> {
    let window = &grid.window;
    let mut fixed: Vec<f32> = (0..window.len())
        .map(|i| {
            let (u, v) = window.center(i);
            let inside =
                (rectangle[0]..=rectangle[2]).contains(&u) && (rectangle[1]..=rectangle[3]).contains(&v);
            if inside { 0.0 } else { -CERTAIN }
        })
        .collect();
    for (points, certain) in [(&hints.object, CERTAIN), (&hints.background, -CERTAIN)] {
        for [u, v] in points {
            let (x, y) = window.cell(*u, *v);
            for cell in (y - 1..=y + 1).flat_map(|y| (x - 1..=x + 1).map(move |x| (x, y))) {
                if let Some(i) = window.index(cell) {
                    fixed[i] = certain;
                }
            }
        }
    }
    fixed
}

/// Log-likelihood ratios of colour and depth under the models of the last labels. Colours are compared with the
/// background at the same distance: the hand that holds the object, or what it stands on.
fn evidence(grid: &Grid, labels: &[bool]) -> Vec<f32> {
    const DEPTH_FLOOR: f32 = 2e-3;
    let reference = object_depth(grid, labels);
    let bins: Vec<_> = grid.colors().map(bin).collect();
    let appearance = Appearance::start(frame_colors(grid, &bins, labels, &reference, |_| true));
    let depths = [false, true].map(|object| depth_density(grid, |i| labels[i] == object));
    (0..labels.len())
        .map(|i| {
            let color = appearance.log_ratio(bins[i], band(grid.depth[i], reference[i]));
            let depth = depth_bin(grid.depth[i]).map_or(0.0, |bin| {
                let density = |k: usize| depths[k].get(bin).copied().unwrap_or(0.0) + DEPTH_FLOOR;
                (density(1) / density(0)).ln().clamp(-3.0, 3.0)
            });
            color + 0.6 * depth
        })
        .collect()
}

/// Bins of 1 % of the depth: the sensor's noise grows with it.
fn depth_bin(z: f32) -> Option<usize> {
    (z > 0.05).then(|| ((z / 0.05).ln() / 0.01) as usize)
}

fn depth_density(grid: &Grid, of: impl Fn(usize) -> bool) -> Vec<f32> {
    let mut density = vec![0.0f32; 800];
    let mut count = 0.0;
    for bin in (0..grid.depth.len()).filter(|&i| of(i)).filter_map(|i| depth_bin(grid.depth[i])) {
        // A triangle over five bins.
        for (k, weight) in [1.0, 2.0, 3.0, 2.0, 1.0].into_iter().enumerate() {
            if let Some(d) = (bin + k).checked_sub(2).and_then(|b| density.get_mut(b)) {
                *d += weight / 9.0;
            }
        }
        count += 1.0;
    }
    density.iter_mut().for_each(|d| *d /= f32::max(count, 1.0));
    density
}

/// Drops pieces of less than a fiftieth of the largest.
fn keep_large(labels: &mut [bool], w: usize) {
    let mut piece = vec![usize::MAX; labels.len()];
    let mut sizes = Vec::new();
    for start in 0..labels.len() {
        if !labels[start] || piece[start] != usize::MAX {
            continue;
        }
        let mut stack = vec![start];
        piece[start] = sizes.len();
        let mut size = 0;
        while let Some(i) = stack.pop() {
            size += 1;
            let (left, right) = ((i % w > 0).then(|| i - 1), ((i + 1) % w > 0).then_some(i + 1));
            for j in [left, right, i.checked_sub(w), Some(i + w)].into_iter().flatten() {
                if j < labels.len() && labels[j] && piece[j] == usize::MAX {
                    piece[j] = sizes.len();
                    stack.push(j);
                }
            }
        }
        sizes.push(size);
    }
    let largest = sizes.iter().copied().max().unwrap_or(0);
    for (label, &p) in labels.iter_mut().zip(&piece) {
        *label = *label && sizes[p] * 50 >= largest;
    }
}

/// How far every place is from the object's points and from the background, along the surface.
struct Region {
    window: Window,
    object: Vec<f32>,
    background: Vec<f32>,
}

impl Region {
    fn grow(frame: &RgbdFrame, hints: &Hints) -> Option<Self> {
        let (width, height) = frame.color.size();
        let window = Window::around([0.0, 0.0, width as f32, height as f32], 0.0, (width, height), CELLS)?;
        if hints.object.is_empty() {
            return Some(Self { window, object: Vec::new(), background: Vec::new() });
        }
        let grid = Grid::new(frame, window);
        let cells = |points: &[[f32; 2]]| -> Vec<usize> {
            points.iter().filter_map(|[u, v]| window.index(window.cell(*u, *v))).collect()
        };
        let focal = focal(frame);
        // What reaches the edge of the image is background: the table, the wall, an arm.
        let on_edge = |i: &usize| {
            let (x, y) = (i % window.w, i / window.w);
            x == 0 || y == 0 || x + 1 == window.w || y + 1 == window.h
        };
        let edge: Vec<usize> = (0..window.len()).filter(on_edge).collect();
        let background = [cells(&hints.background), edge].concat();
        Some(Self {
            window,
            object: distances(&grid, &cells(&hints.object), focal, REACH, 0.0),
            background: distances(&grid, &background, focal, 5.0 * REACH, 0.0),
        })
    }

    fn inside(&self, i: usize) -> bool {
        self.object[i] < REACH && self.object[i] < self.background[i]
    }

    fn bounds(&self) -> Option<Bounds> {
        let mut bounds = EMPTY_BOUNDS;
        for i in (0..self.object.len()).filter(|&i| self.inside(i)) {
            let (u, v) = self.window.center(i);
            include(&mut bounds, u, v);
        }
        let half = 2.0 + self.window.step as f32;
        (bounds[0] <= bounds[2])
            .then(|| [bounds[0] - half, bounds[1] - half, bounds[2] + half, bounds[3] + half])
    }

    /// Preference of a pixel by its distances, -1..1.
    fn place(&self, (u, v): (f32, f32)) -> f32 {
        let Some(i) = self.window.index(self.window.cell(u, v)) else { return -1.0 };
        if self.object[i] >= REACH {
            return -1.0;
        }
        ((self.background[i] - self.object[i]) / 0.04).clamp(-1.0, 1.0)
    }
}

/// Length (metres) of the shortest way from a seed to each cell along the surface; steps in depth are long ways, and
/// edges in colour are longer than they are.
fn distances(grid: &Grid, seeds: &[usize], focal: f32, reach: f32, crossing: f32) -> Vec<f32> {
    let window = &grid.window;
    let mut distance = vec![f32::INFINITY; window.len()];
    // Non-negative floats order like their bits.
    let mut queue = BinaryHeap::new();
    for &i in seeds {
        distance[i] = 0.0;
        queue.push(Reverse((0u32, i)));
    }
    while let Some(Reverse((bits, i))) = queue.pop() {
        let here = f32::from_bits(bits);
        if here > distance[i] || here > reach {
            continue;
        }
        let (x, y) = ((i % window.w) as i32, (i / window.w) as i32);
        for cell in [(x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)] {
            let Some(j) = window.index(cell) else { continue };
            let (a, b) = (grid.depth[i], grid.depth[j]);
            let z = if a > 0.0 { a } else { b };
            let width = window.step as f32 * if z > 0.0 { z } else { 0.7 } / focal;
            // A surface seen at a slant isn't a step.
            let step = if a > 0.0 && b > 0.0 {
                ((a - b).abs() - 2.0 * width - 2.0 * depth_noise(z)).max(0.0)
            } else {
                0.0
            };
            let edge = color_distance2(grid.color(i), grid.color(j)).sqrt() / 60.0;
            let next = here + width * (1.0 + edge.min(3.0)) + 20.0 * step + crossing * edge.min(2.0).powi(2);
            if next < distance[j] {
                distance[j] = next;
                queue.push(Reverse((next.to_bits(), j)));
            }
        }
    }
    distance
}
