//! The surface as a camera would see it.

use super::{SIDE, TsdfVolume};
use crate::point_map::{MISSING, PointMap};
use crate::rigid::{Rigid, add, dot, scale, unit};
use nalgebra::Isometry3;
use rgbd_io::Intrinsics;

/// What happened to a ray.
enum Hit {
    Surface(f32),
    Nothing,
}

impl TsdfVolume {
    /// Points and normals, **in the object's frame**, of the surface that the pixels of a camera see (KinectFusion
    /// section 3.4): the first change from outside to inside along each ray, and the gradient there.
    pub fn raycast(
        &self,
        cam_from_obj: &Isometry3<f64>,
        intrinsics: &Intrinsics,
        width: usize,
        height: usize,
    ) -> PointMap {
        let count = width * height;
        let mut map = PointMap {
            width,
            height,
            intrinsics: *intrinsics,
            points: vec![MISSING; count],
            normals: vec![MISSING; count],
        };
        let Some(bounds) = self.bounds() else { return map };
        if !intrinsics.is_valid() {
            return map;
        }
        let obj_from_cam = cam_from_obj.inverse();
        let pose = Rigid::new(&obj_from_cam);
        let eye = pose.point([0.0; 3]);
        for y in 0..height {
            for x in 0..width {
                let ray = intrinsics.unproject(x as f64, y as f64, 1.0).map(|v| v as f32);
                let Some(direction) = unit(pose.direction(ray)) else { continue };
                let Some((from, to)) = inside_box(eye, direction, &bounds) else { continue };
                let Hit::Surface(t) = self.march(eye, direction, from, to) else { continue };
                let p = add(eye, scale(direction, t));
                map.points[y * width + x] = p;
                let normal = self.gradient(p).and_then(unit);
                if let Some(n) = normal.filter(|n| dot(*n, direction) < 0.0) {
                    map.normals[y * width + x] = n;
                }
            }
        }
        map
    }

    /// Corners of the box around all blocks, metres; `None` without blocks.
    fn bounds(&self) -> Option<[[f32; 3]; 2]> {
        let first = *self.coords.first()?;
        let (low, high) = self.coords.iter().fold((first, first), |(low, high), c| {
            (std::array::from_fn(|a| low[a].min(c[a])), std::array::from_fn(|a| high[a].max(c[a])))
        });
        let edge = self.options.voxel_m * SIDE as f32;
        Some([low.map(|c| c as f32 * edge), high.map(|c| (c + 1) as f32 * edge)])
    }

    /// Steps along the ray by as much as is known to be empty.
    fn march(&self, eye: [f32; 3], direction: [f32; 3], from: f32, to: f32) -> Hit {
        let voxel = self.options.voxel_m;
        let mut t = from;
        // Where the ray last was outside, and by how much.
        let mut outside: Option<(f32, f32)> = None;
        let mut is_inside = false;
        while t < to {
            let p = add(eye, scale(direction, t));
            let c = p.map(|v| (v * self.inverse_voxel + 0.5).floor() as i32);
            let Some(slot) = self.slot(c) else {
                t += self.to_block_end(p, direction, c);
                outside = None;
                continue;
            };
            if self.weight[slot] <= 0.0 {
                outside = None;
                t += voxel;
                continue;
            }
            let nearest = self.distance[slot];
            if nearest > 2.0 * voxel {
                if is_inside {
                    return Hit::Nothing;
                }
                outside = Some((t, nearest));
                // Distances along slanted rays are too long, so don't trust them whole.
                t += (0.6 * nearest).max(voxel);
                continue;
            }
            match self.sample(p) {
                Some(d) if d > 0.0 => {
                    // From inside to outside: this is a back face, its front was never seen.
                    if is_inside {
                        return Hit::Nothing;
                    }
                    outside = Some((t, d));
                    t += (0.6 * d).max(0.25 * voxel);
                }
                Some(d) => {
                    if let Some(before) = outside {
                        return Hit::Surface(self.crossing(eye, direction, before, (t, d)));
                    }
                    is_inside = true;
                    t += 0.5 * voxel;
                }
                None => {
                    outside = None;
                    t += 0.5 * voxel;
                }
            }
        }
        Hit::Nothing
    }

    /// Zero between a place outside and one inside, by the secant rule.
    fn crossing(
        &self,
        eye: [f32; 3],
        direction: [f32; 3],
        mut outside: (f32, f32),
        mut inside: (f32, f32),
    ) -> f32 {
        let zero = |a: (f32, f32), b: (f32, f32)| a.0 + (b.0 - a.0) * a.1 / (a.1 - b.1);
        for _ in 0..2 {
            let t = zero(outside, inside);
            match self.sample(add(eye, scale(direction, t))) {
                Some(d) if d > 0.0 => outside = (t, d),
                Some(d) => inside = (t, d),
                None => return t,
            }
        }
        zero(outside, inside)
    }

    /// Length of the ray until it leaves the block of voxel `c`, and a little more.
    fn to_block_end(&self, p: [f32; 3], direction: [f32; 3], c: [i32; 3]) -> f32 {
        let voxel = self.options.voxel_m;
        let mut length = SIDE as f32 * voxel;
        for a in 0..3 {
            let first = c[a] >> 3 << 3;
            let wall = if direction[a] > 0.0 { first + SIDE } else { first };
            // Voxels reach half a voxel around their centres.
            let distance = ((wall as f32 - 0.5) * voxel - p[a]) / direction[a];
            if direction[a] != 0.0 && distance < length {
                length = distance;
            }
        }
        length.max(0.0) + 0.05 * voxel
    }
}

/// Where a ray enters and leaves a box; `None` if it misses it.
fn inside_box(eye: [f32; 3], direction: [f32; 3], [low, high]: &[[f32; 3]; 2]) -> Option<(f32, f32)> {
    let (mut from, mut to) = (0.0_f32, f32::INFINITY);
    for a in 0..3 {
        let inverse = 1.0 / direction[a];
        let (t0, t1) = ((low[a] - eye[a]) * inverse, (high[a] - eye[a]) * inverse);
        // NaN (a ray in the wall's plane) changes nothing.
        from = from.max(t0.min(t1));
        to = to.min(t0.max(t1));
    }
    (from < to && to.is_finite()).then_some((from, to))
}
