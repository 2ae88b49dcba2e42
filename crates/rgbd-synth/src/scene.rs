//! Light and shade: from the triangles that pixels see to colours, depths and labels.

use crate::raster::{self, Hits, Placed};
use crate::{Backdrop, Object};
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use rayon::prelude::*;
use rgbd_io::Intrinsics;

/// One light far away, ambient light, and the shine of all surfaces; fixed in the camera frame, so that the shading
/// of a body changes while it turns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Light {
    /// Towards the light, camera frame; need not be of unit length.
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

/// A body's surface as seen at one place of the image.
struct Sample {
    point: [f32; 3],
    normal: Vector3<f32>,
    ray: Vector3<f32>,
    body: usize,
}

struct Shader<'a> {
    bodies: &'a [Body<'a>],
    /// First triangle of each body, and the number of all.
    starts: Vec<u32>,
    body_from_cam: Vec<Isometry3<f32>>,
    cam_from_body: Vec<UnitQuaternion<f32>>,
    light: Light,
}

/// Renders `bodies` before `backdrop`: depth, cosine and label at the pixel centres, colour as the mean of four
/// samples a pixel.
pub(crate) fn render(camera: &Camera, bodies: &[Body<'_>], light: &Light, backdrop: &Clean) -> Clean {
    let shader = Shader::new(bodies, light);
    let mut out = backdrop.clone();
    let hits = raster::draw(&camera.k, camera.width, camera.height, &shader.placed());
    let [left, top] = hits.corner;
    let (skip, rows) = (top * camera.width, camera.width);
    out.depth[skip..]
        .par_chunks_mut(rows)
        .zip(out.cosine[skip..].par_chunks_mut(rows))
        .zip(out.label[skip..].par_chunks_mut(rows))
        .enumerate()
        .take(hits.size[1])
        .for_each(|(y, ((depth, cosine), label))| {
            for x in left..left + hits.size[0] {
                let Some((z, id)) = hits.at(x, top + y) else { continue };
                if z < depth[x] {
                    let s = shader.sample(&camera.k, [x, top + y], z, id);
                    depth[x] = z;
                    cosine[x] = -s.normal.dot(&s.ray);
                    label[x] = bodies[s.body].label;
                }
            }
        });
    shader.paint(camera, &backdrop.depth, &mut out.color);
    out
}

/// The colour alone, for the further exposures of a blurred frame.
pub(crate) fn render_color(
    camera: &Camera,
    bodies: &[Body<'_>],
    light: &Light,
    backdrop: &Clean,
) -> Vec<[f32; 3]> {
    let mut color = backdrop.color.clone();
    Shader::new(bodies, light).paint(camera, &backdrop.depth, &mut color);
    color
}

/// What would be seen of `body` at the pixel centres if nothing else were there.
pub(crate) fn silhouette(camera: &Camera, body: &Body<'_>) -> Hits {
    let placed = Placed { mesh: body.object.mesh(), cam_from_mesh: body.cam_from_body };
    raster::draw(&camera.k, camera.width, camera.height, &[placed])
}

impl<'a> Shader<'a> {
    fn new(bodies: &'a [Body<'a>], light: &Light) -> Self {
        let mut starts = vec![0u32];
        for body in bodies {
            starts.push(starts[starts.len() - 1] + body.object.mesh().triangles.len() as u32);
        }
        let body_from_cam = bodies.iter().map(|b| b.cam_from_body.inverse().cast()).collect();
        let cam_from_body = bodies.iter().map(|b| b.cam_from_body.rotation.cast()).collect();
        Self { bodies, starts, body_from_cam, cam_from_body, light: *light }
    }

    fn placed(&self) -> Vec<Placed<'a>> {
        self.bodies.iter().map(|b| Placed { mesh: b.object.mesh(), cam_from_mesh: b.cam_from_body }).collect()
    }

    /// Paints the bodies where they are nearer than `behind` (metres); a pixel is the mean of four samples.
    fn paint(&self, camera: &Camera, behind: &[f32], color: &mut [[f32; 3]]) {
        let k = camera.k.scaled(2.0, 2.0);
        let hits = raster::draw(&k, 2 * camera.width, 2 * camera.height, &self.placed());
        let [left, top] = hits.corner.map(|v| v / 2);
        let end = |axis: usize| (hits.corner[axis] + hits.size[axis]).div_ceil(2);
        let width = camera.width;
        color[top * width..].par_chunks_mut(width).enumerate().take(end(1) - top).for_each(|(y, row)| {
            let y = y + top;
            for x in left..end(0) {
                let ground = (row[x], behind[y * width + x]);
                let at = |dx: usize, dy: usize| self.seen(&k, &hits, [2 * x + dx, 2 * y + dy], ground);
                let (a, b) = (at(0, 0), at(1, 1));
                // Where two opposite samples agree, the other two would too.
                let mean = |a: [f32; 3], b: [f32; 3]| std::array::from_fn(|k| 0.5 * (a[k] + b[k]));
                let close = (0..3).all(|k| (a.0[k] - b.0[k]).abs() < 0.04);
                row[x] = if a.1 == b.1 && close {
                    mean(a.0, b.0)
                } else {
                    mean(mean(a.0, b.0), mean(at(1, 0).0, at(0, 1).0))
                };
            }
        });
    }

    /// Colour at a sample, and the body it belongs to; the ground's `(colour, depth)` where no body is nearer.
    fn seen(
        &self,
        k: &Intrinsics,
        hits: &Hits,
        [x, y]: [usize; 2],
        ground: ([f32; 3], f32),
    ) -> ([f32; 3], Option<usize>) {
        match hits.at(x, y) {
            Some((z, id)) if z < ground.1 => {
                let sample = self.sample(k, [x, y], z, id);
                (self.shade(&sample), Some(sample.body))
            }
            _ => (ground.0, None),
        }
    }

    /// The point of triangle `id` that pixel `(x, y)` sees at depth `z`, with its interpolated normal.
    fn sample(&self, k: &Intrinsics, [x, y]: [usize; 2], z: f32, id: u32) -> Sample {
        let body = self.starts.partition_point(|&s| s <= id) - 1;
        let mesh = self.bodies[body].object.mesh();
        let corners = mesh.triangles[(id - self.starts[body]) as usize];
        let seen = Vector3::from(k.unproject(x as f64, y as f64, f64::from(z)).map(|v| v as f32));
        let p = self.body_from_cam[body] * Point3::from(seen);
        let [a, b, c] = corners.map(|v| Point3::from(mesh.vertices[v as usize]));
        let [na, nb, nc] = corners.map(|v| Vector3::from(mesh.normals[v as usize]));
        let flat = (b - a).cross(&(c - a));
        let scale = 1.0 / flat.norm_squared().max(1e-30);
        let wb = (p - a).cross(&(c - a)).dot(&flat) * scale;
        let wc = (b - a).cross(&(p - a)).dot(&flat) * scale;
        let (wb, wc) = (wb.clamp(0.0, 1.0), wc.clamp(0.0, 1.0));
        let normal = na * (1.0 - wb - wc) + nb * wb + nc * wc;
        let normal = self.cam_from_body[body] * normal;
        let ray = seen.normalize();
        // An interpolated normal may look away at the rim.
        let normal = normal.try_normalize(0.0).unwrap_or(-ray);
        Sample { point: p.coords.into(), normal, ray, body }
    }

    fn shade(&self, s: &Sample) -> [f32; 3] {
        let local = self.body_from_cam[s.body].rotation * s.normal;
        let albedo = self.bodies[s.body].object.texture().color(s.point, local.into());
        shade(&self.light, albedo, s.normal, s.ray)
    }
}

/// Lambert's shading with a highlight; `ray` points away from the camera.
pub(crate) fn shade(light: &Light, albedo: [f32; 3], normal: Vector3<f32>, ray: Vector3<f32>) -> [f32; 3] {
    let towards = Vector3::from(light.direction).try_normalize(0.0).unwrap_or(-ray);
    let lambert = normal.dot(&towards).max(0.0);
    let half = (towards - ray).try_normalize(0.0).unwrap_or(towards);
    let shine = light.specular * normal.dot(&half).max(0.0).powi(30);
    albedo.map(|c| c * (light.ambient + light.diffuse * lambert) + shine)
}

/// The backdrop with its furniture, rendered once a sequence.
pub(crate) fn backdrop(camera: &Camera, backdrop: &Backdrop, light: &Light) -> Clean {
    let bare = backdrop.render(camera, light);
    let bodies: Vec<Body<'_>> = backdrop
        .furniture
        .iter()
        .map(|(object, pose)| Body { object, cam_from_body: *pose, label: 0 })
        .collect();
    render(camera, &bodies, light, &bare)
}
