//! Light and shade: from the triangles that pixels see to colours, depths and labels.

use crate::raster::{self, Hits, Placed};
use crate::{Backdrop, Object};
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use rayon::prelude::*;
use rgbd_io::Intrinsics;

/// Depth step (metres) between neighbours of one body that counts as an outline.
const STEP: f32 = 0.008;

/// One light far away, ambient light, and the shine of all surfaces; fixed in the world frame (the camera's, unless
/// the camera moves), so that the shading of a body changes while it turns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Light {
    /// Towards the light, world frame; need not be of unit length.
    pub direction: [f32; 3],
    /// Share of light that comes from everywhere.
    pub ambient: f32,
    /// Lambert's share.
    pub diffuse: f32,
    /// Strength of the highlight (Blinn 1977), exponent 30.
    pub specular: f32,
}

impl Default for Light {
    fn default() -> Self {
        Self { direction: [-0.45, -0.75, -0.65], ambient: 0.42, diffuse: 0.62, specular: 0.10 }
    }
}

/// The shine of one body: a highlight, and the mirror image of a bright room.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gloss {
    /// Strength of the highlight (Blinn 1977).
    pub strength: f32,
    /// Its exponent: larger is smaller and sharper.
    pub exponent: i32,
    /// Share of the mirror image seen head on; it grows towards grazing angles (Schlick 1994).
    pub mirror: f32,
}

/// Image size and intrinsics.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Camera {
    pub(crate) k: Intrinsics,
    pub(crate) width: usize,
    pub(crate) height: usize,
}

/// A body in the camera frame with the label its pixels get.
pub(crate) struct Body<'a> {
    pub(crate) object: &'a Object,
    pub(crate) cam_from_body: Isometry3<f64>,
    pub(crate) label: u8,
}

/// A rendered frame without the sensor's faults; row-major.
#[derive(Clone)]
pub(crate) struct Clean {
    /// RGB, 1 = white, not clamped.
    pub(crate) color: Vec<[f32; 3]>,
    /// z-depth, metres.
    pub(crate) depth: Vec<f32>,
    /// Cosine between the surface's normal and the ray to the camera.
    pub(crate) cosine: Vec<f32>,
    /// `0` = backdrop, otherwise the body's label.
    pub(crate) label: Vec<u8>,
}

/// What a pixel sees of a body.
struct Seen {
    color: [f32; 3],
    cosine: f32,
    body: usize,
}

/// A body as the shader needs it.
struct Shaded<'a> {
    object: &'a Object,
    /// Number of its first triangle.
    start: u32,
    label: u8,
    body_from_cam: Isometry3<f32>,
    cam_from_body: UnitQuaternion<f32>,
    gloss: Gloss,
}

struct Shader<'a> {
    bodies: Vec<Shaded<'a>>,
    light: Lamp,
}

/// Renders `bodies` before `backdrop`. All values are those at the pixel centres, except that colours along the
/// outlines are blended with their neighbours', as a lens does.
pub(crate) fn render(camera: &Camera, bodies: &[Body<'_>], light: &Light, backdrop: &Clean) -> Clean {
    let mut out = backdrop.clone();
    let placed: Vec<_> = bodies.iter().map(placed).collect();
    let hits = raster::draw(&camera.k, camera.width, camera.height, &placed);
    if hits.size[1] == 0 {
        return out;
    }
    let parts = Shader::new(bodies, light).paint(camera, &hits, &mut out);
    soften(camera.width, &hits, &parts, &mut out);
    out
}

/// What would be seen of `body` at the pixel centres if nothing else were there.
pub(crate) fn silhouette(camera: &Camera, body: &Body<'_>) -> Hits {
    raster::draw(&camera.k, camera.width, camera.height, &[placed(body)])
}

fn placed<'a>(body: &Body<'a>) -> Placed<'a> {
    let (mesh, closed) = (body.object.mesh(), body.object.is_closed());
    Placed { mesh, cam_from_mesh: body.cam_from_body, closed }
}

