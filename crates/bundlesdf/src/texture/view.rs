//! What is known about a view before anything is taken from it.

use marching_cubes::TriMesh;
use nalgebra::{Isometry3, Point3};
use rayon::prelude::*;
use rgbd_io::{Image, Intrinsics};

use super::View;
use crate::depth::depth_sigma;
use crate::raster::cover;

/// Depth steps larger than this (metres) are outlines of the object against itself.
const STEP: f32 = 0.012;
/// Measured depth may differ from the mesh by this and three standard deviations of the sensor (metres).
const SLACK: f64 = 0.008;
/// Depth residual (metres) at which a view counts half.
const RESIDUAL: f64 = 0.004;
/// Pixels that are kept around the object.
const MARGIN: usize = 4;
/// Added to brightness (0 to 255) before its logarithm is taken: noise in the dark is no contrast.
const DARK: f32 = 8.0;
/// A pixel where the mesh isn't seen.
const NOTHING: f32 = f32::INFINITY;

/// The part of a view around the object.
pub(super) struct Prepared {
    /// RGB, 0 to 255.
    pub(super) color: Image<[f32; 3]>,
    /// The colour, blurred a little within the usable pixels.
    pub(super) fine: Image<[f32; 3]>,
    /// Pixels to the nearest one that can't be used; 0 where the pixel itself can't.
    pub(super) inset: Image<f32>,
    /// Depth of the mesh, metres; infinite where it isn't.
    surface: Image<f32>,
    k: Intrinsics,
    cam_from_obj: Isometry3<f64>,
    eye: Point3<f64>,
    /// Quality of the whole view: sharpness and depth residual; 1 is good.
    pub(super) quality: f32,
}

/// A surface point as a view sees it.
pub(super) struct Sight {
    /// Pixel in the part around the object.
    pub(super) pixel: [f32; 2],
    /// Cosine between the surface's normal and the direction to the camera.
    pub(super) cosine: f32,
    /// Pixels per metre on a surface that faces the camera.
    pub(super) density: f32,
    /// Pixels to the border of what can be used.
    pub(super) inset: f32,
}

/// Prepares all views; one that doesn't see the mesh at all has no pixels.
pub(super) fn prepare(mesh: &TriMesh, views: &[View]) -> Vec<Prepared> {
    let mut prepared: Vec<_> = views.par_iter().map(|view| Prepared::new(mesh, view)).collect();
    // Sharpness means something only next to that of the other views.
    let mut sorted: Vec<f32> =
        prepared.iter().map(|(_, sharpness)| *sharpness).filter(|s| *s > 0.0).collect();
    sorted.sort_unstable_by(f32::total_cmp);
    let median = sorted.get(sorted.len() / 2).copied().unwrap_or(1.0);
    for (view, sharpness) in &mut prepared {
        view.quality *= (*sharpness / median).clamp(0.2, 1.5);
    }
    prepared.into_iter().map(|(view, _)| view).collect()
}

/// Prepares the views with `obj_from_cam <- correction * obj_from_cam`.
pub(super) fn prepare_corrected(
    mesh: &TriMesh,
    views: &[View],
    corrections: &[Isometry3<f64>],
) -> Vec<Prepared> {
    let corrected = views.iter().zip(corrections);
    let corrected = corrected.map(|(view, c)| View { obj_from_cam: c * view.obj_from_cam, ..view.clone() });
    prepare(mesh, &corrected.collect::<Vec<_>>())
}

impl Prepared {
    /// The view and its sharpness (mean squared Laplacian over the pixels' variance).
    fn new(mesh: &TriMesh, view: &View) -> (Self, f32) {
        let corner = crop_of(view);
        let [x0, y0, width, height] = corner;
        let k = view.intrinsics.cropped(x0, y0);
        let cam_from_obj = view.obj_from_cam.inverse();
        let surface = depth_of(mesh, &k, &cam_from_obj, width, height);
        let measured = Image::from_fn(width, height, |x, y| view.depth[(x0 + x, y0 + y)]);
        let usable = Image::from_fn(width, height, |x, y| {
            view.mask[(x0 + x, y0 + y)] != 0
                && agrees(measured[(x, y)], surface[(x, y)])
                && !is_step(&surface, x, y)
        });
        let color = Image::from_fn(width, height, |x, y| view.color[(x0 + x, y0 + y)].map(f32::from));
        let fine = blurred(&color, &usable, 1);
        let sharpness = sharpness(&color, &usable);
        let residual = residual(&measured, &surface, &usable);
        let view = Self {
            color,
            fine,
            inset: insets(&usable),
            surface,
            k,
            cam_from_obj,
            eye: Point3::from(view.obj_from_cam.translation.vector),
            quality: (1.0 / (1.0 + (residual / RESIDUAL).powi(2))) as f32,
        };
        (view, sharpness)
    }

