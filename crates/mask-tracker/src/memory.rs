//! What is remembered of a frame: its cells in 3-D, and its colours.

use nalgebra::{Isometry3, Vector3};
use rgbd_io::Mask;

use crate::appearance::{Band, Bin, FrameColors, Histogram};
use crate::distance::nearest;
use crate::grid::{Bounds, Camera, EMPTY_BOUNDS, Grid, Window, include};
use crate::math::Rigid;
use crate::surface::{extreme, smaller};
use crate::volume::Volume;
use crate::warp::Sample;

/// The object as last seen.
pub(crate) struct Memory {
    pub(crate) samples: Vec<Sample>,
    /// Pixels per cell of the grid that the samples come from.
    pub(crate) step: usize,
    /// Space around the object, once there is a pose.
    pub(crate) volume: Option<Volume>,
    pub(crate) cam_from_obj: Option<Isometry3<f64>>,
    /// Camera-frame translation of the last step, metres.
    pub(crate) velocity: Vector3<f32>,
    /// Frames since the object was last seen.
    pub(crate) missing: u32,
    /// No frame has followed the first one yet.
    pub(crate) fresh: bool,
}

pub(crate) fn mask_bounds(mask: &Mask) -> Option<Bounds> {
    let mut b = EMPTY_BOUNDS;
    for y in 0..mask.height() {
        for (x, _) in mask.row(y).iter().enumerate().filter(|(_, m)| **m != 0) {
            include(&mut b, x as f32, y as f32);
        }
    }
    (b[0] <= b[2]).then_some(b)
}

/// Cells of which at least half is mask.
pub(crate) fn mask_cells(mask: &Mask, window: &Window) -> Vec<bool> {
    let mut labels = Vec::with_capacity(window.len());
    for cy in 0..window.h {
        for cx in 0..window.w {
            let (mut inside, mut count) = (0, 0);
            for y in 0..window.step {
                for x in 0..window.step {
                    if let Some(&m) =
                        mask.get(window.x0 + cx * window.step + x, window.y0 + cy * window.step + y)
                    {
                        count += 1;
                        inside += usize::from(m != 0);
                    }
                }
            }
            labels.push(2 * inside >= count && inside > 0);
        }
    }
    labels
}

/// Background this much nearer or farther than the object (metres) is near it.
const NEAR: f32 = 0.08;

/// Which background each cell would belong to: `reference` is the depth of the object next to it.
pub(crate) fn band(z: f32, reference: f32) -> Band {
    if z > 0.0 && reference > 0.0 && (z - reference).abs() < NEAR { Band::Near } else { Band::Far }
}

/// Depth of the object next to each cell, 0 where it has none.
pub(crate) fn object_depth(grid: &Grid, labels: &[bool]) -> Vec<f32> {
    let object = nearest(grid.window.w, grid.window.h, |i| labels[i] && grid.depth[i] > 0.0);
    object.seed.iter().map(|&seed| grid.depth.get(seed as usize).copied().unwrap_or(0.0)).collect()
}

/// Takes cells off the outline that lie much farther than the object inside of it, or, on parts so thin that they are
/// all outline, than the part itself: masks are a pixel or two off, and one cell of the wall that counts as object
/// would make the wall's depth plausible.
pub(crate) fn trim_outline(grid: &Grid, labels: &mut [bool]) {
    const OUTLINE: f32 = 2.5;
    let (w, h) = (grid.window.w, grid.window.h);
    let to_outside = nearest(w, h, |i| !labels[i]);
    let inner = nearest(w, h, |i| labels[i] && to_outside.distance[i] > OUTLINE && grid.depth[i] > 0.0);
    let object =
        (0..labels.len()).map(|i| if labels[i] && grid.depth[i] > 0.0 { grid.depth[i] } else { f32::MAX });
    let nearby = extreme(&object.collect::<Vec<_>>(), (w, h), OUTLINE as usize + 1, smaller);
    for i in (0..labels.len()).filter(|&i| to_outside.distance[i] <= OUTLINE) {
        let inside = grid.depth.get(inner.seed[i] as usize).filter(|_| inner.distance[i] <= 2.0 * OUTLINE);
        let reference = inside.copied().unwrap_or(nearby[i]);
        labels[i] = labels[i] && grid.depth[i] <= reference + NEAR;
    }
}

/// Colours of the object and of what surrounds it, from cells that `teaches` selects; those at the outline are mixed
/// and teach neither. `reference` is the depth of the object next to each cell.
pub(crate) fn frame_colors(
    grid: &Grid,
    colors: &[Bin],
    labels: &[bool],
    reference: &[f32],
    teaches: impl Fn(usize) -> bool,
) -> FrameColors {
    let (w, h) = (grid.window.w, grid.window.h);
    let nothing = Histogram::empty;
    let mut frame = FrameColors { object: nothing(), background: [nothing(), nothing()] };
    for y in 0..h {
        for x in 0..w {
            let i = y * w + x;
            let differs = |j: usize| labels[j] != labels[i];
            let on_outline = (x > 0 && differs(i - 1))
                || (x + 1 < w && differs(i + 1))
                || (y > 0 && differs(i - w))
                || (y + 1 < h && differs(i + w));
            if on_outline || !teaches(i) {
                continue;
            }
            if labels[i] {
                frame.object.count(colors[i]);
            } else {
                frame.background[band(grid.depth[i], reference[i]) as usize].count(colors[i]);
            }
        }
    }
    let FrameColors { object, background } = frame;
    FrameColors { object: object.normalised(), background: background.map(Histogram::normalised) }
}

/// Lifts every cell to 3-D; one without depth borrows it from the nearest cell of its side that has one. `reference`
/// is the depth of the object next to each cell.
pub(crate) fn lift(grid: &Grid, camera: &Camera, labels: &[bool], reference: &[f32]) -> Vec<Sample> {
    let (w, h) = (grid.window.w, grid.window.h);
    let background = nearest(w, h, |i| !labels[i] && grid.depth[i] > 0.0);
    let cells = grid.window.centers().enumerate();
    cells
        .map(|(i, (u, v))| {
            let z = if labels[i] {
                reference[i]
            } else {
                grid.depth.get(background.seed[i] as usize).copied().unwrap_or(0.0)
            };
            Sample {
                point: camera.unproject(u, v, if z > 0.0 { z } else { 1.0 }),
                color: grid.color(i),
                object: labels[i],
                measured: grid.depth[i] > 0.0,
                hidden: 0,
                trust: 1.0,
            }
        })
        .collect()
}

/// The moved sample and its cell, if something in front of it keeps it out of view.
pub(crate) fn still_hidden(
    s: &Sample,
    motion: &Rigid,
    (grid, camera, labels): (&Grid, &Camera, &[bool]),
    in_front: f32,
) -> Option<(Sample, usize)> {
    let p = motion.apply(s.point);
    let [u, v] = camera.project(p)?;
    let i = grid.window.index(grid.window.cell(u, v))?;
    let z = grid.depth[i];
    let covered = z > 0.0 && s.measured && z < p[2] - in_front;
    let unknown = z <= 0.0 && s.hidden > 0;
    let kept = Sample { point: p, hidden: s.hidden.saturating_add(1), ..*s };
    (!labels[i] && (covered || unknown)).then_some((kept, i))
}

pub(crate) fn center(samples: &[Sample]) -> Option<[f32; 3]> {
    let mut sum = [0.0f32; 3];
    let mut count = 0;
    for s in samples.iter().filter(|s| s.object) {
        (0..3).for_each(|k| sum[k] += s.point[k]);
        count += 1;
    }
    (count > 0).then(|| sum.map(|v| v / count as f32))
}
