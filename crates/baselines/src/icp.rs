//! Projective point-to-plane ICP, coarse to fine.
//!
//! Chen and Medioni 1992 for the point-to-plane distance, Blais and Levine 1995 for the association by projection, as
//! KinectFusion puts them together (section 3.5, eq. 16-24).

use crate::normal_equations::NormalEquations;
use crate::point_map::PointMap;
use crate::rigid::{Rigid, cross, dot, sub};
use nalgebra::{Isometry3, Point3};
use se3_lie::se3;

/// Iterations and gates of one level of the pyramid.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stage {
    pub(crate) level: usize,
    pub(crate) iterations: usize,
    /// Largest distance of a pair, metres.
    pub(crate) max_distance: f32,
}

/// KinectFusion's schedule: 10 iterations on the coarsest level, then 5, then 4. `gate` (metres) is the largest
/// distance of a pair on the finest level; coarser ones allow twice and three times as much.
pub(crate) fn schedule(gate: f32) -> [Stage; 3] {
    let stage = |level, iterations, factor: f32| Stage { level, iterations, max_distance: factor * gate };
    [stage(2, 10, 3.0), stage(1, 5, 2.0), stage(0, 4, 1.0)]
}

/// Points known to be the same, from another source: in the object's frame and in the live camera's.
#[derive(Clone, Debug, Default)]
pub(crate) struct Matches {
    pub(crate) pairs: Vec<([f32; 3], [f32; 3])>,
    /// Weight of all of them together, relative to that of all ICP pairs.
    pub(crate) share: f32,
}

/// What ICP runs on.
pub(crate) struct Alignment<'a> {
    /// Live points and normals in the live camera's frame, finest first.
    pub(crate) live: &'a [PointMap],
    /// The surface to align to: points and normals in the object's frame, for as many levels.
    pub(crate) model: &'a [PointMap],
    /// Pose from which `model` is seen, for the association.
    pub(crate) model_cam_from_obj: Isometry3<f64>,
    /// Half the object's size, metres.
    pub(crate) radius: f64,
    pub(crate) matches: Matches,
}

/// Normals of a pair are at most 40 degrees apart.
const MIN_COS: f32 = 0.766;
/// Fewer live points with a partner, as a share of all on the last level, are no alignment.
const MIN_PAIRED: f64 = 0.4;
/// The pairs' root mean square distance in gates; pairs at random have 0.58.
const MAX_RMS: f64 = 0.4;

