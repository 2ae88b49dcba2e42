//! A z-buffered triangle rasteriser: which triangle each pixel centre sees, and at which exact depth.

use marching_cubes::TriMesh;
use nalgebra::{Isometry3, Point3};
use rayon::prelude::*;
use rgbd_io::Intrinsics;

/// Nothing nearer than this is drawn, metres.
const NEAR: f64 = 0.02;
/// Rows that one task draws.
const BAND: usize = 32;
/// Barycentric tolerance of a triangle's edges.
const SEAM: f64 = 1e-9;
/// A pixel that no triangle covers.
const NONE: u32 = u32::MAX;

/// A mesh somewhere in front of the camera.
#[derive(Clone, Copy)]
pub(crate) struct Placed<'a> {
    pub(crate) mesh: &'a TriMesh,
    pub(crate) cam_from_mesh: Isometry3<f64>,
    /// A closed surface, counter-clockwise from outside: its far side is left out, since no pixel sees it.
    pub(crate) closed: bool,
}

/// What the pixel centres see, in the smallest window that holds everything drawn; row-major.
pub(crate) struct Hits {
    /// First column and row of the window.
    pub(crate) corner: [usize; 2],
    /// Columns and rows of the window.
    pub(crate) size: [usize; 2],
    depth: Vec<f32>,
    triangle: Vec<u32>,
}

impl Hits {
    /// The z-depth (metres) of what pixel `(x, y)` sees and the number of its triangle, counted through all meshes;
    /// `None` where nothing was drawn.
    #[inline]
    pub(crate) fn at(&self, x: usize, y: usize) -> Option<(f32, u32)> {
        let (x, y) = (x.wrapping_sub(self.corner[0]), y.wrapping_sub(self.corner[1]));
        if x >= self.size[0] || y >= self.size[1] {
            return None;
        }
        let i = y * self.size[0] + x;
        (self.triangle[i] != NONE).then(|| (self.depth[i], self.triangle[i]))
    }
}

/// A vertex on the image plane: pixel, and inverse depth, which is linear there.
#[derive(Clone, Copy)]
struct Corner {
    x: f64,
    y: f64,
    w: f64,
}

/// A triangle on the image plane with the pixels that its box holds, both ends included.
struct Flat {
    corners: [Corner; 3],
    x: [u32; 2],
    y: [u32; 2],
    id: u32,
}

