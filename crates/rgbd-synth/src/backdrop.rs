//! What stands behind the object: textured planes and furniture.

use crate::raster::Hits;
use crate::scene::{self, Body, Camera, Clean, Lamp};
use crate::{Light, Object, Texture};
use nalgebra::{Isometry3, Point3, Vector3};
use rayon::prelude::*;

/// A textured plane of the world frame (the camera's, unless the camera moves).
#[derive(Clone, Debug)]
pub struct Plane {
    /// Normal, towards the camera's side; unit length.
    pub normal: [f64; 3],
    /// Distance of the plane from the origin, metres: points with `normal . p = -distance`.
    pub distance: f64,
    /// Evaluated at points of the world frame.
    pub texture: Texture,
}

/// The static scene behind the object, in the world frame (the camera's, unless the camera moves).
#[derive(Clone, Debug, Default)]
pub struct Backdrop {
    /// The nearest plane along a ray is seen. Where a ray meets none, depth is `0` and colour grey.
    pub planes: Vec<Plane>,
    /// Things that stand still, with `world_from_body`.
    pub furniture: Vec<(Object, Isometry3<f64>)>,
}

impl Plane {
    /// z-depth (metres) at which the ray `[x, y, 1]` meets the plane in front of the camera.
    pub fn depth_along(&self, ray: [f64; 3]) -> Option<f64> {
        let slope = self.normal[0] * ray[0] + self.normal[1] * ray[1] + self.normal[2] * ray[2];
        let z = -self.distance / slope;
        (z.is_finite() && z > 0.0).then_some(z)
    }
}

impl Backdrop {
    /// The planes alone, as the camera at `cam_from_world` sees them under `light` (camera frame). Rays without a
    /// plane get infinite depth here; the sensor turns that into "missing". `fine` takes up to four colour samples
    /// a pixel.
    pub(crate) fn render(
        &self,
        camera: &Camera,
        cam_from_world: &Isometry3<f64>,
        light: &Light,
        fine: bool,
    ) -> Clean {
        let size = camera.width * camera.height;
        let mut clean = Clean {
            color: vec![[0.5; 3]; size],
            depth: vec![f32::INFINITY; size],
            cosine: vec![1.0; size],
            label: vec![0; size],
        };
        let walls: Vec<Wall<'_>> = self.planes.iter().map(|p| Wall::new(p, cam_from_world, light)).collect();
        let rows = camera.width.max(1);
        clean
            .color
            .par_chunks_mut(rows)
            .zip(clean.depth.par_chunks_mut(rows))
            .zip(clean.cosine.par_chunks_mut(rows))
            .enumerate()
            .for_each(|(y, ((color, depth), cosine))| {
                for x in 0..camera.width {
                    let (u, v) = (x as f64, y as f64);
                    let ray = Vector3::from(camera.k.unproject(u, v, 1.0));
                    let Some((z, wall)) = nearest(&walls, ray) else { continue };
                    depth[x] = z as f32;
                    cosine[x] = -wall.normal.dot(&ray.normalize()) as f32;
                    let sample = |du: f64, dv: f64| {
                        let ray = Vector3::from(camera.k.unproject(u + du, v + dv, 1.0));
                        nearest(&walls, ray).map_or([0.5; 3], |(z, w)| w.color(ray * z))
                    };
                    color[x] = if fine { supersampled(sample) } else { wall.color(ray * z) };
                }
            });
        clean
    }
}

/// The depth of the backdrop alone, for single pixels.
pub(crate) struct Behind<'a> {
    walls: Vec<Wall<'a>>,
    furniture: Vec<Hits>,
    camera: Camera,
}

impl<'a> Behind<'a> {
    pub(crate) fn new(backdrop: &'a Backdrop, camera: Camera, cam_from_world: &Isometry3<f64>) -> Self {
        let walls = backdrop.planes.iter().map(|p| Wall::new(p, cam_from_world, &Light::default())).collect();
        let furniture = backdrop.furniture.iter().map(|(object, pose)| {
            let body = Body { object, cam_from_body: cam_from_world * pose, label: 0 };
            scene::silhouette(&camera, &body)
        });
        Self { walls, furniture: furniture.collect(), camera }
    }

    /// z-depth at the centre of pixel `(x, y)`, metres; infinite where nothing is.
    pub(crate) fn at(&self, x: usize, y: usize) -> f32 {
        let ray = Vector3::from(self.camera.k.unproject(x as f64, y as f64, 1.0));
        let wall = nearest(&self.walls, ray).map_or(f32::INFINITY, |(z, _)| z as f32);
        self.furniture.iter().filter_map(|h| h.at(x, y)).fold(wall, |near, (z, _)| near.min(z))
    }
}

/// The mean of four samples, or of two opposite ones that agree: the other two would agree with them.
fn supersampled(sample: impl Fn(f64, f64) -> [f32; 3]) -> [f32; 3] {
    let mean = |a: [f32; 3], b: [f32; 3]| std::array::from_fn::<f32, 3, _>(|k| 0.5 * (a[k] + b[k]));
    let (a, b) = (sample(-0.25, -0.25), sample(0.25, 0.25));
    if (0..3).all(|k| (a[k] - b[k]).abs() < 0.03) {
        return mean(a, b);
    }
    mean(mean(a, b), mean(sample(0.25, -0.25), sample(-0.25, 0.25)))
}

/// A plane as one camera sees it.
struct Wall<'a> {
    plane: Plane,
    texture: &'a Texture,
    normal: Vector3<f64>,
    world_from_cam: Isometry3<f64>,
    world_normal: [f32; 3],
    /// Light on it, the same everywhere: walls are matt and the light is far away.
    level: f32,
}

impl<'a> Wall<'a> {
    fn new(plane: &'a Plane, cam_from_world: &Isometry3<f64>, light: &Light) -> Self {
        let normal = cam_from_world.rotation * Vector3::from(plane.normal);
        let distance = plane.distance - normal.dot(&cam_from_world.translation.vector);
        Self {
            plane: Plane { normal: normal.into(), distance, texture: Texture::plain([0.5; 3]) },
            texture: &plane.texture,
            normal,
            world_from_cam: cam_from_world.inverse(),
            world_normal: plane.normal.map(|v| v as f32),
            level: Lamp::new(light).matt([1.0; 3], normal.cast())[0],
        }
    }

    /// Colour at a point of the camera frame.
    fn color(&self, p: Vector3<f64>) -> [f32; 3] {
        let p = self.world_from_cam * Point3::from(p);
        let albedo = self.texture.color(p.coords.map(|v| v as f32).into(), self.world_normal);
        albedo.map(|c| c * self.level)
    }
}

fn nearest<'a, 'b>(walls: &'b [Wall<'a>], ray: Vector3<f64>) -> Option<(f64, &'b Wall<'a>)> {
    walls
        .iter()
        .filter_map(|w| w.plane.depth_along(ray.into()).map(|z| (z, w)))
        .min_by(|a, b| a.0.total_cmp(&b.0))
}