impl Alignment<'_> {
    /// The live camera's `cam_from_obj`, from an estimate of it; `None` when too little fits.
    pub(crate) fn run(&self, cam_from_obj: &Isometry3<f64>, stages: &[Stage]) -> Option<Isometry3<f64>> {
        let mut obj_from_cam = cam_from_obj.inverse();
        let available = self.live.len().min(self.model.len());
        let mut is_good = false;
        for stage in stages.iter().filter(|s| s.level < available) {
            for _ in 0..stage.iterations {
                let pairs = self.pairs(&obj_from_cam, stage);
                let step = self.with_matches(pairs, &obj_from_cam).solve(self.radius)?;
                obj_from_cam = se3::exp(&step) * obj_from_cam;
                // A hundredth of a millimetre at the object's rim.
                if step.fixed_rows::<3>(0).norm() + self.radius * step.fixed_rows::<3>(3).norm() < 1e-5 {
                    break;
                }
            }
            let pairs = self.pairs(&obj_from_cam, stage);
            let paired = pairs.count as f64 / self.live[stage.level].count().max(1) as f64;
            is_good = paired >= MIN_PAIRED && pairs.rms() <= MAX_RMS * f64::from(stage.max_distance);
        }
        is_good.then(|| obj_from_cam.inverse())
    }

    /// Equations of `n·(p - q)`, with `p` the live point under the pose and `q`, `n` the model's at the pixel on which
    /// `p` falls. With the perturbation on the left, `J = [n; p × n]`.
    fn pairs(&self, obj_from_cam: &Isometry3<f64>, stage: &Stage) -> NormalEquations {
        let (live, model) = (&self.live[stage.level], &self.model[stage.level]);
        let pose = Rigid::new(obj_from_cam);
        let model_pose = Rigid::new(&self.model_cam_from_obj);
        let k = &model.intrinsics;
        let (fx, fy, cx, cy) = (k.fx as f32, k.fy as f32, k.cx as f32 + 0.5, k.cy as f32 + 0.5);
        let (width, height) = (model.width as f32, model.height as f32);
        let max_squared = stage.max_distance * stage.max_distance;
        let mut sums = NormalEquations::default();
        for (&point, &normal) in live.points.iter().zip(&live.normals) {
            if normal[0].is_nan() {
                continue;
            }
            let p = pose.point(point);
            let seen = model_pose.point(p);
            let (u, v) = (fx * seen[0] / seen[2] + cx, fy * seen[1] / seen[2] + cy);
            if !(u >= 0.0 && v >= 0.0 && u < width && v < height && seen[2] > 0.0) {
                continue;
            }
            let at = v as usize * model.width + u as usize;
            let (q, n) = (model.points[at], model.normals[at]);
            let d = sub(p, q);
            // False for a missing partner, which is NaN.
            if dot(d, d) <= max_squared && dot(pose.direction(normal), n) >= MIN_COS {
                let turn = cross(p, n);
                sums.add([n[0], n[1], n[2], turn[0], turn[1], turn[2]], dot(n, d), 1.0);
            }
        }
        sums
    }

    fn with_matches(&self, mut sums: NormalEquations, obj_from_cam: &Isometry3<f64>) -> NormalEquations {
        let weight = self.matches.share * sums.count.max(1) as f32 / self.matches.pairs.len().max(1) as f32;
        if weight > 0.0 {
            for &(object, camera) in &self.matches.pairs {
                let p: [f32; 3] =
                    (obj_from_cam * Point3::from(camera.map(f64::from))).coords.map(|v| v as f32).into();
                let d = sub(p, object);
                sums.add([1.0, 0.0, 0.0, 0.0, p[2], -p[1]], d[0], weight);
                sums.add([0.0, 1.0, 0.0, -p[2], 0.0, p[0]], d[1], weight);
                sums.add([0.0, 0.0, 1.0, p[1], -p[0], 0.0], d[2], weight);
            }
        }
        sums
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use rgbd_io::{Image, Intrinsics};

    const K: Intrinsics = Intrinsics { fx: 300.0, fy: 300.0, cx: 79.5, cy: 59.5 };

    /// Depth of an ellipsoid with half axes 4, 5.5 and 7 cm at the object's origin.
    fn ellipsoid(cam_from_obj: &Isometry3<f64>) -> Image<f32> {
        let obj_from_cam = cam_from_obj.inverse();
        let squeeze = Vector3::new(1.0 / 0.04, 1.0 / 0.055, 1.0 / 0.07);
        Image::from_fn(160, 120, |x, y| {
            let ray = Vector3::from(K.unproject(x as f64, y as f64, 1.0));
            let o = obj_from_cam.translation.vector.component_mul(&squeeze);
            let d = (obj_from_cam.rotation * ray).component_mul(&squeeze);
            let (a, b, c) = (d.dot(&d), o.dot(&d), o.dot(&o) - 1.0);
            let root = b * b - a * c;
            if root > 0.0 { ((-b - root.sqrt()) / a) as f32 } else { 0.0 }
        })
    }

    fn levels(depth: &Image<f32>) -> Vec<PointMap> {
        let half = crate::depth::halved(depth, &K);
        vec![PointMap::from_depth(depth, &K), PointMap::from_depth(&half, &K.scaled(0.5, 0.5))]
    }

    #[test]
    fn a_small_motion_is_recovered() {
        let before = Isometry3::new(Vector3::new(0.01, -0.01, 0.5), Vector3::new(0.3, 0.5, -0.2));
        let step = Isometry3::new(Vector3::new(0.006, -0.004, 0.005), Vector3::new(0.05, -0.04, 0.06));
        let after = before * step;
        let (live, seen) = (levels(&ellipsoid(&after)), levels(&ellipsoid(&before)));
        let model: Vec<_> = seen.iter().map(|m| m.moved(&before.inverse())).collect();
        let alignment = Alignment {
            live: &live,
            model: &model,
            model_cam_from_obj: before,
            radius: 0.07,
            matches: Matches::default(),
        };
        let found = alignment.run(&before, &schedule(0.01)).unwrap();
        let error = found.inverse() * after;
        assert!(error.translation.vector.norm() < 5e-4, "{error}");
        assert!(error.rotation.angle() < 5e-3, "{error}");
        // From far away nothing fits, and that is said.
        let far = Isometry3::translation(0.2, 0.0, 0.0) * before;
        assert!(alignment.run(&far, &schedule(0.01)).is_none());
    }
}
