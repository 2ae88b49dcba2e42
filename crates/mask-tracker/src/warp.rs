//! The last frame carried to the current one: coloured points that move with the object.

use nalgebra::{Isometry3, Point3, Translation3};
use serde::{Deserialize, Serialize};

use crate::grid::{Bounds, Camera, Color, Grid, Window, color_distance2};
use crate::math::Rigid;

/// One cell of an earlier frame, lifted to the camera frame of the last one.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(crate) struct Sample {
    pub(crate) point: [f32; 3],
    pub(crate) color: Color,
    pub(crate) object: bool,
    /// The depth was measured, not borrowed from the nearest cell that has one.
    pub(crate) measured: bool,
    /// Frames since something else was last seen in front of this object point, 0 = visible.
    pub(crate) hidden: u16,
    /// 0..1: how long this point has been object and looked like it.
    pub(crate) trust: f32,
}

pub(crate) fn moved(p: [f32; 3], motion: &Isometry3<f32>) -> [f32; 3] {
    let q = motion * Point3::from(p);
    [q.x, q.y, q.z]
}

/// Image bounds of the moved object samples, `None` when none projects. One in a hundred on each side may lie outside:
/// a few stray samples must not widen the window, and with it coarsen the grid, for good.
pub(crate) fn bounds(samples: &[Sample], motion: &Isometry3<f32>, camera: &Camera) -> Option<Bounds> {
    /// Enough samples for the bounds.
    const ENOUGH: usize = 1500;
    let motion = Rigid::new(motion);
    let object = samples.iter().filter(|s| s.object);
    let stride = (object.clone().count() / ENOUGH).max(1);
    trimmed_bounds(object.step_by(stride).filter_map(|s| camera.project(motion.apply(s.point))))
}

/// Bounds of points, without the outermost hundredth on each side.
pub(crate) fn trimmed_bounds(points: impl Iterator<Item = [f32; 2]>) -> Option<Bounds> {
    let (mut us, mut vs): (Vec<f32>, Vec<f32>) =
        points.filter(|p| p[0].is_finite() && p[1].is_finite()).map(|p| (p[0], p[1])).unzip();
    let outside = us.len() / 100;
    let last = us.len().checked_sub(1 + outside)?;
    let at = |values: &mut Vec<f32>, k: usize| *values.select_nth_unstable_by(k, f32::total_cmp).1;
    Some([at(&mut us, outside), at(&mut vs, outside), at(&mut us, last), at(&mut vs, last)])
}

/// Samples drawn into a window.
pub(crate) struct Layer {
    /// Depth at the sample's new place, 0 where none fell.
    pub(crate) depth: Vec<f32>,
    source: Vec<u32>,
}

impl Layer {
    /// Draws the samples that `keep` selects as squares of `footprint` cells, nearest wins; gaps one cell wide are
    /// closed.
    pub(crate) fn draw(
        samples: &[Sample],
        keep: impl Fn(&Sample) -> bool,
        motion: &Isometry3<f32>,
        camera: &Camera,
        window: &Window,
        footprint: i32,
    ) -> Self {
        let motion = Rigid::new(motion);
        let mut layer = Self { depth: vec![0.0; window.len()], source: vec![u32::MAX; window.len()] };
        for (k, s) in samples.iter().enumerate().filter(|(_, s)| keep(s)) {
            let p = motion.apply(s.point);
            let Some([u, v]) = camera.project(p) else { continue };
            let (x, y) = window.cell(u, v);
            let (x0, y0) = (x - (footprint - 1) / 2, y - (footprint - 1) / 2);
            for cell in (y0..y0 + footprint).flat_map(|y| (x0..x0 + footprint).map(move |x| (x, y))) {
                let Some(i) = window.index(cell) else { continue };
                if layer.depth[i] == 0.0 || p[2] < layer.depth[i] {
                    layer.depth[i] = p[2];
                    layer.source[i] = k as u32;
                }
            }
        }
        layer.close_gaps(window);
        layer
    }

    fn close_gaps(&mut self, window: &Window) {
        let (w, h) = (window.w, window.h);
        let before = self.depth.clone();
        for y in 0..h {
            for x in 0..w {
                let i = y * w + x;
                if before[i] != 0.0 {
                    continue;
                }
                let across = x > 0 && x + 1 < w && before[i - 1] > 0.0 && before[i + 1] > 0.0;
                let along = y > 0 && y + 1 < h && before[i - w] > 0.0 && before[i + w] > 0.0;
                let source = if across {
                    i - 1
                } else if along {
                    i - w
                } else {
                    continue;
                };
                self.depth[i] = before[source];
                self.source[i] = self.source[source];
            }
        }
    }

    /// The sample drawn at cell `i`; `samples` are those that were drawn.
    #[inline]
    pub(crate) fn sample<'a>(&self, samples: &'a [Sample], i: usize) -> Option<&'a Sample> {
        samples.get(self.source[i] as usize)
    }
}

/// Similarity of a predicted and an observed colour, 0..1.
#[inline]
pub(crate) fn color_match(a: Color, b: Color) -> f32 {
    let d = color_distance2(a, b);
    500.0 / (500.0 + d)
}