/// Draws `bodies` into a `width` x `height` image of the camera `k`, pixel centres at integers.
///
/// The result does not depend on the number of threads: of surfaces at equal depth the first drawn stays.
pub(crate) fn draw(k: &Intrinsics, width: usize, height: usize, bodies: &[Placed<'_>]) -> Hits {
    let flats = flatten(k, width, height, bodies);
    let Some((x, y)) = flats.iter().map(|f| (f.x, f.y)).reduce(|a, b| (join(a.0, b.0), join(a.1, b.1)))
    else {
        return Hits { corner: [0; 2], size: [0; 2], depth: Vec::new(), triangle: Vec::new() };
    };
    let corner = [x[0] as usize, y[0] as usize];
    let size = [(x[1] - x[0] + 1) as usize, (y[1] - y[0] + 1) as usize];
    // Which triangles touch which band of rows, in drawing order.
    let mut bands: Vec<Vec<u32>> = vec![Vec::new(); size[1].div_ceil(BAND)];
    for (i, flat) in flats.iter().enumerate() {
        let [first, last] = flat.y.map(|v| (v as usize - corner[1]) / BAND);
        bands[first..=last].iter_mut().for_each(|band| band.push(i as u32));
    }
    let mut depth = vec![f32::INFINITY; size[0] * size[1]];
    let mut triangle = vec![NONE; size[0] * size[1]];
    let chunk = size[0] * BAND;
    depth.par_chunks_mut(chunk).zip(triangle.par_chunks_mut(chunk)).zip(&bands).enumerate().for_each(
        |(band, ((z, id), members))| {
            let top = corner[1] + band * BAND;
            for &i in members {
                fill(&flats[i as usize], [corner[0], top], size[0], z, id);
            }
        },
    );
    Hits { corner, size, depth, triangle }
}

fn join(a: [u32; 2], b: [u32; 2]) -> [u32; 2] {
    [a[0].min(b[0]), a[1].max(b[1])]
}

/// Projects all triangles, cut at the near plane, and keeps those that can touch the image.
fn flatten(k: &Intrinsics, width: usize, height: usize, bodies: &[Placed<'_>]) -> Vec<Flat> {
    let mut flats = Vec::new();
    let mut id = 0u32;
    for body in bodies {
        let points: Vec<[f64; 3]> = body
            .mesh
            .vertices
            .iter()
            .map(|v| (body.cam_from_mesh * Point3::from(v.map(f64::from))).coords.into())
            .collect();
        let flat: Vec<Corner> = points.iter().map(|&p| project(k, p)).collect();
        for &[a, b, c] in &body.mesh.triangles {
            let of = |i: u32| points.get(i as usize).copied();
            if let (Some(p), Some(q), Some(r)) = (of(a), of(b), of(c)) {
                if p[2] >= NEAR && q[2] >= NEAR && r[2] >= NEAR {
                    let corners = [a, b, c].map(|i| flat[i as usize]);
                    flats.extend(boxed(corners, id, body.closed, width, height));
                } else {
                    let kept = clip([p, q, r]);
                    for i in 2..kept.len() {
                        let corners = [kept[0], kept[i - 1], kept[i]].map(|v| project(k, v));
                        flats.extend(boxed(corners, id, body.closed, width, height));
                    }
                }
            }
            id += 1;
        }
    }
    flats
}

fn project(k: &Intrinsics, p: [f64; 3]) -> Corner {
    let w = 1.0 / p[2];
    Corner { x: k.fx * p[0] * w + k.cx, y: k.fy * p[1] * w + k.cy, w }
}

/// The part of a triangle in front of the near plane: no, three or four corners.
fn clip(corners: [[f64; 3]; 3]) -> Vec<[f64; 3]> {
    let mut kept = Vec::with_capacity(4);
    for i in 0..3 {
        let (a, b) = (corners[i], corners[(i + 1) % 3]);
        if a[2] >= NEAR {
            kept.push(a);
        }
        if (a[2] >= NEAR) != (b[2] >= NEAR) {
            let t = (NEAR - a[2]) / (b[2] - a[2]);
            kept.push([a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), NEAR]);
        }
    }
    kept
}

/// The triangle with its box, unless it lies outside the image or between the pixel centres, as many of a fine mesh
/// do, or has no area, or looks away from the camera on a closed surface.
fn boxed(corners: [Corner; 3], id: u32, closed: bool, width: usize, height: usize) -> Option<Flat> {
    let [a, b, c] = corners;
    let area = (b.x - a.x) * (c.y - a.y) - (c.x - a.x) * (b.y - a.y);
    // Rows run downwards, so counter-clockwise is negative. Written so that a NaN fails it.
    let shown = area.abs() >= 1e-12 && (!closed || area < 0.0);
    if !shown {
        return None;
    }
    let x = pixels(corners.map(|c| c.x), width)?;
    let y = pixels(corners.map(|c| c.y), height)?;
    Some(Flat { corners, x, y, id })
}

/// First and last pixel centre between the smallest and the largest of `v`.
fn pixels(v: [f64; 3], limit: usize) -> Option<[u32; 2]> {
    let (low, high) = (v[0].min(v[1]).min(v[2]), v[0].max(v[1]).max(v[2]));
    let last = limit as f64 - 1.0;
    if !(low <= last && high >= 0.0) {
        return None;
    }
    // Casts truncate, which is the floor of what is left above zero.
    let (low, high) = (low.max(0.0), high.min(last) as u32);
    let first = low as u32 + u32::from(low.fract() > 0.0);
    (first <= high).then_some([first, high])
}

/// Draws one triangle into the rows from `corner` on that `depth` and `triangle` hold, `width` pixels each.
fn fill(t: &Flat, corner: [usize; 2], width: usize, depth: &mut [f32], triangle: &mut [u32]) {
    let rows = depth.len() / width;
    let [a, b, c] = t.corners;
    let scale = 1.0 / ((b.x - a.x) * (c.y - a.y) - (c.x - a.x) * (b.y - a.y));
    // Barycentric weight of the corner opposite to an edge: value at the box's first column, change along a row.
    let edge = |p: Corner, q: Corner, y: f64| {
        let step = (p.y - q.y) * scale;
        ((q.x - p.x) * scale * (y - p.y) + step * (f64::from(t.x[0]) - p.x), step)
    };
    let low = a.w.min(b.w).min(c.w);
    let high = a.w.max(b.w).max(c.w);
    let first = (t.y[0] as usize).max(corner[1]);
    let last = (t.y[1] as usize).min(corner[1] + rows - 1);
    for y in first..=last {
        let weights = [edge(b, c, y as f64), edge(c, a, y as f64), edge(a, b, y as f64)];
        let Some([from, to]) = span(weights, t.x[1] - t.x[0]) else { continue };
        let row = (y - corner[1]) * width + t.x[0] as usize - corner[0];
        for x in from..=to {
            let [p, q, r] = weights.map(|(start, step)| start + step * f64::from(x));
            // The tolerance closes the seam between two triangles whose common edge is rounded differently.
            if p >= -SEAM && q >= -SEAM && r >= -SEAM {
                let z = (1.0 / (p * a.w + q * b.w + r * c.w).clamp(low, high)) as f32;
                let i = row + x as usize;
                if z < depth[i] {
                    depth[i] = z;
                    triangle[i] = t.id;
                }
            }
        }
    }
}

/// The columns of a row, counted from the box's first, between which all three weights can be positive; up to a
/// pixel too many on either side.
fn span(weights: [(f64, f64); 3], last: u32) -> Option<[u32; 2]> {
    let (mut from, mut to) = (0.0f64, f64::from(last));
    if last > 3 {
        for (start, step) in weights {
            let zero = -start / step;
            if step > 0.0 {
                from = from.max(zero - 1.0);
            } else if step < 0.0 {
                to = to.min(zero + 1.0);
            } else if start < -SEAM {
                return None;
            }
        }
    }
    (from <= to).then_some([from as u32, to as u32])
}
