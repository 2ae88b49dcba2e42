//! Fusing one view.

use super::{BLOCK, EMPTY, NO_COLOR, SIDE, TsdfVolume};
use crate::depth::interpolated;
use crate::rigid::{Rigid, add, dot, scale};
use nalgebra::Isometry3;
use rgbd_io::{Image, Intrinsics};

/// What one camera measured. The images have one size, which may be a crop that `intrinsics` describes.
#[derive(Clone, Copy, Debug)]
pub struct DepthView<'a> {
    /// z-depth in metres; only pixels of the object may have one, all others are 0.
    pub depth: &'a Image<f32>,
    /// Confidence of each pixel, not negative; pixels of confidence 0 are left out.
    pub weights: &'a Image<f32>,
    /// RGB colour.
    pub color: &'a Image<[u8; 3]>,
    /// The camera of these pixels.
    pub intrinsics: Intrinsics,
}

impl TsdfVolume {
    /// Fuses a view: blocks near the measured surface come to be, and every voxel in front of or near it is averaged.
    ///
    /// Distances are measured along the ray (KinectFusion eq. 6-9). Voxels behind the surface by more than the
    /// truncation, or on rays without depth, stay as they are. Nothing happens when the sizes differ, or the camera or
    /// the pose are not finite.
    pub fn integrate(&mut self, view: &DepthView<'_>, cam_from_obj: &Isometry3<f64>) {
        let sizes_agree = view.depth.size() == view.weights.size() && view.depth.size() == view.color.size();
        let finite = cam_from_obj.to_homogeneous().iter().all(|v| v.is_finite());
        if self.half == 0 || !sizes_agree || !finite || !view.intrinsics.is_valid() {
            return;
        }
        self.allocate(view, &cam_from_obj.inverse());
        let pose = Rigid::new(cam_from_obj);
        for block in 0..self.coords.len() {
            self.update(block, view, &pose);
        }
    }

    /// Makes the blocks that the truncation band around the measured surface touches.
    fn allocate(&mut self, view: &DepthView<'_>, obj_from_cam: &Isometry3<f64>) {
        let pose = Rigid::new(obj_from_cam);
        let k = &view.intrinsics;
        let edge = self.options.voxel_m * SIDE as f32;
        let (reach, inverse_edge) = (self.options.truncation_m, 1.0 / edge);
        let samples = (2.0 * reach / (0.4 * edge)).ceil().clamp(2.0, 64.0) as usize;
        let mut last = [i32::MAX; 3];
        for y in 0..view.depth.height() {
            for (x, (&z, &w)) in view.depth.row(y).iter().zip(view.weights.row(y)).enumerate() {
                if !(z > 0.0 && z.is_finite() && w > 0.0) {
                    continue;
                }
                let ray = [((x as f64 - k.cx) / k.fx) as f32, ((y as f64 - k.cy) / k.fy) as f32, 1.0];
                let band = reach / dot(ray, ray).sqrt();
                let (start, step) = (
                    pose.point(scale(ray, z - band)),
                    pose.direction(scale(ray, 2.0 * band / samples as f32)),
                );
                for i in 0..=samples {
                    let p = add(start, scale(step, i as f32));
                    // A block has the voxels whose centres it holds: half a voxel more towards the origin's side.
                    let b = p.map(|v| ((v + 0.5 * self.options.voxel_m) * inverse_edge).floor() as i32);
                    if b != last {
                        last = b;
                        self.make_block(b);
                    }
                }
            }
        }
    }

    fn make_block(&mut self, coord: [i32; 3]) {
        let Some(index) = self.table_index(coord) else { return };
        if self.table[index] != EMPTY || self.coords.len() >= self.options.max_blocks {
            return;
        }
        self.table[index] = self.coords.len() as u32;
        self.coords.push(coord);
        self.distance.resize(self.coords.len() * BLOCK, 0.0);
        self.weight.resize(self.coords.len() * BLOCK, 0.0);
        self.color.resize(self.coords.len() * BLOCK, NO_COLOR);
    }

    fn update(&mut self, block: usize, view: &DepthView<'_>, pose: &Rigid) {
        let k = &view.intrinsics;
        let (fx, fy, cx, cy) = (k.fx as f32, k.fy as f32, k.cx as f32, k.cy as f32);
        let (width, height) = (view.depth.width() as f32, view.depth.height() as f32);
        let voxel = self.options.voxel_m;
        let corner = pose.point(self.coords[block].map(|c| (c * SIDE) as f32 * voxel));
        let axes = [[voxel, 0.0, 0.0], [0.0, voxel, 0.0], [0.0, 0.0, voxel]].map(|a| pose.direction(a));
        let middle = axes.iter().fold(corner, |p, &a| add(p, scale(a, 3.5)));
        // The ball around the block may reach into the image.
        let radius = 6.1 * voxel;
        let near = (middle[2] - radius).max(1e-3);
        let (u, v) = (fx * middle[0] / middle[2] + cx, fy * middle[1] / middle[2] + cy);
        let (margin_u, margin_v) = (2.0 * fx * radius / near + 1.0, 2.0 * fy * radius / near + 1.0);
        let reaches = u > -margin_u && v > -margin_v && u < width + margin_u && v < height + margin_v;
        if middle[2] <= radius || !reaches {
            return;
        }
        for row in 0..64 {
            let start = add(corner, add(scale(axes[1], (row & 7) as f32), scale(axes[2], (row >> 3) as f32)));
            for x in 0..8 {
                let p = add(start, scale(axes[0], x as f32));
                let inverse_z = 1.0 / p[2];
                let (u, v) = (fx * p[0] * inverse_z + cx, fy * p[1] * inverse_z + cy);
                // Also false for NaN.
                if u >= -0.5 && v >= -0.5 && u < width - 0.5 && v < height - 0.5 && p[2] > 0.0 {
                    self.fuse(block * BLOCK + row * 8 + x, view, p, [u, v]);
                }
            }
        }
    }

    /// Averages what the view says at `[u, v]` into the voxel in `slot`, which lies at `p` of the camera's frame.
    #[inline]
    fn fuse(&mut self, slot: usize, view: &DepthView<'_>, p: [f32; 3], [u, v]: [f32; 2]) {
        let pixel = (v + 0.5) as usize * view.depth.width() + (u + 0.5) as usize;
        let (nearest, weight) = (view.depth.pixels()[pixel], view.weights.pixels()[pixel]);
        // Also false for NaN.
        let usable = nearest > 0.0 && weight > 0.0 && weight.is_finite();
        if !usable {
            return;
        }
        let reach = self.options.truncation_m;
        // Far in front, interpolation would change nothing.
        let z = if nearest - p[2] > 2.0 * reach {
            nearest
        } else {
            interpolated(view.depth, u, v, &view.intrinsics).map_or(nearest, |d| d[0])
        };
        let along_ray = (dot(p, p).sqrt()) / p[2];
        let distance = (z - p[2]) * along_ray;
        if distance <= -reach {
            return;
        }
        let old = self.weight[slot];
        let share = weight / (old + weight);
        let mean = &mut self.distance[slot];
        *mean += share * (distance.min(reach) - *mean);
        if distance < reach {
            let rgb = view.color.pixels()[pixel];
            let mean = &mut self.color[slot];
            let share = if *mean == NO_COLOR { 1.0 } else { share };
            for c in 0..3 {
                mean[c] += share * (f32::from(rgb[c]) - mean[c]);
            }
        }
        self.weight[slot] = (old + weight).min(self.options.max_weight);
    }
}