/// Finds the translation (camera frame, metres) that brings the moved samples into agreement with the grid: an
/// exhaustive image shift within `radius` cells, then the median depth change, then a finer shift. With it comes the
/// remaining disagreement (about 0..1), infinite when there was nothing to align.
pub(crate) fn align(
    grid: &Grid,
    log_ratio: &[f32],
    samples: &[Sample],
    motion: &Isometry3<f32>,
    camera: &Camera,
    radius: i32,
) -> (Translation3<f32>, f32) {
    let visible = samples.iter().filter(|s| s.object && s.hidden == 0).count();
    let all = samples.iter().filter(|s| s.object).count();
    let use_hidden = visible * 3 < all;
    let count = if use_hidden { all } else { visible };
    if count == 0 {
        return (Translation3::identity(), f32::INFINITY);
    }
    let stride = count.div_ceil(260);
    let motion = Rigid::new(motion);
    let mut probes = Vec::with_capacity(300);
    let mut mean = [0.0f32; 3];
    for s in samples.iter().filter(|s| s.object && (use_hidden || s.hidden == 0)).step_by(stride) {
        let p = motion.apply(s.point);
        if let Some([u, v]) = camera.project(p) {
            let (x, y) = grid.window.cell(u, v);
            probes.push(Probe { x, y, z: if s.measured { p[2] } else { 0.0 }, color: s.color });
            mean = [mean[0] + u, mean[1] + v, mean[2] + p[2]];
        }
    }
    if probes.is_empty() {
        return (Translation3::identity(), f32::INFINITY);
    }
    let mean = mean.map(|m| m / probes.len() as f32);
    let highest = log_ratio.iter().copied().fold(0.0, f32::max);
    let cost = |shift: (i32, i32), dz: f32, lowest: f32| {
        let far = 0.002 * ((shift.0 * shift.0 + shift.1 * shift.1) as f32).sqrt();
        disagreement(grid, log_ratio, &probes, shift, dz, (lowest - far, highest)) + far
    };
    let mut best = (0, 0);
    let mut dz = 0.0;
    let mut lowest = f32::INFINITY;
    let passes = [(radius, if radius > 8 { 2 } else { 1 }), (2, 1), (1, 1)];
    for (range, step) in passes {
        let center = best;
        // The best so far comes first: the better the lowest cost, the sooner the others are given up.
        lowest = cost(center, dz, f32::INFINITY);
        for dy in (-range..=range).step_by(step) {
            for dx in (-range..=range).step_by(step) {
                let shift = (center.0 + dx, center.1 + dy);
                let cost = cost(shift, dz, lowest);
                if cost < lowest {
                    lowest = cost;
                    best = shift;
                }
            }
        }
        dz = median_depth_change(grid, &probes, best);
    }
    let pixels = grid.window.step as f32;
    (image_translation(camera, mean, [best.0 as f32 * pixels, best.1 as f32 * pixels], dz), lowest)
}

/// The camera-frame translation that moves what is seen at `[u, v, z]` by `shift` pixels and `dz` metres.
pub(crate) fn image_translation(
    camera: &Camera,
    [u, v, z]: [f32; 3],
    shift: [f32; 2],
    dz: f32,
) -> Translation3<f32> {
    let a = camera.unproject(u, v, z);
    let b = camera.unproject(u + shift[0], v + shift[1], z + dz);
    Translation3::new(b[0] - a[0], b[1] - a[1], b[2] - a[2])
}

struct Probe {
    x: i32,
    y: i32,
    z: f32,
    color: Color,
}

/// Mean disagreement of the probes, infinite once it is clear that it is larger than `limit`; no log-ratio is above
/// `highest`.
fn disagreement(
    grid: &Grid,
    log_ratio: &[f32],
    probes: &[Probe],
    shift: (i32, i32),
    dz: f32,
    (limit, highest): (f32, f32),
) -> f32 {
    // No probe's part is less.
    let least = -0.05 * highest;
    let n = probes.len() as f32;
    let mut sum = 0.0;
    for (block, some) in probes.chunks(32).enumerate() {
        let left = n - (block * 32) as f32;
        if sum + left * least > limit * n {
            return f32::INFINITY;
        }
        sum += some.iter().map(|p| difference(grid, log_ratio, p, shift, dz)).sum::<f32>();
    }
    sum / n
}

#[inline]
fn difference(grid: &Grid, log_ratio: &[f32], p: &Probe, shift: (i32, i32), dz: f32) -> f32 {
    let Some(i) = grid.window.index((p.x + shift.0, p.y + shift.1)) else { return 0.8 };
    let z = grid.depth[i];
    // Something came in front: no evidence for or against this shift, but worse than a match.
    if z > 0.0 && p.z > 0.0 && z < p.z + dz - 0.03 {
        return 0.35;
    }
    let color = 1.0 - color_match(p.color, grid.color(i));
    let depth = if z > 0.0 && p.z > 0.0 {
        let r = (z - p.z - dz).abs();
        r / (r + 0.015)
    } else {
        0.4
    };
    0.5 * color + 0.4 * depth - 0.05 * log_ratio[i]
}

fn median_depth_change(grid: &Grid, probes: &[Probe], shift: (i32, i32)) -> f32 {
    let mut changes: Vec<f32> = probes
        .iter()
        .filter_map(|p| {
            let z = grid.depth[grid.window.index((p.x + shift.0, p.y + shift.1))?];
            (z > 0.0 && p.z > 0.0 && (z - p.z).abs() < 0.06).then_some(z - p.z)
        })
        .collect();
    if changes.len() * 4 < probes.len() {
        return 0.0;
    }
    let middle = changes.len() / 2;
    *changes.select_nth_unstable_by(middle, f32::total_cmp).1
}
