//! SDF-2-SDF registration of one object, frame to model.
//!
//! Slavcheva, Kehl, Navab and Ilic, *SDF-2-SDF: Highly accurate 3D object reconstruction*, ECCV 2016, and *SDF-2-SDF
//! registration for real-time 3D reconstruction from RGB-D data*, IJCV 2018. There are no correspondences: over the
//! voxels near the model's surface, the model's signed distance `φ_ref(V)` is compared with the projective one of the
//! live frame at the moved voxel, `φ_cur(T V) = D(π(T V)) - (T V)_z`, and `½ Σ ω (φ_ref - φ_cur)²` is minimised by
//! Gauss-Newton, with few voxels first and all of them then.
//!
//! Two things differ from the paper: the live distances are interpolated, not put on a grid of their own, so
//! that their gradient is exact; and the first stage looks beyond the truncation, where the paper's gradient is zero,
//! which lets it follow faster motion.

use crate::depth::interpolated;
use crate::normal_equations::NormalEquations;
use crate::observation::{MIN_POINTS, Observation};
use crate::rigid::{Rigid, cross, dot, sub};
use crate::tracker::{Model, Registration};
use nalgebra::Isometry3;
use se3_lie::se3;

#[derive(Debug, Default)]
pub(crate) struct Sdf2Sdf;

/// One round of Gauss-Newton.
struct Stage {
    /// Every so many voxels along each axis.
    stride: usize,
    iterations: usize,
    /// Model voxels this near the surface are compared, truncations.
    band: f32,
    /// Live distances up to this count, truncations.
    reach: f32,
}

const STAGES: [Stage; 2] = [
    Stage { stride: 2, iterations: 15, band: 0.5, reach: 3.0 },
    Stage { stride: 1, iterations: 10, band: 0.3, reach: 1.0 },
];
/// Cosine of the angle of view from which a voxel is compared. Projective distances are too long on slanted surfaces, by
/// another factor from each view: only where the surface faces the camera do live and fused ones agree.
const FACING: f32 = 0.5;
/// Model weight from which a voxel counts in full.
const FULL_WEIGHT: f32 = 8.0;
const MIN_USED: f64 = 0.35;
/// In truncations.
const MAX_RMS: f64 = 0.35;

impl Registration for Sdf2Sdf {
    fn register(&mut self, observation: &Observation, model: &Model) -> Option<Isometry3<f64>> {
        let mut cam_from_obj = model.cam_from_obj;
        let mut is_good = false;
        for stage in &STAGES {
            let voxels = facing_voxels(model, &cam_from_obj, stage);
            let reach = stage.reach * model.truncation();
            for _ in 0..stage.iterations {
                let step = equations(&voxels, observation, &cam_from_obj, reach).solve(model.radius)?;
                // A step on the right keeps the voxels' own coordinates in the Jacobian, which are centred.
                cam_from_obj *= se3::exp(&step);
                if step.fixed_rows::<3>(0).norm() + model.radius * step.fixed_rows::<3>(3).norm() < 1e-5 {
                    break;
                }
            }
            let sums = equations(&voxels, observation, &cam_from_obj, reach);
            is_good = sums.count >= MIN_POINTS
                && sums.count as f64 >= MIN_USED * voxels.len() as f64
                && sums.rms() <= MAX_RMS * f64::from(model.truncation());
        }
        is_good.then_some(cam_from_obj)
    }
}

/// A voxel of the model: its centre in the object's frame, its distance and its weight.
struct Voxel {
    centre: [f32; 3],
    distance: f32,
    weight: f32,
}

/// The model's voxels near the surface, on the side that the camera sees. Those of the far side would be compared with
/// the near one wherever the object is thin.
fn facing_voxels(model: &Model, cam_from_obj: &Isometry3<f64>, stage: &Stage) -> Vec<Voxel> {
    let eye = cam_from_obj.inverse().translation.vector.map(|v| v as f32).into();
    let mut voxels = Vec::new();
    model.volume.near_surface(stage.band * model.truncation(), stage.stride, |centre, distance, weight| {
        let faces = model.volume.gradient(centre).is_some_and(|g| {
            let ray = sub(centre, eye);
            dot(g, ray) < -FACING * (dot(g, g) * dot(ray, ray)).sqrt()
        });
        if faces {
            voxels.push(Voxel { centre, distance, weight: weight.min(FULL_WEIGHT) });
        }
    });
    voxels
}

/// Equations of `φ_cur(T V) - φ_ref(V)` for `T exp(δ)`: with the gradient `g` of `φ_cur` turned into the object's
/// frame, `J = [g; V × g]`.
fn equations(
    voxels: &[Voxel],
    live: &Observation,
    cam_from_obj: &Isometry3<f64>,
    reach: f32,
) -> NormalEquations {
    let pose = Rigid::new(cam_from_obj);
    let k = &live.intrinsics;
    let (fx, fy, cx, cy) = (k.fx as f32, k.fy as f32, k.cx as f32, k.cy as f32);
    let mut sums = NormalEquations::default();
    for voxel in voxels {
        let p = pose.point(voxel.centre);
        if p[2] <= 0.0 {
            continue;
        }
        let inverse_z = 1.0 / p[2];
        let (x, y) = (p[0] * inverse_z, p[1] * inverse_z);
        let Some([depth, du, dv]) = interpolated(&live.smooth, fx * x + cx, fy * y + cy, k) else { continue };
        // Along the ray, as the model was fused.
        let along_ray = (1.0 + x * x + y * y).sqrt();
        let distance = (depth - p[2]) * along_ray;
        if distance.abs() > reach {
            continue;
        }
        let (gx, gy) = (du * fx * inverse_z, dv * fy * inverse_z);
        let in_camera = [gx * along_ray, gy * along_ray, -(gx * x + gy * y + 1.0) * along_ray];
        let g = pose.direction_back(in_camera);
        let turn = cross(voxel.centre, g);
        sums.add([g[0], g[1], g[2], turn[0], turn[1], turn[2]], distance - voxel.distance, voxel.weight);
    }
    sums
}
