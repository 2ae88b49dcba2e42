//! Space around the object, in the object's frame: where it is empty, and what was seen there.
//!
//! The object is rigid: a place in its frame that a camera has looked through is empty for good (space carving,
//! Kutulakos and Seitz 2000). Whatever shows up there later, a hand that shifts its grip for instance, is not the
//! object, however well it moves along and however much it looks like it.

use nalgebra::{Isometry3, Point3};

use crate::grid::{Camera, Grid, depth_noise};

/// Voxels along each side.
const SIDE: usize = 64;
/// Only every so many-th layer is carved in a frame, in turn.
const TURNS: usize = 4;
const MOST: u8 = 24;

#[derive(Clone, Copy, Default)]
struct Voxel {
    /// Times it was looked through.
    free: u8,
    /// Times the object's surface was seen in it.
    object: u8,
    /// Times something else's surface was seen in it.
    other: u8,
}

/// A cube of voxels around the object.
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
        let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        for p in points {
            for k in 0..3 {
                low[k] = low[k].min(p[k]);
                high[k] = high[k].max(p[k]);
            }
        }
        let size = (0..3).map(|k| high[k] - low[k]).fold(0.0f32, f32::max);
        if !(size > 1e-3 && size.is_finite()) {
            return None;
        }
        // The side that faces away isn't among the points.
        let center: [f32; 3] = std::array::from_fn(|k| 0.5 * (low[k] + high[k]));
        let away: [f32; 3] = std::array::from_fn(|k| center[k] - eye[k]);
        let norm = away.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-6);
        let half = 1.2 * size;
        let corner = std::array::from_fn(|k| center[k] + 0.3 * size * away[k] / norm - half);
        let voxels = vec![Voxel::default(); SIDE * SIDE * SIDE];
        Some(Self { corner, voxel: 2.0 * half / SIDE as f32, voxels, turn: 0 })
    }

    fn index(&self, p: [f32; 3]) -> Option<usize> {
        let mut index = 0;
        for k in 0..3 {
            let v = (p[k] - self.corner[k]) / self.voxel;
            if !(v >= 0.0 && v < SIDE as f32) {
                return None;
            }
            index = index * SIDE + v as usize;
        }
        Some(index)
    }

    /// What the voxels say of each cell's point, positive = object, about within +-3; 0 where nothing is known.
    pub(crate) fn testimony(&self, grid: &Grid, camera: &Camera, cam_from_obj: &Isometry3<f32>) -> Vec<f32> {
        let obj_from_cam = cam_from_obj.inverse();
        (0..grid.window.len())
            .map(|i| {
                let z = grid.depth[i];
                if z <= 0.0 {
                    return 0.0;
                }
                let (u, v) = grid.window.center(i);
                let p = obj_from_cam * Point3::from(camera.unproject(u, v, z));
                let Some(voxel) = self.index([p.x, p.y, p.z]).map(|k| self.voxels[k]) else { return 0.0 };
                let empty = f32::from(voxel.free) - 2.0 * f32::from(voxel.object);
                if empty > 1.0 {
                    return -(0.4 * empty).min(3.0);
                }
                (0.25 * (f32::from(voxel.object) - 1.5 * f32::from(voxel.other))).clamp(-1.0, 1.0)
            })
            .collect()
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
        let obj_from_cam = cam_from_obj.inverse();
        for i in 0..grid.window.len() {
            let z = grid.depth[i];
            if z <= 0.0 || !sure(i) {
                continue;
            }
            let (u, v) = grid.window.center(i);
            let p = obj_from_cam * Point3::from(camera.unproject(u, v, z));
            let Some(k) = self.index([p.x, p.y, p.z]) else { continue };
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
        let near = nearest_around(grid);
        let rotation = cam_from_obj.rotation.to_rotation_matrix();
        let step = rotation.matrix() * self.voxel;
        self.turn = (self.turn + 1) % TURNS;
        for a in (self.turn..SIDE).step_by(TURNS) {
            for b in 0..SIDE {
                let first = [a as f32 + 0.5, b as f32 + 0.5, 0.5];
                let p: [f32; 3] = std::array::from_fn(|k| self.corner[k] + first[k] * self.voxel);
                let mut p = cam_from_obj * Point3::from(p);
                for c in 0..SIDE {
                    if let Some([u, v]) = camera.project([p.x, p.y, p.z])
                        && let Some(i) = grid.window.index(grid.window.cell(u, v))
                        && near[i] > p.z + self.voxel + 0.004 + 2.0 * depth_noise(p.z)
                    {
                        let voxel = &mut self.voxels[(a * SIDE + b) * SIDE + c];
                        voxel.free = (voxel.free + 1).min(MOST);
                        voxel.object = voxel.object.saturating_sub(1);
                    }
                    p += step.column(2);
                }
            }
        }
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
