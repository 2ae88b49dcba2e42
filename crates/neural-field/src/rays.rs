//! Candidate rays of every frame, prepared once per round.

use crate::config::FieldConfig;
use crate::contrast::{reach, surround};
use crate::frame::FieldImages;
use crate::silhouette::{NOWHERE, nearest_background, nearest_masked};
use crate::volume::Volume;
use crate::window::Window;
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
    /// How deep the object may be taken to be here, truncation units: no deeper than the silhouette's rim is away.
    pub(crate) depth: Vec<f32>,
    /// RGB over the surround's brightness, 0..1.
    pub(crate) color: Vec<[f32; 3]>,
    /// Brightness of the surround; 1 where colours are taken as they are.
    pub(crate) surround: Vec<f32>,
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
    /// Least distance between the ray and the object, truncation units, at most 1: no point of the ray is nearer.
    pub(crate) clearance: Vec<f32>,
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
        let reach = reach(frame, mask_box, config.contrast_window);
        let window = Window::around(mask_box, radius.max(reach).max(1), (frame.width, frame.height));
        let near = if config.ring_rays > 0 { nearest_masked(frame, window, radius) } else { Vec::new() };
        let far = nearest_background(frame, window, radius.max(1));
        let surround = surround(frame, window, reach);
        let (mut inside, mut ring) = (Vec::new(), Vec::new());
        for (i, (u, v)) in window.pixels().enumerate() {
            if frame.masked(u, v) {
                if let Some(z) = frame.depth_at(u, v) {
                    inside.push((u, v, z, far[i], surround[i]));
                }
            } else if let Some(&rim) = near.get(i)
                && rim != NOWHERE
            {
                ring.push(((u, v), rim));
            }
        }
        for i in spread(inside.len(), config.rays_per_frame) {
            rays.push_surface(frame, obj_from_cam, volume, config, inside[i]);
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
        (u, v, z, rim, surround): (usize, usize, f32, [u32; 2], f32),
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
        let depth = if rim == NOWHERE {
            1.0
        } else {
            pixel_distance((u, v), rim) * f64::from(z) / frame.fx.max(frame.fy) / config.truncation
        };
        s.depth.push(depth.min(1.0) as f32);
        let at = v * frame.width + u;
        s.color.push(frame.color[at].map(|c| (f32::from(c) / 255.0 / surround).min(1.0)));
        s.surround.push(surround);
        let cosine = if config.incidence_correction { incidence(frame, u, v, z, config) } else { None };
        s.cosine.push(cosine.unwrap_or(1.0).clamp(MIN_COSINE, 1.0));
    }

    fn push_ring(
        &mut self,
        frame: &FieldImages,
        obj_from_cam: &Isometry3<f64>,
        volume: &Volume,
        config: &FieldConfig,
        ((u, v), rim): ((usize, usize), [u32; 2]),
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
        // Where the rim has no reading, as near as the object can be: what the ray passes by is then less, not more.
        let [x, y] = rim.map(|c| c as usize);
        let at_rim = frame.depth_at(x, y).unwrap_or(intervals[0][0] / length as f32);
        let across = clearance(frame, (u, v), rim, at_rim);
        self.ring.clearance.push((across / config.truncation).min(1.0) as f32);
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

fn pixel_distance((u, v): (usize, usize), [x, y]: [u32; 2]) -> f64 {
    (u as f64 - f64::from(x)).hypot(v as f64 - f64::from(y))
}

/// How far the ray through a pixel passes by the object, metres. The rim is at the masked pixel nearest to it, of depth
/// `z`, or up to [`FieldImages::mask_margin`] nearer; where the ray passes the rim the distance is that between the two
/// pixels at this depth, and everywhere else on the ray it is larger.
fn clearance(frame: &FieldImages, pixel: (usize, usize), rim: [u32; 2], z: f32) -> f64 {
    let pixels = pixel_distance(pixel, rim) - f64::from(frame.mask_margin);
    pixels.max(0.0) * f64::from(z) / frame.fx.max(frame.fy)
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
            mask_margin: 1.0,
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
    fn no_ray_is_said_to_pass_further_off_than_it_does() {
        // A disc facing the camera: a ray beside it is as far from it as its pixel from the rim.
        let (mut frame, radius) = (plane([0.0, 0.0, 1.0]), 12.0);
        let from_centre = |u: usize, v: usize| (u as f64 - 32.0).hypot((v as f64 - 24.0) * 60.0 / 55.0);
        for (i, m) in frame.mask.iter_mut().enumerate() {
            *m = u8::from(from_centre(i % 64, i / 64) <= radius);
        }
        let all = Window::around([0, 0, 63, 47], 0, (64, 48));
        let near = nearest_masked(&frame, all, 10);
        let mut most = 0.0f64;
        for v in 0..48 {
            for u in 0..64 {
                let edge = near[v * 64 + u];
                if edge == NOWHERE || frame.masked(u, v) {
                    continue;
                }
                let said = clearance(&frame, (u, v), edge, 0.5);
                let real = (from_centre(u, v) - radius) * 0.5 / 60.0;
                assert!(said <= real + 1e-6 && said > real - 2.5 * 0.5 / 55.0, "{u} {v}: {said} {real}");
                most = most.max(said);
            }
        }
        assert!(most > 0.05);
    }
}