impl<'a> Shader<'a> {
    fn new(bodies: &[Body<'a>], light: &Light) -> Self {
        let mut start = 0;
        let bodies = bodies.iter().map(|b| {
            let plain = Gloss { strength: light.specular, exponent: 30, mirror: 0.0 };
            let shaded = Shaded {
                object: b.object,
                start,
                label: b.label,
                body_from_cam: b.cam_from_body.inverse().cast(),
                cam_from_body: b.cam_from_body.rotation.cast(),
                gloss: b.object.gloss().unwrap_or(plain),
            };
            start += b.object.mesh().triangles.len() as u32;
            shaded
        });
        Self { bodies: bodies.collect(), light: Lamp::new(light) }
    }

    /// Paints the pixels of the window in which a body is nearer than what `out` holds, and tells which body each
    /// pixel of the window sees, from 1 on.
    fn paint(&self, camera: &Camera, hits: &Hits, out: &mut Clean) -> Vec<u32> {
        let [left, top] = hits.corner;
        let (skip, width) = (top * camera.width, camera.width);
        let mut parts = vec![0u32; hits.size[0] * hits.size[1]];
        let across: Vec<f32> = (0..width).map(|x| ((x as f64 - camera.k.cx) / camera.k.fx) as f32).collect();
        out.depth[skip..]
            .par_chunks_mut(width)
            .zip(out.cosine[skip..].par_chunks_mut(width))
            .zip(out.label[skip..].par_chunks_mut(width))
            .zip(out.color[skip..].par_chunks_mut(width))
            .zip(parts.par_chunks_mut(hits.size[0]))
            .enumerate()
            .for_each(|(y, ((((depth, cosine), label), color), parts))| {
                let down = ((((top + y) as f64) - camera.k.cy) / camera.k.fy) as f32;
                for x in left..left + hits.size[0] {
                    let Some((z, id)) = hits.at(x, top + y) else { continue };
                    if z < depth[x] {
                        let seen = self.see(Vector3::new(across[x], down, 1.0), z, id);
                        depth[x] = z;
                        cosine[x] = seen.cosine;
                        label[x] = self.bodies[seen.body].label;
                        color[x] = seen.color;
                        parts[x - left] = seen.body as u32 + 1;
                    }
                }
            });
        parts
    }

    /// What the pixel with the ray `[x, y, 1]` sees of triangle `id` at depth `z`.
    fn see(&self, ray: Vector3<f32>, z: f32, id: u32) -> Seen {
        let body = self.bodies.partition_point(|b| b.start <= id) - 1;
        let shaded = &self.bodies[body];
        let mesh = shaded.object.mesh();
        let triangle = (id - shaded.start) as usize;
        let corners = mesh.triangles[triangle];
        let p = shaded.body_from_cam * Point3::from(ray * z);
        let [a, b, c] = corners.map(|v| Point3::from(mesh.vertices[v as usize]));
        let [na, nb, nc] = corners.map(|v| Vector3::from(mesh.normals[v as usize]));
        let (ab, ac, ap) = (b - a, c - a, p - a);
        let flat = ab.cross(&ac);
        let scale = 1.0 / flat.norm_squared().max(1e-30);
        let wb = (ap.cross(&ac).dot(&flat) * scale).clamp(0.0, 1.0);
        let wc = (ab.cross(&ap).dot(&flat) * scale).clamp(0.0, 1.0 - wb);
        let local = na * (1.0 - wb - wc) + nb * wb + nc * wc;
        let albedo = match shaded.object.atlas() {
            Some(atlas) => atlas.color(triangle, wb, wc),
            None => shaded.object.texture().color(p.coords.into(), unit(local, -ray).into()),
        };
        let ray = ray / ray.norm();
        // An interpolated normal may look away at the rim.
        let normal = unit(shaded.cam_from_body * local, -ray);
        let color = self.light.shade(&shaded.gloss, albedo, normal, ray);
        Seen { color, cosine: -normal.dot(&ray), body }
    }
}

/// `v` with unit length; `otherwise` if it has none.
fn unit(v: Vector3<f32>, otherwise: Vector3<f32>) -> Vector3<f32> {
    let n = v.norm();
    if n > 0.0 { v / n } else { otherwise }
}

/// Blends the colours of pixels whose neighbours show another body, or the same one much nearer or further: stands in
/// for the lens, whose image of an edge is a ramp.
fn soften(width: usize, hits: &Hits, parts: &[u32], out: &mut Clean) {
    let [columns, rows] = hits.size;
    let [left, top] = hits.corner;
    let depth = &out.depth;
    let sharp: Vec<[f32; 3]> = (top..top + rows)
        .flat_map(|y| &out.color[y * width + left..y * width + left + columns])
        .copied()
        .collect();
    // The window's own border has neighbours outside it; nothing is drawn there, so it stays as it is.
    let inner = 1..columns.saturating_sub(1);
    out.color[top * width..].par_chunks_mut(width).enumerate().take(rows.saturating_sub(1)).skip(1).for_each(
        |(y, row)| {
            for x in inner.clone() {
                let (i, at) = (y * columns + x, (top + y) * width + left + x);
                let other = |j: usize, to: usize| {
                    parts[j] != parts[i] || (parts[i] != 0 && (depth[to] - depth[at]).abs() > STEP)
                };
                let edge = other(i - 1, at - 1)
                    || other(i + 1, at + 1)
                    || other(i - columns, at - width)
                    || other(i + columns, at + width);
                if edge {
                    row[left + x] = std::array::from_fn(|k| {
                        let around = sharp[i - 1][k] + sharp[i + 1][k];
                        let around = around + sharp[i - columns][k] + sharp[i + columns][k];
                        0.5 * sharp[i][k] + 0.125 * around
                    });
                }
            }
        },
    );
}

/// A [`Light`] in the camera frame, ready for use.
#[derive(Clone, Copy)]
pub(crate) struct Lamp {
    light: Light,
    towards: Option<Vector3<f32>>,
}

impl Lamp {
    pub(crate) fn new(light: &Light) -> Self {
        Self { light: *light, towards: Vector3::from(light.direction).try_normalize(0.0) }
    }

