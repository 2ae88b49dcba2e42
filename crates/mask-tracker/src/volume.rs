//! Space around the object, in the object's frame: where it is empty, and what was seen there.
//!
//! The object is rigid: a place in its frame that a camera has looked through is empty for good (space carving,
//! Kutulakos and Seitz 2000). Whatever shows up there later, a hand that shifts its grip for instance, is not the
//! object, however well it moves along and however much it looks like it.

use nalgebra::Isometry3;
use serde::{Deserialize, Serialize};

use crate::grid::{Camera, Grid, depth_noise};
use crate::math::Rigid;

/// Voxels along each side.
const SIDE: usize = 64;
/// Only every so many-th layer is carved in a frame, in turn.
const TURNS: usize = 4;
const MOST: u8 = 24;
/// Times that the first frame, whose labels are given, counts for.
const CERTAIN: u8 = 10;
/// Largest preference for a point where the object was seen.
pub(crate) const MOST_FOR_OBJECT: f32 = 2.5;
/// Preference of a point outside the cube, which is twice as large as the object looked: a rigid thing doesn't grow.
const TOO_FAR: f32 = -4.0;

#[derive(Clone, Copy, Default, Serialize, Deserialize)]
struct Voxel {
    /// Times it was looked through.
    free: u8,
    /// Times the object's surface was seen in it.
    object: u8,
    /// Times something else's surface was seen in it.
    other: u8,
}

/// A cube of voxels around the object.
#[derive(Clone, Serialize, Deserialize)]
pub(crate) struct Volume {
    corner: [f32; 3],
    voxel: f32,
    voxels: Vec<Voxel>,
    turn: usize,
}

impl Volume {
    /// A cube that holds an object of which the given points (object frame) were seen from `eye`; `None` without
    /// points.
    pub(crate) fn around(points: impl Iterator<Item = [f32; 3]>, eye: [f32; 3]) -> Option<Self> {
        // A few points may be the wall's, through a mask that is a pixel off: they must not widen the cube.
        let mut axes: [Vec<f32>; 3] = Default::default();
        for p in points {
            axes.iter_mut().zip(p).for_each(|(axis, v)| axis.push(v));
        }
        let outside = axes[0].len() * 3 / 100;
        axes.iter_mut().for_each(|axis| axis.sort_by(f32::total_cmp));
        let low = axes.each_ref().map(|axis| axis.get(outside).copied().unwrap_or(0.0));
        let high = axes.each_ref().map(|axis| axis.iter().rev().nth(outside).copied().unwrap_or(0.0));
        let size = (0..3).map(|k| high[k] - low[k]).fold(0.0f32, f32::max);
        if !(size > 1e-3 && size.is_finite()) {
            return None;
        }
        // The side that faces away isn't among the points.
        let center: [f32; 3] = std::array::from_fn(|k| 0.5 * (low[k] + high[k]));
        let away: [f32; 3] = std::array::from_fn(|k| center[k] - eye[k]);
        let norm = away.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-6);
        let half = 1.25 * size;
        let corner = std::array::from_fn(|k| center[k] + 0.3 * size * away[k] / norm - half);
        let voxels = vec![Voxel::default(); SIDE * SIDE * SIDE];
        Some(Self { corner, voxel: 2.0 * half / SIDE as f32, voxels, turn: 0 })
    }

    /// False for a damaged copy.
    pub(crate) fn is_whole(&self) -> bool {
        self.voxels.len() == SIDE * SIDE * SIDE && self.voxel > 0.0
    }

    /// The voxel at a place in voxels from the cube's corner.
    #[inline]
    fn index(v: [f32; 3]) -> Option<usize> {
        let inside = v.iter().all(|v| *v >= 0.0 && *v < SIDE as f32);
        inside.then(|| (v[0] as usize * SIDE + v[1] as usize) * SIDE + v[2] as usize)
    }

    /// What the voxels say of each cell's point, positive = object, about within +-3; 0 where
    /// nothing is known.
    pub(crate) fn testimony(&self, grid: &Grid, camera: &Camera, cam_from_obj: &Isometry3<f32>) -> Vec<f32> {
        let rays = Rays::new(self, camera, cam_from_obj);
        let cells = grid.window.centers().zip(&grid.depth);
        cells
            .map(|(center, &z)| {
                if z <= 0.0 {
                    return 0.0;
                }
                let Some(voxel) = Self::index(rays.at(center, z)).map(|k| self.voxels[k]) else {
                    return TOO_FAR;
                };
                let empty = f32::from(voxel.free) - 2.0 * f32::from(voxel.object);
                if empty > 1.0 {
                    return -(0.4 * empty).min(3.0);
                }
                (0.25 * (f32::from(voxel.object) - 1.5 * f32::from(voxel.other))).clamp(-1.0, MOST_FOR_OBJECT)
            })
            .collect()
    }

    /// Learns points (object frame) of the first frame, whose labels are certain: `true` = object.
    pub(crate) fn anchor(&mut self, points: impl Iterator<Item = ([f32; 3], bool)>) {
        for (p, object) in points {
            let place = std::array::from_fn(|k| (p[k] - self.corner[k]) / self.voxel);
            let Some(k) = Self::index(place) else { continue };
            let voxel = &mut self.voxels[k];
            if object { voxel.object = CERTAIN } else { voxel.other = CERTAIN }
        }
    }

    /// Learns from a frame whose pose and labels can be trusted.
    pub(crate) fn learn(
        &mut self,
        grid: &Grid,
        camera: &Camera,
        cam_from_obj: &Isometry3<f32>,
        labels: &[bool],
        sure: impl Fn(usize) -> bool,
    ) {
        self.carve(grid, camera, cam_from_obj);
        let rays = Rays::new(self, camera, cam_from_obj);
        for (i, (center, &z)) in grid.window.centers().zip(&grid.depth).enumerate() {
            if z <= 0.0 || !sure(i) {
                continue;
            }
            let Some(k) = Self::index(rays.at(center, z)) else { continue };
            let voxel = &mut self.voxels[k];
            if labels[i] {
                voxel.object = (voxel.object + 1).min(MOST);
                voxel.other = voxel.other.saturating_sub(1);
            } else {
                voxel.other = (voxel.other + 1).min(MOST);
            }
        }
    }

    /// Counts the voxels that the camera looks through.
    fn carve(&mut self, grid: &Grid, camera: &Camera, cam_from_obj: &Isometry3<f32>) {
        let window = &grid.window;
        let near = nearest_around(grid);
        let motion = Rigid::new(cam_from_obj);
        let step = motion.rotate([0.0, 0.0, self.voxel]);
        let slack = self.voxel + 0.004;
        let (w, h, scale) = (window.w as u32, window.h as u32, 1.0 / window.step as f32);
        // A place's column in the window is `(fx x + cx z) / z`, and likewise its row.
        let (cx, cy) = (camera.cx + 0.5 - window.x0 as f32, camera.cy + 0.5 - window.y0 as f32);
        self.turn = (self.turn + 1) % TURNS;
        for row in (0..SIDE * SIDE).filter(|row| row / SIDE % TURNS == self.turn) {
            let first = [(row / SIDE) as f32 + 0.5, (row % SIDE) as f32 + 0.5, 0.5];
            let p = motion.apply(std::array::from_fn(|k| self.corner[k] + first[k] * self.voxel));
            let mut cells = [u32::MAX; SIDE];
            let mut depths = [0.0f32; SIDE];
            for (c, (cell, depth)) in cells.iter_mut().zip(&mut depths).enumerate() {
                let [x, y, z]: [f32; 3] = std::array::from_fn(|k| p[k] + c as f32 * step[k]);
                let inverse = scale / z;
                let u = (camera.fx * x + cx * z) * inverse;
                let v = (camera.fy * y + cy * z) * inverse;
                let inside = z > 1e-3 && u >= 0.0 && v >= 0.0 && u < w as f32 && v < h as f32;
                // Below 2^24, so that the numbers are exact; else nothing is there.
                let (u, v) = (if inside { u } else { 0.0 }, if inside { v } else { 0.0 });
                let index = v as i32 * w as i32 + u as i32;
                *cell = if inside { index as u32 } else { u32::MAX };
                *depth = z + slack + 2.0 * depth_noise(z);
            }
            for (c, (cell, depth)) in cells.iter().zip(&depths).enumerate() {
                if near.get(*cell as usize).is_some_and(|near| near > depth) {
                    let voxel = &mut self.voxels[row * SIDE + c];
                    voxel.free = (voxel.free + 1).min(MOST);
                    voxel.object = voxel.object.saturating_sub(1);
                }
            }
        }
    }
}

