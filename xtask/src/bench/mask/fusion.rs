//! A stand-in for the tracker's fused surface.

use std::collections::BTreeMap;

use mask_tracker::SurfacePoint;
use nalgebra::{Isometry3, Point3, Vector3};
use rgbd_io::{Mask, RgbdFrame};

/// Observed surface in voxels of 3 mm; those seen twice count.
#[derive(Default)]
pub(super) struct Fusion {
    cells: BTreeMap<[i32; 3], ([f32; 3], [f32; 3], f32)>,
}

impl Fusion {
    pub(super) fn add(&mut self, frame: &RgbdFrame, mask: &Mask, cam_from_obj: &Isometry3<f64>) {
        let obj_from_cam: Isometry3<f32> = cam_from_obj.inverse().cast();
        let (w, h) = frame.depth.size();
        let at = |x: usize, y: usize| {
            let z = frame.depth[(x, y)];
            (z > 0.0 && mask[(x, y)] != 0).then(|| {
                Vector3::from(frame.intrinsics.unproject(x as f64, y as f64, f64::from(z)).map(|v| v as f32))
            })
        };
        for y in (3..h - 3).step_by(2) {
            for x in (3..w - 3).step_by(2) {
                let (Some(c), Some(l), Some(r), Some(t), Some(b)) =
                    (at(x, y), at(x - 3, y), at(x + 3, y), at(x, y - 3), at(x, y + 3))
                else {
                    continue;
                };
                let n = (b - t).cross(&(r - l));
                if (r - l).norm() > 0.03 || (b - t).norm() > 0.03 || n.norm() == 0.0 {
                    continue;
                }
                let p = obj_from_cam * Point3::from(c);
                let n = obj_from_cam.rotation * n.normalize();
                let n = if n.dot(&(obj_from_cam.rotation * c)) > 0.0 { -n } else { n };
                let key = [p.x, p.y, p.z].map(|v| (v / 0.003).floor() as i32);
                let cell = self.cells.entry(key).or_default();
                (0..3).for_each(|k| {
                    cell.0[k] += p[k];
                    cell.1[k] += n[k];
                });
                cell.2 += 1.0;
            }
        }
    }

    pub(super) fn points(&self) -> Vec<SurfacePoint> {
        self.cells
            .values()
            .filter(|c| c.2 > 1.0)
            .map(|(p, n, count)| SurfacePoint {
                position: p.map(|v| v / count),
                normal: Vector3::from(*n).try_normalize(1e-6).map_or([0.0; 3], Into::into),
            })
            .collect()
    }
}