    /// Lambert's shading of a matt surface.
    pub(crate) fn matt(&self, albedo: [f32; 3], normal: Vector3<f32>) -> [f32; 3] {
        let lambert = self.towards.map_or(0.0, |t| normal.dot(&t).max(0.0));
        albedo.map(|c| c * (self.light.ambient + self.light.diffuse * lambert))
    }

    /// Lambert's shading with the body's shine; `ray` points away from the camera.
    fn shade(&self, gloss: &Gloss, albedo: [f32; 3], normal: Vector3<f32>, ray: Vector3<f32>) -> [f32; 3] {
        let mut color = self.matt(albedo, normal);
        if gloss.strength > 0.0 {
            let half = self.towards.unwrap_or(-ray) - ray;
            // Most pixels are far from the highlight: the root and the power are left to those near it.
            let (toward, length) = (normal.dot(&half), half.norm_squared());
            if toward > 0.0 && toward * toward > 0.5 * length {
                let shine = gloss.strength * (toward / length.sqrt()).powi(gloss.exponent);
                color = color.map(|c| c + shine);
            }
        }
        if gloss.mirror > 0.0 {
            let cosine = (-normal.dot(&ray)).clamp(0.0, 1.0);
            let share = gloss.mirror + (1.0 - gloss.mirror) * (1.0 - cosine).powi(5);
            let image = surroundings(ray - normal * (2.0 * normal.dot(&ray)));
            color = std::array::from_fn(|k| color[k] * (1.0 - share) + image[k] * share);
        }
        color
    }
}

/// What a mirror shows in direction `d`: a dim room with a bright ceiling lamp and a window behind the camera.
fn surroundings(d: Vector3<f32>) -> [f32; 3] {
    let level = 0.30 - 0.22 * d.y;
    let inside =
        |v: f32, from: f32, to: f32| ((v - from) * 12.0).clamp(0.0, 1.0) * ((to - v) * 12.0).clamp(0.0, 1.0);
    let window = inside(d.x, -0.75, -0.3) * inside(d.y, -0.62, 0.05) * inside(-d.z, 0.15, 1.1);
    let lamp = inside(d.x, -0.1, 0.55) * inside(-d.y, 0.72, 1.1);
    let bright = 2.2 * window + 1.6 * lamp;
    [level + 0.95 * bright, level + bright, 1.06 * level + 1.04 * bright]
}

/// The backdrop with its furniture, as the camera at `cam_from_world` sees it under `light` (camera frame).
/// `fine` takes several colour samples a pixel, for a backdrop that is rendered once.
pub(crate) fn backdrop(
    camera: &Camera,
    backdrop: &Backdrop,
    cam_from_world: &Isometry3<f64>,
    light: &Light,
    fine: bool,
) -> Clean {
    let bare = backdrop.render(camera, cam_from_world, light, fine);
    let bodies: Vec<Body<'_>> = backdrop
        .furniture
        .iter()
        .map(|(object, pose)| Body { object, cam_from_body: cam_from_world * pose, label: 0 })
        .collect();
    let mut out = render(camera, &bodies, light, &bare);
    if fine && !bodies.is_empty() {
        out.color.fill([0.0; 3]);
        for (du, dv) in [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)] {
            let k = Intrinsics { cx: camera.k.cx + du, cy: camera.k.cy + dv, ..camera.k };
            let shifted = render(&Camera { k, ..*camera }, &bodies, light, &bare);
            for (sum, c) in out.color.iter_mut().zip(shifted.color) {
                *sum = std::array::from_fn(|k| sum[k] + 0.25 * c[k]);
            }
        }
    }
    out
}
