//! Which parts of a surface a video has seen.

use crate::MeshRef;
use crate::pose::is_finite;
use nalgebra::{Isometry3, Point3};

/// A pinhole camera: pixels, OpenCV axes (x right, y down, z forward), pixel centres at integers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Focal lengths, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Principal point, pixels.
    pub cx: f64,
    /// Principal point along y, pixels.
    pub cy: f64,
    /// Image width, pixels.
    pub width: usize,
    /// Image height, pixels.
    pub height: usize,
}

/// Cells along the longer side of the depth buffer, which covers the object and not the image.
const GRID: f64 = 320.0;
/// Nothing nearer to the camera than this (metres) is drawn.
const NEAR: f64 = 0.01;

/// For each triangle whether any of the views sees it: the rendering test that culls the true surface to what
/// the video shows (paper supplement).
///
/// `cam_from_obj`: poses of the mesh, one per view; those that are not finite are skipped. Only the mesh itself
/// occludes. Triangles count from both sides, so that the winding does not matter.
pub fn visible_faces(mesh: MeshRef<'_>, cam_from_obj: &[Isometry3<f64>], camera: &Camera) -> Vec<bool> {
    let mut seen = vec![false; mesh.triangles.len()];
    let mut buffer = DepthBuffer::default();
    let mut corners = Vec::new();
    for pose in cam_from_obj.iter().filter(|p| is_finite(p)) {
        corners.clear();
        corners.extend(mesh.vertices.iter().map(|v| pixel(camera, pose, v)));
        if !buffer.frame(&corners, camera) {
            continue;
        }
        for (face, triangle) in mesh.triangles.iter().enumerate() {
            if let Some(t) = screen_triangle(&corners, triangle) {
                buffer.draw(face as u32, t);
            }
        }
        buffer.mark_owners(&mut seen);
        // Triangles smaller than a cell own none, but their centres lie on the drawn surface.
        for (face, triangle) in mesh.triangles.iter().enumerate() {
            if !seen[face] {
                seen[face] = screen_triangle(&corners, triangle).is_some_and(|t| buffer.sees_centre(t));
            }
        }
    }
    seen
}

/// Pixel position and depth (metres); `None` in front of the near plane or not finite.
type Corner = Option<[f64; 3]>;

fn pixel(camera: &Camera, pose: &Isometry3<f64>, v: &[f64; 3]) -> Corner {
    let p = pose * Point3::from(*v);
    (p.z > NEAR).then(|| [camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy, p.z])
}

fn screen_triangle(corners: &[Corner], triangle: &[u32; 3]) -> Option<[[f64; 3]; 3]> {
    let corner = |i: usize| corners.get(triangle[i] as usize).copied().flatten();
    Some([corner(0)?, corner(1)?, corner(2)?])
}

/// Inverse depth and owner of each cell of a grid over the object's part of the image.
#[derive(Default)]
struct DepthBuffer {
    width: usize,
    height: usize,
    /// Top left corner, pixels.
    origin: [f64; 2],
    /// Cells per pixel.
    scale: f64,
    /// 1/metres; 0 is empty.
    inverse_depth: Vec<f64>,
    owner: Vec<u32>,
    /// How far (metres) a surface may recede between neighbouring cells.
    slack: f64,
}

impl DepthBuffer {
    /// Fits the grid to the corners within the image, and clears it. False when nothing is in the image.
    fn frame(&mut self, corners: &[Corner], camera: &Camera) -> bool {
        let (mut low, mut high, mut nearest) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2], f64::INFINITY);
        for c in corners.iter().flatten() {
            for k in 0..2 {
                low[k] = low[k].min(c[k]);
                high[k] = high[k].max(c[k]);
            }
            nearest = nearest.min(c[2]);
        }
        let size = [camera.width as f64, camera.height as f64];
        for k in 0..2 {
            low[k] = low[k].max(-0.5);
            high[k] = high[k].min(size[k] - 0.5);
        }
        let extent = [high[0] - low[0], high[1] - low[1]];
        // NaN (a broken camera) fails here too.
        if !(extent[0] > 0.0 && extent[1] > 0.0 && nearest.is_finite()) {
            return false;
        }
        self.scale = GRID / extent[0].max(extent[1]);
        self.width = (extent[0] * self.scale).ceil() as usize;
        self.height = (extent[1] * self.scale).ceil() as usize;
        self.origin = low;
        self.slack = 2.0 * nearest / (self.scale * camera.fx.abs().min(camera.fy.abs()));
        self.inverse_depth.clear();
        self.inverse_depth.resize(self.width * self.height, 0.0);
        self.owner.clear();
        self.owner.resize(self.width * self.height, u32::MAX);
        true
    }

    /// Grid coordinates, cell centres at half-integers, and inverse depth (which is linear in the image).
    fn to_grid(&self, c: [f64; 3]) -> [f64; 3] {
        [(c[0] - self.origin[0]) * self.scale, (c[1] - self.origin[1]) * self.scale, 1.0 / c[2]]
    }

    fn draw(&mut self, face: u32, triangle: [[f64; 3]; 3]) {
        let [a, b, c] = triangle.map(|p| self.to_grid(p));
        let area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
        if area == 0.0 || !area.is_finite() {
            return;
        }
        let span = |k: usize, end: usize| {
            let low = a[k].min(b[k]).min(c[k]);
            let high = a[k].max(b[k]).max(c[k]);
            // Cells whose centre is inside; casts saturate.
            ((low - 0.5).ceil().max(0.0) as usize)..((high + 0.5).floor().clamp(0.0, end as f64) as usize)
        };
        for y in span(1, self.height) {
            for x in span(0, self.width) {
                let p = [x as f64 + 0.5, y as f64 + 0.5];
                let edge = |s: [f64; 3], t: [f64; 3]| {
                    ((t[0] - s[0]) * (p[1] - s[1]) - (t[1] - s[1]) * (p[0] - s[0])) / area
                };
                let (wa, wb, wc) = (edge(b, c), edge(c, a), edge(a, b));
                if wa < 0.0 || wb < 0.0 || wc < 0.0 {
                    continue;
                }
                let inverse = wa * a[2] + wb * b[2] + wc * c[2];
                let cell = y * self.width + x;
                if inverse > self.inverse_depth[cell] {
                    self.inverse_depth[cell] = inverse;
                    self.owner[cell] = face;
                }
            }
        }
    }

    fn mark_owners(&self, seen: &mut [bool]) {
        for &face in &self.owner {
            if let Some(seen) = seen.get_mut(face as usize) {
                *seen = true;
            }
        }
    }

    /// Whether the triangle's centre is not behind the surface drawn in its cell.
    fn sees_centre(&self, triangle: [[f64; 3]; 3]) -> bool {
        let mean = |k: usize| (triangle[0][k] + triangle[1][k] + triangle[2][k]) / 3.0;
        let centre = self.to_grid([mean(0), mean(1), mean(2)]);
        let inside = |v: f64, end: usize| v >= 0.0 && v < end as f64;
        if !inside(centre[0], self.width) || !inside(centre[1], self.height) {
            return false;
        }
        let drawn = self.inverse_depth[centre[1] as usize * self.width + centre[0] as usize];
        drawn > 0.0 && mean(2) <= 1.0 / drawn + self.slack
    }
}