    pub(super) fn intrinsics(&self) -> &Intrinsics {
        &self.k
    }

    pub(super) fn cam_from_obj(&self) -> Isometry3<f64> {
        self.cam_from_obj
    }

    /// How the surface point `p` with normal `n` is seen; `None` when it is hidden, out of the image or seen from
    /// behind.
    pub(super) fn sight(&self, p: [f32; 3], n: [f32; 3]) -> Option<Sight> {
        let p = Point3::from(p.map(f64::from));
        let ray = self.eye - p;
        let cosine =
            (ray.x * f64::from(n[0]) + ray.y * f64::from(n[1]) + ray.z * f64::from(n[2])) / ray.norm();
        let q = self.cam_from_obj * p;
        let [u, v] = self.k.project(q.coords.into())?;
        let (width, height) = self.inset.size();
        let inside =
            cosine > 0.05 && u >= 0.0 && v >= 0.0 && u <= width as f64 - 1.0 && v <= height as f64 - 1.0;
        if !inside {
            return None;
        }
        let (x, y) = (u.round() as usize, v.round() as usize);
        // The buffer holds the depth of pixel centres: on a slope the farthest of the neighbours counts.
        let farthest = around(width, height, x, y).map(|at| self.surface[at]).filter(|z| *z < NOTHING);
        let farthest = farthest.fold(0.0, f32::max);
        if q.z > f64::from(farthest) + 0.002 {
            return None;
        }
        Some(Sight {
            pixel: [u as f32, v as f32],
            cosine: cosine as f32,
            density: (self.k.fx / q.z) as f32,
            inset: self.inset[(x, y)],
        })
    }

    /// The pixel on which an object point falls, if it is a usable one.
    pub(super) fn project(&self, p: [f64; 3]) -> Option<[f32; 2]> {
        let q = self.cam_from_obj * Point3::from(p);
        let [u, v] = self.k.project(q.coords.into())?;
        // Written so that a NaN fails it.
        let inside = u >= 0.0 && v >= 0.0;
        let (x, y) = inside.then(|| (u.round() as usize, v.round() as usize))?;
        (*self.inset.get(x, y)? > 0.0).then_some([u as f32, v as f32])
    }
}

/// Bilinear value at a pixel inside the image.
pub(super) fn bilinear(image: &Image<[f32; 3]>, [u, v]: [f32; 2]) -> [f32; 3] {
    let (width, height) = image.size();
    let (x, y) = ((u.max(0.0) as usize).min(width - 1), (v.max(0.0) as usize).min(height - 1));
    let (s, t) = ((u - x as f32).clamp(0.0, 1.0), (v - y as f32).clamp(0.0, 1.0));
    let (right, below) = ((x + 1).min(width - 1), (y + 1).min(height - 1));
    let (a, b, c, d) = (image[(x, y)], image[(right, y)], image[(x, below)], image[(right, below)]);
    std::array::from_fn(|k| {
        let top = a[k] + s * (b[k] - a[k]);
        top + t * (c[k] + s * (d[k] - c[k]) - top)
    })
}

/// Logarithm of a view's brightness, blurred within its usable pixels.
pub(super) fn log_brightness(view: &Prepared, radius: usize) -> Image<f32> {
    let usable = view.inset.map(|d| *d > 0.0);
    blurred(&view.color, &usable, radius).map(|[r, g, b]| (0.299 * r + 0.587 * g + 0.114 * b + DARK).ln())
}

/// Left, top, width and height of the mask with a margin; at least one pixel.
fn crop_of(view: &View) -> [usize; 4] {
    let (width, height) = view.mask.size();
    let mut bounds = [usize::MAX, usize::MAX, 0, 0];
    for y in 0..height {
        for (x, _) in view.mask.row(y).iter().enumerate().filter(|(_, m)| **m != 0) {
            bounds = [bounds[0].min(x), bounds[1].min(y), bounds[2].max(x), bounds[3].max(y)];
        }
    }
    if bounds[0] > bounds[2] {
        return [0, 0, 1, 1];
    }
    let (x0, y0) = (bounds[0].saturating_sub(MARGIN), bounds[1].saturating_sub(MARGIN));
    [x0, y0, (bounds[2] + MARGIN + 1).min(width) - x0, (bounds[3] + MARGIN + 1).min(height) - y0]
}

