//! Candidate rays of every frame, prepared once per round.

use crate::config::FieldConfig;
use crate::frame::FieldImages;
use crate::volume::Volume;
use nalgebra::{Isometry3, Point3};

/// Smallest cosine of incidence that is believed: at grazing view the normal is mostly noise.
const MIN_COSINE: f32 = 0.35;

/// Rays with a measured depth inside the mask, structure of arrays.
#[derive(Clone, Debug, Default)]
pub(crate) struct SurfaceRays {
    /// Unit direction, camera frame.
    pub(crate) dir: Vec<[f32; 3]>,
    /// Euclidean distance from the camera, metres.
    pub(crate) distance: Vec<f32>,
    /// Cosine between ray and surface normal; 1 where unknown.
    pub(crate) cosine: Vec<f32>,
    /// RGB in 0..1.
    pub(crate) color: Vec<[f32; 3]>,
}

/// What a ring pixel's depth says about the space in front of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum RingKind {
    /// Nothing reliable: the mask may be wrong here.
    Uncertain,
    /// Background was measured behind the object: the ray is empty.
    Empty,
}

/// Rays through the ring around the mask.
#[derive(Clone, Debug, Default)]
pub(crate) struct RingRays {
    pub(crate) dir: Vec<[f32; 3]>,
    /// Samples stay nearer than this, metres along the ray.
    pub(crate) limit: Vec<f32>,
    pub(crate) kind: Vec<RingKind>,
}

/// One frame's candidates.
#[derive(Clone, Debug, Default)]
pub(crate) struct FrameRays {
    pub(crate) surface: SurfaceRays,
    pub(crate) ring: RingRays,
}

impl FrameRays {
    /// Collects at most `rays_per_frame` of either kind, evenly over the image.
    pub(crate) fn collect(
        frame: &FieldImages,
        obj_from_cam: &Isometry3<f64>,
        volume: &Volume,
        config: &FieldConfig,
    ) -> Self {
        let mut rays = Self::default();
        let Some(mask_box) = frame.mask_box() else { return rays };
        let radius = ring_radius(mask_box, config.ring_width);
        let near = if config.ring_rays > 0 { dilate(frame, radius) } else { Vec::new() };
        let (mut inside, mut ring) = (Vec::new(), Vec::new());
        for v in 0..frame.height {
            for u in 0..frame.width {
                if frame.masked(u, v) {
                    if let Some(z) = frame.depth_at(u, v) {
                        inside.push((u, v, z));
                    }
                } else if near.get(v * frame.width + u).is_some_and(|&n| n) {
                    ring.push((u, v));
                }
            }
        }
        for i in spread(inside.len(), config.rays_per_frame) {
            let (u, v, z) = inside[i];
            rays.push_surface(frame, obj_from_cam, volume, config, (u, v, z));
        }
        let mut intervals = Vec::new();
        for i in spread(ring.len(), config.rays_per_frame) {
            rays.push_ring(frame, obj_from_cam, volume, config, ring[i], &mut intervals);
        }
        rays
    }

    fn push_surface(
        &mut self,
        frame: &FieldImages,
        obj_from_cam: &Isometry3<f64>,
        volume: &Volume,
        config: &FieldConfig,
        (u, v, z): (usize, usize, f32),
    ) {
        let ray = frame.ray(u, v);
        let length = norm(ray);
        let p = obj_from_cam * Point3::from(ray.map(|c| c * f64::from(z)));
        if !volume.octree.contains([p.x as f32, p.y as f32, p.z as f32]) {
            return;
        }
        let s = &mut self.surface;
        s.dir.push(ray.map(|c| (c / length) as f32));
        s.distance.push(z * length as f32);
        s.color.push(frame.color[v * frame.width + u].map(|c| f32::from(c) / 255.0));
        let cosine = if config.incidence_correction { incidence(frame, u, v, z, config) } else { None };
        s.cosine.push(cosine.unwrap_or(1.0).clamp(MIN_COSINE, 1.0));
    }

