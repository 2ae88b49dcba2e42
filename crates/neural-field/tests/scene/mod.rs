//! Analytic shapes seen by ideal depth cameras: ground truth for tests, the example and the benchmark.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used)]

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use neural_field::FieldImages;
use std::sync::Arc;

#[derive(Clone, Copy, Debug)]
pub enum Shape {
    Sphere {
        radius: f64,
    },
    Box {
        half: [f64; 3],
    },
    /// About the z axis.
    Torus {
        radius: f64,
        tube: f64,
    },
    /// A cup open towards +y with a handle towards +x.
    Mug {
        radius: f64,
        half_height: f64,
        wall: f64,
    },
}

impl Shape {
    /// True signed distance, metres.
    pub fn sdf(&self, p: [f64; 3]) -> f64 {
        match self {
            Self::Sphere { radius } => norm(p) - radius,
            Self::Box { half } => {
                let q: [f64; 3] = std::array::from_fn(|a| p[a].abs() - half[a]);
                norm(q.map(|v| v.max(0.0))) + q[0].max(q[1]).max(q[2]).min(0.0)
            }
            Self::Torus { radius, tube } => (p[0].hypot(p[1]) - radius).hypot(p[2]) - tube,
            Self::Mug { radius, half_height, wall } => {
                let cylinder = |radius: f64, low: f64, high: f64| {
                    let across = p[0].hypot(p[2]) - radius;
                    let along = (low - p[1]).max(p[1] - high);
                    across.max(0.0).hypot(along.max(0.0)) + across.max(along).min(0.0)
                };
                let cup = cylinder(*radius, -half_height, *half_height);
                let hollow = cylinder(radius - wall, wall - half_height, 2.0 * half_height);
                let handle = ((p[0] - radius).hypot(p[1]) - 0.6 * half_height).hypot(p[2]) - wall;
                // The handle ends in the wall.
                cup.max(-hollow).min(handle.max(-cylinder(radius - 0.5 * wall, -half_height, *half_height)))
            }
        }
    }

    /// First hit of the ray `o + t d`.
    pub fn hit(&self, o: [f64; 3], d: [f64; 3]) -> Option<f64> {
        match self {
            Self::Sphere { radius } => {
                let (a, b, c) = (dot(d, d), dot(o, d), dot(o, o) - radius * radius);
                let disc = b * b - a * c;
                (disc > 0.0).then(|| (-b - disc.sqrt()) / a)
            }
            Self::Box { half } => {
                let (mut near, mut far) = (f64::MIN, f64::MAX);
                for a in 0..3 {
                    let (t0, t1) = ((-half[a] - o[a]) / d[a], (half[a] - o[a]) / d[a]);
                    near = near.max(t0.min(t1));
                    far = far.min(t0.max(t1));
                }
                (near < far && near > 0.0).then_some(near)
            }
            Self::Torus { .. } | Self::Mug { .. } => self.march(o, d),
        }
    }

    /// First hit by sphere tracing (Hart 1996): no step is longer than the distance to the surface.
    fn march(&self, o: [f64; 3], d: [f64; 3]) -> Option<f64> {
        let (length, end) = (norm(d), norm(o) + self.extent());
        let mut t = 0.0;
        while t * length < end {
            let distance = self.sdf(std::array::from_fn(|a| o[a] + t * d[a]));
            if distance < 1e-6 {
                return Some(t);
            }
            t += distance / length;
        }
        None
    }