/// Depth buffer of the mesh.
fn depth_of(
    mesh: &TriMesh,
    k: &Intrinsics,
    pose: &Isometry3<f64>,
    width: usize,
    height: usize,
) -> Image<f32> {
    let mut buffer = Image::filled(width, height, NOTHING);
    let points: Vec<_> = mesh
        .vertices
        .iter()
        .map(|p| {
            let q = pose * Point3::from(p.map(f64::from));
            k.project(q.coords.into()).map(|uv| (uv, 1.0 / q.z))
        })
        .collect();
    for t in &mesh.triangles {
        let [Some(a), Some(b), Some(c)] = t.map(|i| points[i as usize]) else { continue };
        cover([a.0, b.0, c.0], width, height, |x, y, w| {
            let z = (1.0 / (w[0] * a.1 + w[1] * b.1 + w[2] * c.1)) as f32;
            let nearest = &mut buffer[(x, y)];
            *nearest = nearest.min(z);
        });
    }
    buffer
}

/// Whether a measured depth can be that of the mesh; without a measurement or mesh nothing speaks against it.
fn agrees(measured: f32, surface: f32) -> bool {
    if measured <= 0.0 || surface == NOTHING {
        return true;
    }
    let z = f64::from(measured);
    (z - f64::from(surface)).abs() <= SLACK + 3.0 * depth_sigma(z)
}

fn around(width: usize, height: usize, x: usize, y: usize) -> impl Iterator<Item = (usize, usize)> {
    let columns = x.saturating_sub(1)..(x + 2).min(width);
    (y.saturating_sub(1)..(y + 2).min(height)).flat_map(move |v| columns.clone().map(move |u| (u, v)))
}

/// Whether the mesh's depth jumps next to the pixel.
fn is_step(surface: &Image<f32>, x: usize, y: usize) -> bool {
    let here = surface[(x, y)];
    let (width, height) = surface.size();
    here < NOTHING && around(width, height, x, y).any(|at| (surface[at] - here).abs() > STEP)
}

/// Mean over the usable pixels in a window, three times: close to a Gaussian. Where no usable pixel is near, the
/// nearest row of what is known stays.
fn blurred(image: &Image<[f32; 3]>, usable: &Image<bool>, radius: usize) -> Image<[f32; 3]> {
    let (width, height) = image.size();
    let mut values: Vec<[f32; 4]> = image
        .pixels()
        .iter()
        .zip(usable.pixels())
        .map(|(c, &u)| if u { [c[0], c[1], c[2], 1.0] } else { [0.0; 4] })
        .collect();
    for _ in 0..3 {
        values = transposed_mean(&values, width, height, radius);
        values = transposed_mean(&values, height, width, radius);
    }
    let mut values = values.into_iter().zip(image.pixels());
    Image::from_fn(width, height, |_, _| match values.next() {
        Some(([r, g, b, w], _)) if w > 1e-4 => [r / w, g / w, b / w],
        Some((_, c)) => *c,
        None => [0.0; 3],
    })
}

/// Running mean along the rows, written as columns.
fn transposed_mean(values: &[[f32; 4]], width: usize, height: usize, radius: usize) -> Vec<[f32; 4]> {
    let mut out = vec![[0.0; 4]; values.len()];
    let scale = 1.0 / (2 * radius + 1) as f32;
    for y in 0..height {
        let row = &values[y * width..(y + 1) * width];
        let mut sum = [0.0f32; 4];
        let mut change = |x: usize, sign: f32| {
            if let Some(v) = row.get(x) {
                (0..4).for_each(|k| sum[k] += sign * v[k]);
            }
            sum
        };
        (0..radius).for_each(|x| {
            change(x, 1.0);
        });
        for x in 0..width {
            let mut now = change(x + radius, 1.0);
            if let Some(left) = x.checked_sub(radius + 1) {
                now = change(left, -1.0);
            }
            out[x * height + y] = now.map(|v| v * scale);
        }
    }
    out
}