/// Places of pixels in a volume, in voxels from its corner.
struct Rays {
    /// Of the camera's centre.
    eye: [f32; 3],
    /// For a depth of one: at pixel (0, 0), and a pixel further along each axis.
    origin: [f32; 3],
    along: [[f32; 3]; 2],
}

impl Rays {
    fn new(volume: &Volume, camera: &Camera, cam_from_obj: &Isometry3<f32>) -> Self {
        let obj_from_cam = Rigid::new(&cam_from_obj.inverse());
        let scaled = |p: [f32; 3]| p.map(|v| v / volume.voxel);
        let eye = obj_from_cam.apply([0.0; 3]);
        Self {
            eye: scaled(std::array::from_fn(|k| eye[k] - volume.corner[k])),
            origin: scaled(obj_from_cam.rotate(camera.unproject(0.0, 0.0, 1.0))),
            along: [[1.0 / camera.fx, 0.0, 0.0], [0.0, 1.0 / camera.fy, 0.0]]
                .map(|d| scaled(obj_from_cam.rotate(d))),
        }
    }

    #[inline]
    fn at(&self, (u, v): (f32, f32), z: f32) -> [f32; 3] {
        std::array::from_fn(|k| {
            self.eye[k] + z * (self.origin[k] + u * self.along[0][k] + v * self.along[1][k])
        })
    }
}

/// The nearest depth in the 3x3 neighbourhood of every cell, 0 where one of them has none: next to an outline an
/// error of the pose looks like a hole.
fn nearest_around(grid: &Grid) -> Vec<f32> {
    let (w, h) = (grid.window.w, grid.window.h);
    let least = |from: &[f32], stride: usize, first: usize, count: usize, out: &mut [f32]| {
        for k in 0..count {
            let i = first + k * stride;
            let before = if k > 0 { from[i - stride] } else { from[i] };
            let after = if k + 1 < count { from[i + stride] } else { from[i] };
            out[i] = from[i].min(before).min(after);
        }
    };
    let mut rows = vec![0.0; w * h];
    (0..h).for_each(|y| least(&grid.depth, 1, y * w, w, &mut rows));
    let mut near = vec![0.0; w * h];
    (0..w).for_each(|x| least(&rows, w, x, h, &mut near));
    near
}