    fn push_ring(
        &mut self,
        frame: &FieldImages,
        obj_from_cam: &Isometry3<f64>,
        volume: &Volume,
        config: &FieldConfig,
        (u, v): (usize, usize),
        intervals: &mut Vec<[f32; 2]>,
    ) {
        let ray = frame.ray(u, v);
        let length = norm(ray);
        let dir = ray.map(|c| (c / length) as f32);
        let (o, d) = object_ray(obj_from_cam, dir);
        volume.octree.intervals(o, d, 0.0, f32::MAX, intervals);
        let Some(last) = intervals.last() else { return };
        let margin = 2.0 * config.truncation as f32;
        let mut kind = (f32::MAX, RingKind::Uncertain);
        if let (true, Some(z)) = (config.background_depth, frame.depth_at(u, v)) {
            let seen = z * length as f32;
            kind = if seen > last[1] + margin {
                (f32::MAX, RingKind::Empty)
            } else {
                // An occluder or a mask that is too small: behind this depth nothing was seen.
                (seen - config.truncation as f32, RingKind::Uncertain)
            };
        }
        if kind.0 <= intervals[0][0] {
            return;
        }
        self.ring.dir.push(dir);
        self.ring.limit.push(kind.0);
        self.ring.kind.push(kind.1);
    }
}

/// A camera ray in the object frame: origin and direction, metres.
pub(crate) fn object_ray(obj_from_cam: &Isometry3<f64>, dir: [f32; 3]) -> ([f32; 3], [f32; 3]) {
    let o = obj_from_cam.translation.vector;
    let d = obj_from_cam.rotation * nalgebra::Vector3::from(dir.map(f64::from));
    ([o.x as f32, o.y as f32, o.z as f32], [d.x as f32, d.y as f32, d.z as f32])
}

fn norm(v: [f64; 3]) -> f64 {
    v.iter().map(|c| c * c).sum::<f64>().sqrt()
}

/// At most `most` of `n` indices, evenly spread. A stride that shares no factor with common image widths keeps the
/// choice from lining up in columns.
fn spread(n: usize, most: usize) -> impl Iterator<Item = usize> {
    let take = n.min(most);
    (0..take).map(move |i| (i as u128 * n as u128 / take.max(1) as u128) as usize)
}

fn ring_radius([u0, v0, u1, v1]: [usize; 4], share: f64) -> usize {
    let side = (u1 - u0 + 1).max(v1 - v0 + 1) as f64;
    if share > 0.0 { ((side * share).round() as usize).max(1) } else { 0 }
}

/// The mask grown by a square of the given radius, in two passes of running distances.
fn dilate(frame: &FieldImages, radius: usize) -> Vec<bool> {
    let (w, h) = (frame.width, frame.height);
    let mut rows = vec![false; w * h];
    for v in 0..h {
        let row = &frame.mask[v * w..(v + 1) * w];
        grow(w, radius, |u| row[u] != 0, |u| rows[v * w + u] = true);
    }
    let mut out = vec![false; w * h];
    for u in 0..w {
        grow(h, radius, |v| rows[v * w + u], |v| out[v * w + u] = true);
    }
    out
}

fn grow(n: usize, radius: usize, set: impl Fn(usize) -> bool, mut mark: impl FnMut(usize)) {
    let mut next = 0;
    for i in (0..n).filter(|&i| set(i)) {
        for j in next.max(i.saturating_sub(radius))..(i + radius + 1).min(n) {
            mark(j);
            next = j + 1;
        }
    }
}