fn sharpness(color: &Image<[f32; 3]>, usable: &Image<bool>) -> f32 {
    let (width, height) = color.size();
    let green = |x: usize, y: usize| color[(x, y)][1];
    let (mut edges, mut sum, mut squares, mut count) = (0.0f64, 0.0f64, 0.0f64, 0.0f64);
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            if !around(width, height, x, y).all(|at| usable[at]) {
                continue;
            }
            let c = green(x, y);
            let laplacian = 4.0 * c - green(x - 1, y) - green(x + 1, y) - green(x, y - 1) - green(x, y + 1);
            edges += f64::from(laplacian * laplacian);
            sum += f64::from(c);
            squares += f64::from(c * c);
            count += 1.0;
        }
    }
    let variance = squares - sum * sum / count;
    if count > 0.0 && variance > 0.0 { (edges / variance).sqrt() as f32 } else { 0.0 }
}

/// Median distance of measured depth and mesh, metres; that of half-trusted views when nothing can be compared.
fn residual(measured: &Image<f32>, surface: &Image<f32>, usable: &Image<bool>) -> f64 {
    let pairs = measured.pixels().iter().zip(surface.pixels()).zip(usable.pixels());
    let mut gaps: Vec<f32> = pairs
        .filter(|((m, s), u)| **u && **m > 0.0 && **s < NOTHING)
        .map(|((m, s), _)| (m - s).abs())
        .collect();
    let middle = gaps.len() / 2;
    if gaps.is_empty() {
        return RESIDUAL;
    }
    f64::from(*gaps.select_nth_unstable_by(middle, f32::total_cmp).1)
}

/// Chamfer distance (Borgefors 1986) to the nearest pixel that can't be used; the image's border is one.
fn insets(usable: &Image<bool>) -> Image<f32> {
    const DIAGONAL: f32 = std::f32::consts::SQRT_2;
    let (width, height) = usable.size();
    let mut distance = usable.map(|&u| if u { f32::INFINITY } else { 0.0 });
    let backwards = [(-1i64, 0i64, 1.0), (-1, -1, DIAGONAL), (0, -1, 1.0), (1, -1, DIAGONAL)];
    let mut relax = |x: usize, y: usize, sign: i64| {
        let mut least = distance[(x, y)];
        for (dx, dy, step) in backwards {
            let (u, v) = (x as i64 + sign * dx, y as i64 + sign * dy);
            let inside = u >= 0 && v >= 0 && (u as usize) < width && (v as usize) < height;
            least = least.min(if inside { distance[(u as usize, v as usize)] + step } else { step });
        }
        distance[(x, y)] = least;
    };
    (0..height).for_each(|y| (0..width).for_each(|x| relax(x, y, 1)));
    (0..height).rev().for_each(|y| (0..width).rev().for_each(|x| relax(x, y, -1)));
    distance
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn insets_count_pixels_to_the_border() {
        let usable = Image::from_fn(11, 9, |x, y| (2..9).contains(&x) && (2..7).contains(&y));
        let inset = insets(&usable);
        assert_eq!(inset[(1, 4)], 0.0);
        assert_eq!(inset[(2, 4)], 1.0);
        assert_eq!(inset[(5, 4)], 3.0);
        // The image's own border counts.
        assert_eq!(insets(&Image::filled(5, 5, true))[(2, 2)], 3.0);
    }

    #[test]
    fn blur_stays_within_the_usable_pixels() {
        let usable = Image::from_fn(40, 30, |x, _| x < 20);
        let image = Image::from_fn(40, 30, |x, _| if x < 20 { [50.0, 60.0, 70.0] } else { [255.0; 3] });
        let low = blurred(&image, &usable, 3);
        for x in 0..20 {
            assert!(
                (0..3).all(|k| (low[(x, 15)][k] - [50.0, 60.0, 70.0][k]).abs() < 0.01),
                "{:?}",
                low[(x, 15)]
            );
        }
    }

    #[test]
    fn a_blurred_image_is_less_sharp() {
        let usable = Image::filled(60, 60, true);
        let image = Image::from_fn(60, 60, |x, y| [if (x / 4 + y / 4) % 2 == 0 { 40.0 } else { 200.0 }; 3]);
        let soft = blurred(&image, &usable, 1);
        assert!(sharpness(&soft, &usable) < 0.7 * sharpness(&image, &usable));
    }
}