    pub fn extent(&self) -> f64 {
        match self {
            Self::Sphere { radius } => 2.0 * radius,
            Self::Box { half } => 2.0 * half[0].max(half[1]).max(half[2]),
            Self::Torus { radius, tube } => 2.0 * (radius + tube),
            Self::Mug { half_height, .. } => 2.0 * half_height,
        }
    }
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn norm(a: [f64; 3]) -> f64 {
    dot(a, a).sqrt()
}

/// A smooth pattern of a few centimetres on an object of 20 cm.
pub fn paint(p: [f64; 3], extent: f64) -> [u8; 3] {
    let k = 24.0 / extent;
    let wave = |a: f64, b: f64| (127.0 + 100.0 * (a * k).sin() * (b * k * 1.3 + 0.7).cos()) as u8;
    [wave(p[0], p[1]), wave(p[1], p[2]), wave(p[2], p[0])]
}

/// `obj_from_cam` of a camera at `distance` that looks at the centre from a direction.
pub fn look_at_center(direction: [f64; 3], distance: f64) -> Isometry3<f64> {
    let z = -Vector3::from(direction).normalize();
    let up = if z.y.abs() < 0.9 { Vector3::y() } else { Vector3::x() };
    let x = up.cross(&z).normalize();
    let y = z.cross(&x);
    let r = nalgebra::Rotation3::from_basis_unchecked(&[x, y, z]);
    Isometry3::from_parts(Translation3::from(-z * distance), UnitQuaternion::from_rotation_matrix(&r))
}

/// Evenly spread view directions.
pub fn directions(n: usize) -> Vec<[f64; 3]> {
    (0..n)
        .map(|i| {
            let z = 1.0 - (2 * i + 1) as f64 / n as f64;
            let (s, c) = (i as f64 * 2.399_963_229_728_653).sin_cos();
            let r = (1.0 - z * z).sqrt();
            [r * c, r * s, z]
        })
        .collect()
}

/// A deterministic number in -1..1.
pub fn noise(seed: u64) -> f64 {
    let mut x = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x1234_5678_9abc_def1;
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((x ^ (x >> 31)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
}

/// What a camera sees: depth of the shape (with uniform noise of the given amplitude), its colours, its mask.
pub fn view(
    shape: &Shape,
    obj_from_cam: &Isometry3<f64>,
    id: u64,
    side: usize,
    depth_noise: f64,
) -> FieldImages {
    let distance = obj_from_cam.translation.vector.norm();
    // The object's diagonal fills about two thirds of the image.
    let f = 0.6 * side as f64 * distance / shape.extent();
    let c = (side as f64 - 1.0) / 2.0;
    let n = side * side;
    let mut frame = FieldImages {
        id,
        width: side,
        height: side,
        fx: f,
        fy: f,
        cx: c,
        cy: c,
        color: vec![[0; 3]; n],
        depth: vec![0.0; n],
        mask: vec![0; n],
        mask_margin: 0.5,
    };
    let o: [f64; 3] = obj_from_cam.translation.vector.into();
    for i in 0..n {
        let ray = Vector3::new(((i % side) as f64 - c) / f, ((i / side) as f64 - c) / f, 1.0);
        let d: [f64; 3] = (obj_from_cam.rotation * ray).into();
        if let Some(z) = shape.hit(o, d) {
            frame.depth[i] = (z + depth_noise * noise(id << 32 | i as u64)) as f32;
            frame.mask[i] = 255;
            frame.color[i] = paint(std::array::from_fn(|a| o[a] + z * d[a]), shape.extent());
        }
    }
    frame
}

/// Frames all around the shape with their true `obj_from_cam`.
pub fn views(shape: &Shape, n: usize, side: usize) -> (Vec<Arc<FieldImages>>, Vec<Isometry3<f64>>) {
    noisy_views(shape, n, side, 0.0)
}

pub fn noisy_views(
    shape: &Shape,
    n: usize,
    side: usize,
    depth_noise: f64,
) -> (Vec<Arc<FieldImages>>, Vec<Isometry3<f64>>) {
    let poses: Vec<_> = directions(n).into_iter().map(|d| look_at_center(d, 2.5 * shape.extent())).collect();
    let frames = poses
        .iter()
        .enumerate()
        .map(|(i, p)| Arc::new(view(shape, p, i as u64, side, depth_noise)))
        .collect();
    (frames, poses)
}

/// Poses but the first moved by `translation` metres and turned by `angle` radians in arbitrary directions.
pub fn perturb(poses: &[Isometry3<f64>], translation: f64, angle: f64) -> Vec<Isometry3<f64>> {
    let direction = |seed: u64| Vector3::new(noise(seed), noise(seed + 1), noise(seed + 2)).normalize();
    poses
        .iter()
        .enumerate()
        .map(|(i, p)| {
            if i == 0 {
                return *p;
            }
            let seed = 1000 + 10 * i as u64;
            let motion = Isometry3::new(direction(seed) * translation, direction(seed + 5) * angle);
            motion * p
        })
        .collect()
}

/// Largest and median error of the poses: metres at the object's centre, radians.
pub fn pose_errors(got: &[Isometry3<f64>], truth: &[Isometry3<f64>]) -> [f64; 4] {
    let motions: Vec<_> = got.iter().zip(truth).skip(1).map(|(g, t)| g * t.inverse()).collect();
    let mut shift: Vec<f64> = motions.iter().map(|m| (m * Point3::origin()).coords.norm()).collect();
    let mut turn: Vec<f64> = motions.iter().map(|m| m.rotation.angle()).collect();
    shift.sort_by(f64::total_cmp);
    turn.sort_by(f64::total_cmp);
    let mid = shift.len() / 2;
    [shift[mid], shift[shift.len() - 1], turn[mid], turn[turn.len() - 1]]
}

/// Errors of the distance at points within `band` of the true surface, sorted; unknown points are left out.
pub fn sdf_errors(field: &neural_field::TrainedField, shape: &Shape, band: f64, n: usize) -> Vec<f64> {
    let extent = shape.extent();
    let mut points = Vec::new();
    let mut seed = 77;
    while points.len() < n {
        let p: [f64; 3] = std::array::from_fn(|a| 0.6 * extent * noise(seed + a as u64));
        seed += 3;
        if shape.sdf(p).abs() < band {
            points.push(p.map(|v| v as f32));
        }
    }
    let mut sdf = vec![0.0; n];
    field.sdf(&points, &mut sdf);
    let mut errors: Vec<f64> = points
        .iter()
        .zip(&sdf)
        .filter(|(_, s)| s.is_finite())
        .map(|(p, s)| (f64::from(*s) - shape.sdf(p.map(f64::from))).abs())
        .collect();
    errors.sort_by(f64::total_cmp);
    errors
}