/// Cosine between the ray and the normal of a plane fitted around the pixel.
///
/// Inverse depth is linear in the pixel on a plane, `1/z = n . ray`, so two slopes give the normal. The window
/// covers about one truncation distance on the surface; pixels further away in depth are another surface.
fn incidence(frame: &FieldImages, u: usize, v: usize, z: f32, config: &FieldConfig) -> Option<f32> {
    let reach = config.truncation as f32;
    let step = ((0.25 * config.truncation * frame.fx / f64::from(z)).round() as i64).clamp(1, 6);
    let inverse = 1.0 / f64::from(z);
    let (mut n, mut su, mut sv, mut sw) = (0.0, 0.0, 0.0, 0.0);
    let (mut suu, mut suv, mut svv, mut suw, mut svw) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for dv in -2..=2i64 {
        for du in -2..=2i64 {
            let (x, y) = (u as i64 + du * step, v as i64 + dv * step);
            if x < 0 || y < 0 || x >= frame.width as i64 || y >= frame.height as i64 {
                continue;
            }
            let (x, y) = (x as usize, y as usize);
            let Some(zz) = frame.depth_at(x, y) else { continue };
            if (zz - z).abs() > 2.0 * reach || !frame.masked(x, y) {
                continue;
            }
            let (a, b, w) = ((du * step) as f64, (dv * step) as f64, 1.0 / f64::from(zz) - inverse);
            n += 1.0;
            su += a;
            sv += b;
            sw += w;
            suu += a * a;
            suv += a * b;
            svv += b * b;
            suw += a * w;
            svw += b * w;
        }
    }
    if n < 8.0 {
        return None;
    }
    let (cuu, cuv, cvv) = (suu - su * su / n, suv - su * sv / n, svv - sv * sv / n);
    let (cuw, cvw) = (suw - su * sw / n, svw - sv * sw / n);
    let det = cuu * cvv - cuv * cuv;
    if det <= 1e-3 * cuu * cvv || det <= 0.0 {
        return None;
    }
    let nx = (cvv * cuw - cuv * cvw) / det * frame.fx;
    let ny = (cuu * cvw - cuv * cuw) / det * frame.fy;
    let ray = frame.ray(u, v);
    let nz = inverse - nx * ray[0] - ny * ray[1];
    let cosine = inverse / (norm([nx, ny, nz]) * norm(ray));
    cosine.is_finite().then_some(cosine as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A tilted plane seen by a small camera.
    fn plane(normal: [f64; 3]) -> FieldImages {
        let (w, h) = (64, 48);
        let mut frame = FieldImages {
            id: 0,
            width: w,
            height: h,
            fx: 60.0,
            fy: 55.0,
            cx: 31.5,
            cy: 23.5,
            color: vec![[0; 3]; w * h],
            depth: vec![0.0; w * h],
            mask: vec![1; w * h],
        };
        for v in 0..h {
            for u in 0..w {
                let r = frame.ray(u, v);
                let along: f64 = (0..3).map(|a| r[a] * normal[a]).sum();
                frame.depth[v * w + u] = (0.5 * normal[2] / along) as f32;
            }
        }
        frame
    }

    #[test]
    fn incidence_of_a_plane_is_exact() {
        let normal = [0.6, 0.0, 0.8];
        let frame = plane(normal);
        let config = FieldConfig::realtime();
        for (u, v) in [(30, 20), (10, 40), (50, 5)] {
            let r = frame.ray(u, v);
            let expect = (0..3).map(|a| r[a] * normal[a]).sum::<f64>() / norm(r);
            let z = frame.depth_at(u, v).unwrap();
            let got = incidence(&frame, u, v, z, &config).unwrap();
            assert!((f64::from(got) - expect).abs() < 1e-3, "{got} {expect}");
        }
    }

    #[test]
    fn dilation_grows_by_the_radius() {
        let mut frame = plane([0.0, 0.0, 1.0]);
        frame.mask.fill(0);
        frame.mask[20 * 64 + 30] = 1;
        frame.mask[21 * 64 + 33] = 1;
        let near = dilate(&frame, 4);
        for v in 0..48usize {
            for u in 0..64usize {
                let close = |a: usize, b: usize| u.abs_diff(a) <= 4 && v.abs_diff(b) <= 4;
                assert_eq!(near[v * 64 + u], close(30, 20) || close(33, 21));
            }
        }
    }
}
