//! What the tracker keeps of a frame: the object's crop with clean depth, normals and an image pyramid.

use std::{
    borrow::Cow,
    sync::{Arc, OnceLock},
};

use matcher::{
    Features,
    corners::{CornerOptions, detect_corners},
    gray::{Pyramid, Rect, to_gray},
};
use nalgebra::{Isometry3, Point3, Vector3};
use neural_field::FieldImages;
use posegraph::{DenseView, Pinhole};
use rgbd_io::{Image, Intrinsics, Mask, RgbdFrame};

use crate::{
    config::{Config, PreprocessConfig},
    depth,
    quality::Quality,
    zoom::{zoom_bilinear, zoom_for, zoom_nearest},
};

/// Pixels around the mask's box that stay in the crop: context for point tracks and for the field's ring rays.
const MARGIN_SHARE: f64 = 0.18;
pub(crate) const MIN_MARGIN: usize = 12;
/// Points with normals that stand for the whole cloud in visibility tests.
const SAMPLES: usize = 600;

/// The object in one frame; immutable once built and shared between tracker, pool and field.
///
/// Pixel coordinates are those of the crop; [`Observation::intrinsics`] belong to it.
#[derive(Debug)]
pub struct Observation {
    /// Running number of the frame.
    pub index: usize,
    /// Camera of the crop.
    pub intrinsics: Intrinsics,
    /// Top-left pixel of the crop in the working image.
    pub origin: [usize; 2],
    /// How many times the crop is enlarged: point tracks need a small object to be larger than their windows.
    pub zoom: usize,
    /// Object mask after erosion.
    pub mask: Mask,
    /// Camera-frame points (metres) of the object, zero where there is no reading.
    pub points: Image<[f32; 3]>,
    /// Unit normals towards the camera, zero where unknown.
    pub normals: Image<[f32; 3]>,
    /// Gray pyramid of the crop (background included: point tracks need it at the rim).
    pub pyramid: Pyramid,
    /// Downscaled cloud for the dense term.
    pub dense: DenseView,
    /// Colour, depth and mask of the crop for the field.
    pub images: Arc<FieldImages>,
    /// Object pixels with depth, counted in the working image.
    pub valid: usize,
    /// Evenly spread points with normals, camera frame: what visibility tests look at.
    pub samples: Vec<([f32; 3], [f32; 3])>,
    max_corners: usize,
    corners: OnceLock<Vec<[f32; 2]>>,
    features: OnceLock<Features>,
    wide_features: OnceLock<Features>,
    quality: OnceLock<Quality>,
}

/// Why a frame shows too little of the object to be tracked.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Unusable {
    /// Colour, depth and mask are not of one size, or the intrinsics are not finite.
    #[error("colour, depth and mask differ in size, or the intrinsics are invalid")]
    Malformed,
    /// Hardly any mask pixel.
    #[error("the mask has too few pixels")]
    NoMask,
    /// Hardly any depth inside the mask.
    #[error("there is too little depth inside the mask")]
    NoDepth,
}

impl Observation {
    /// Crops, cleans and measures the object in `frame` under `mask` (the size of the frame).
    ///
    /// # Errors
    /// [`Unusable`] when there is nothing to track.
    pub fn new(index: usize, frame: &RgbdFrame, mask: &Mask, config: &Config) -> Result<Self, Unusable> {
        let p = &config.preprocess;
        if frame.color.size() != frame.depth.size()
            || frame.color.size() != mask.size()
            || frame.color.is_empty()
            || !is_plausible(&frame.intrinsics, frame.color.size())
        {
            return Err(Unusable::Malformed);
        }
        let working = WorkingImages::new(frame, mask, p);
        // All of the object, and enough around it to know its border.
        let around = Rect::around_mask(&working.mask, p.mask_erosion).ok_or(Unusable::NoMask)?;
        let eroded = erode(&around.cut(&working.mask), p.mask_erosion);
        let inner = mask_box(&eroded, p.min_mask_pixels).ok_or(Unusable::NoMask)?;
        let [left, top, right, bottom] = inner;
        let bounds = [left + around.x, top + around.y, right + around.x, bottom + around.y];
        let [x0, y0, width, height] = with_margin(bounds, working.mask.size());
        let rect = Rect { x: x0, y: y0, width, height };

        let zoom = zoom_for(bounds);
        let crop_mask = zoom_nearest(recut(&eroded, around, rect), zoom);
        let color = zoom_bilinear(working.color(rect), zoom);
        let raw = zoom_nearest(working.depth(rect), zoom);
        let intrinsics = working.intrinsics.cropped(x0, y0).scaled(zoom as f64, zoom as f64);
        let (width, height) = crop_mask.size();

        let once = depth::smooth(&raw, &crop_mask, p.smoothing_gate);
        let mut clean = depth::smooth(&once, &crop_mask, p.smoothing_gate);
        let mut points = depth::cloud(&clean, &intrinsics);
        let mut normals = depth::normals(&points);
        depth::drop_grazing(&mut clean, &mut points, &mut normals, p.grazing_deg);

        let valid = clean.pixels().iter().filter(|d| **d > 0.0).count() / (zoom * zoom);
        if valid < p.min_mask_pixels / 2 {
            return Err(Unusable::NoDepth);
        }
        let samples = spread_samples(&points, &normals);
        let (valid_pixels, wanted) = (valid * zoom * zoom, config.graph.dense_pixels);
        let dense = downscale(&points, &normals, &intrinsics, valid_pixels, wanted);
        let dense = dense.map_err(|_| Unusable::Malformed)?;
        let pyramid = Pyramid::new(to_gray(&color), pyramid_levels(width, height));
        let mut images = field_images(index, &color, &raw, &clean, &crop_mask, &intrinsics);
        // What was eroded, and a pixel of blur.
        images.mask_margin = ((p.mask_erosion + 1) * zoom) as f32;
        let images = Arc::new(images);
        Ok(Self {
            index,
            intrinsics,
            origin: [x0, y0],
            zoom,
            mask: crop_mask,
            points,
            normals,
            pyramid,
            dense,
            images,
            valid,
            samples,
            // A memory frame must not have other corners than it had as a reference, whoever asks first.
            max_corners: config.coarse.max_corners.max(config.coarse.max_corners_memory),
            corners: OnceLock::new(),
            features: OnceLock::new(),
            wide_features: OnceLock::new(),
            quality: OnceLock::new(),
        })
    }

    /// Trackable corners inside the mask, strongest first, in crop pixels: the first `count` of at most
    /// the larger of `coarse.max_corners` and `coarse.max_corners_memory`.
    pub fn corners(&self, count: usize) -> &[[f32; 2]] {
        let corners = self.corners.get_or_init(|| {
            let max_count = self.max_corners;
            // A small object's corners stand closer, so that it too has enough of them.
            let area = self.mask.pixels().iter().filter(|m| **m != 0).count() as f32;
            let min_distance = (area / (2 * max_count) as f32).sqrt().clamp(2.5, 6.0);
            let options =
                CornerOptions { max_count, min_distance, quality: 0.005, ..CornerOptions::default() };
            detect_corners(&self.pyramid.levels()[0], &self.mask, &options)
        });
        &corners[..corners.len().min(count)]
    }

    /// The roll-invariant descriptor features of this observation, computed by `detect` on first use.
    pub(crate) fn features(&self, detect: impl FnOnce() -> Features) -> &Features {
        self.features.get_or_init(detect)
    }

    /// The features that a network finds in the crop as it is, computed by `detect` on first use.
    pub(crate) fn wide_features(&self, detect: impl FnOnce() -> Features) -> &Features {
        self.wide_features.get_or_init(detect)
    }

    /// How well the object is shown, measured on first use.
    pub fn quality(&self) -> &Quality {
        self.quality.get_or_init(|| Quality::of(self))
    }

    /// Point and normal at a sub-pixel position: bilinear where the four pixels lie on one surface, else nearest.
    pub fn lift(&self, at: [f32; 2]) -> Option<([f32; 3], [f32; 3])> {
        const ONE_SURFACE: f32 = 0.01;
        if !(at[0] >= 0.0 && at[1] >= 0.0) {
            return None;
        }
        let (x, y) = (at[0] as usize, at[1] as usize);
        let nearest = ((at[0] + 0.5) as usize, (at[1] + 0.5) as usize);
        let normal = *self.normals.get(nearest.0, nearest.1)?;
        let corner = |dx, dy| self.points.get(x + dx, y + dy).filter(|p| p[2] > 0.0);
        if let (Some(a), Some(b), Some(c), Some(d)) = (corner(0, 0), corner(1, 0), corner(0, 1), corner(1, 1))
        {
            let depths = [a[2], b[2], c[2], d[2]];
            let (lo, hi) = depths.iter().fold((f32::MAX, f32::MIN), |(lo, hi), z| (lo.min(*z), hi.max(*z)));
            if hi - lo < ONE_SURFACE {
                let (fx, fy) = (at[0] - x as f32, at[1] - y as f32);
                let z = (a[2] * (1.0 - fx) + b[2] * fx) * (1.0 - fy) + (c[2] * (1.0 - fx) + d[2] * fx) * fy;
                let p = self.intrinsics.unproject(f64::from(at[0]), f64::from(at[1]), f64::from(z));
                return Some((p.map(|v| v as f32), normal));
            }
        }
        let p = *self.points.get(nearest.0, nearest.1)?;
        (p[2] > 0.0).then_some((p, normal))
    }

    /// Depth differences below this are noise at the object's distance (metres).
    pub(crate) fn depth_tolerance(&self) -> f64 {
        let depth = self.samples.first().map_or(0.5, |(p, _)| f64::from(p[2]));
        (5.0 * depth::depth_sigma(depth)).max(0.006)
    }

    /// About `count` evenly spread points (camera frame, metres) to compare with a field.
    pub(crate) fn sdf_points(&self, count: usize) -> Vec<[f32; 3]> {
        let step = self.samples.len().div_ceil(count.max(1)).max(1);
        self.samples.iter().step_by(step).map(|(p, _)| *p).collect()
    }

    /// Centre of the bounding box of the cloud in the camera frame, robust against stray readings (2 % at each end).
    pub fn centre(&self) -> Point3<f64> {
        let mut axes: [Vec<f32>; 3] = Default::default();
        for p in self.points.pixels().iter().filter(|p| p[2] > 0.0) {
            for (axis, v) in axes.iter_mut().zip(p) {
                axis.push(*v);
            }
        }
        let middle = |axis: &mut Vec<f32>| {
            if axis.is_empty() {
                return 0.0;
            }
            axis.sort_unstable_by(f32::total_cmp);
            let trim = axis.len() / 50;
            f64::from(axis[trim] + axis[axis.len() - 1 - trim]) / 2.0
        };
        Point3::new(middle(&mut axes[0]), middle(&mut axes[1]), middle(&mut axes[2]))
    }

    /// Share of this observation's sample points that face a camera at `obj_from_camera`, when this one is at
    /// `obj_from_cam`: the visibility ratio of the paper's section 3.3 (no occlusion test).
    pub fn visible_share(
        &self,
        obj_from_cam: &Isometry3<f64>,
        obj_from_camera: &Isometry3<f64>,
        visible_deg: f64,
    ) -> f64 {
        if self.samples.is_empty() {
            return 0.0;
        }
        let limit = visible_deg.to_radians().cos();
        let relative = obj_from_camera.inv_mul(obj_from_cam);
        let facing = self.samples.iter().filter(|(p, n)| {
            let p = relative * Point3::from(Vector3::from(*p).cast::<f64>());
            let n = relative * Vector3::from(*n).cast::<f64>();
            -n.dot(&p.coords) > limit * p.coords.norm()
        });
        facing.count() as f64 / self.samples.len() as f64
    }
}

/// Whether the rays through the image's corners are those of a pinhole camera. A focal length near zero is positive and
/// finite, but the points that it makes of the depth are neither here nor there.
fn is_plausible(k: &Intrinsics, (width, height): (usize, usize)) -> bool {
    /// Tangent of the largest angle from the optical axis, 89.9 degrees.
    const WIDEST: f64 = 1e3;
    let corners = [k.unproject(0.0, 0.0, 1.0), k.unproject(width as f64, height as f64, 1.0)];
    // Also false for NaN.
    k.is_valid() && corners.iter().flatten().all(|v| v.abs() <= WIDEST)
}

/// The frame at working resolution: images are made where they are asked for, because the object is a small part.
struct WorkingImages<'a> {
    frame: &'a RgbdFrame,
    mask: Cow<'a, Mask>,
    intrinsics: Intrinsics,
    /// Pixels of the frame to one of these, in both directions.
    factor: usize,
    depth_range: [f32; 2],
}

impl<'a> WorkingImages<'a> {
    fn new(frame: &'a RgbdFrame, mask: &'a Mask, p: &PreprocessConfig) -> Self {
        let (width, height) = frame.color.size();
        let factor = (width.min(height) / p.working_side).max(1);
        let mut working = Self {
            frame,
            mask: Cow::Borrowed(mask),
            intrinsics: frame.intrinsics,
            factor,
            depth_range: [p.min_depth, p.max_depth],
        };
        if factor > 1 {
            let (all, centre) =
                (Rect { x: 0, y: 0, width: width / factor, height: height / factor }, factor / 2);
            let shift = centre as f64 - (factor as f64 - 1.0) / 2.0;
            working.intrinsics = frame.intrinsics.scaled(1.0 / factor as f64, 1.0 / factor as f64);
            working.intrinsics.cx -= shift / factor as f64;
            working.intrinsics.cy -= shift / factor as f64;
            working.mask = Cow::Owned(working.nearest(mask, all));
        }
        working
    }

    fn color(&self, rect: Rect) -> Image<[u8; 3]> {
        let (color, f) = (&self.frame.color, self.factor);
        if f == 1 {
            return rect.cut(color);
        }
        let mean = |x: usize, y: usize| block_mean(color, (rect.x + x) * f, (rect.y + y) * f, f);
        Image::from_fn(rect.width, rect.height, mean)
    }

    fn depth(&self, rect: Rect) -> Image<f32> {
        let [least, most] = self.depth_range;
        self.nearest(&self.frame.depth, rect).map(|d| if *d >= least && *d <= most { *d } else { 0.0 })
    }

    /// Depth and mask are taken from the pixel nearest to the block's centre: averaging would invent surfaces.
    fn nearest<T: Copy + Default>(&self, image: &Image<T>, rect: Rect) -> Image<T> {
        let (f, centre) = (self.factor, self.factor / 2);
        if f == 1 {
            return rect.cut(image);
        }
        let pixel = |x: usize, y: usize| image[((rect.x + x) * f + centre, (rect.y + y) * f + centre)];
        Image::from_fn(rect.width, rect.height, pixel)
    }
}

fn block_mean(color: &Image<[u8; 3]>, x0: usize, y0: usize, factor: usize) -> [u8; 3] {
    let mut sum = [0_u32; 3];
    for y in y0..y0 + factor {
        for c in &color.row(y)[x0..x0 + factor] {
            for i in 0..3 {
                sum[i] += u32::from(c[i]);
            }
        }
    }
    sum.map(|s| (s / (factor * factor) as u32) as u8)
}

/// Takes `radius` pixels off the mask's border (square structuring element; the image's border is not background).
fn erode(mask: &Mask, radius: usize) -> Mask {
    let (width, height) = mask.size();
    let rows = Image::from_fn(width, height, |x, y| {
        let row = mask.row(y);
        u8::from(row[x.saturating_sub(radius)..(x + radius + 1).min(width)].iter().all(|m| *m != 0))
    });
    Image::from_fn(width, height, |x, y| {
        let all = (y.saturating_sub(radius)..(y + radius + 1).min(height)).all(|yy| rows[(x, yy)] != 0);
        if all { 255 } else { 0 }
    })
}

/// `[x0, y0, x1, y1]` (inclusive) of the mask, if it has at least `min_pixels`.
fn mask_box(mask: &Mask, min_pixels: usize) -> Option<[usize; 4]> {
    let mut bounds = [usize::MAX, usize::MAX, 0, 0];
    let mut count = 0;
    for y in 0..mask.height() {
        for (x, _) in mask.row(y).iter().enumerate().filter(|(_, m)| **m != 0) {
            bounds = [bounds[0].min(x), bounds[1].min(y), bounds[2].max(x), bounds[3].max(y)];
            count += 1;
        }
    }
    (count > 0 && count >= min_pixels).then_some(bounds)
}

/// The box with its margin, as `[x0, y0, width, height]` inside the image.
fn with_margin([x0, y0, x1, y1]: [usize; 4], (width, height): (usize, usize)) -> [usize; 4] {
    let margin = (((x1 - x0).max(y1 - y0) as f64 * MARGIN_SHARE) as usize).max(MIN_MARGIN);
    let (left, top) = (x0.saturating_sub(margin), y0.saturating_sub(margin));
    let (right, bottom) = ((x1 + margin + 1).min(width), (y1 + margin + 1).min(height));
    [left, top, right - left, bottom - top]
}

/// The part `wanted` of an image of which `part`, at `at`, is all that isn't zero.
fn recut(part: &Mask, at: Rect, wanted: Rect) -> Mask {
    let mut cut = Image::filled(wanted.width, wanted.height, 0);
    let (left, right) = (at.x.max(wanted.x), (at.x + at.width).min(wanted.x + wanted.width));
    for y in at.y.max(wanted.y)..(at.y + at.height).min(wanted.y + wanted.height) {
        let start = (y - wanted.y) * wanted.width;
        if left < right {
            let row = &part.row(y - at.y)[left - at.x..right - at.x];
            cut.pixels_mut()[start + left - wanted.x..start + right - wanted.x].copy_from_slice(row);
        }
    }
    cut
}

fn pyramid_levels(width: usize, height: usize) -> usize {
    match width.min(height) {
        0..48 => 2,
        48..96 => 3,
        _ => 4,
    }
}

fn spread_samples(points: &Image<[f32; 3]>, normals: &Image<[f32; 3]>) -> Vec<([f32; 3], [f32; 3])> {
    let usable = |(p, n): &(&[f32; 3], &[f32; 3])| p[2] > 0.0 && depth::dot(**n, **n) > 0.0;
    let pairs = || points.pixels().iter().zip(normals.pixels()).filter(usable);
    let step = pairs().count().div_ceil(SAMPLES).max(1);
    pairs().step_by(step).map(|(p, n)| (*p, *n)).collect()
}

/// Every `step`-th pixel of the cloud, so that about `wanted` valid ones remain.
fn downscale(
    points: &Image<[f32; 3]>,
    normals: &Image<[f32; 3]>,
    k: &Intrinsics,
    valid: usize,
    wanted: usize,
) -> Result<DenseView, posegraph::Error> {
    let step = ((valid as f64 / wanted as f64).sqrt().round() as usize).max(1);
    let half = step / 2;
    let (width, height) = ((points.width() - half).div_ceil(step), (points.height() - half).div_ceil(step));
    let pick = |image: &Image<[f32; 3]>| {
        Image::from_fn(width, height, |x, y| image[(x * step + half, y * step + half)]).into_pixels()
    };
    let scale = step as f64;
    let (cx, cy) = ((k.cx - half as f64) / scale, (k.cy - half as f64) / scale);
    let camera = Pinhole { fx: k.fx / scale, fy: k.fy / scale, cx, cy };
    DenseView::new((width, height), camera, &pick(points), &pick(normals))
}

/// Clean depth inside the mask, the sensor's own outside it: the field's ring rays see the background with it.
fn field_images(
    index: usize,
    color: &Image<[u8; 3]>,
    raw: &Image<f32>,
    clean: &Image<f32>,
    mask: &Mask,
    k: &Intrinsics,
) -> FieldImages {
    let depth = clean
        .pixels()
        .iter()
        .zip(raw.pixels())
        .zip(mask.pixels())
        .map(|((clean, raw), m)| if *m != 0 { *clean } else { *raw })
        .collect();
    FieldImages {
        id: index as u64,
        width: color.width(),
        height: color.height(),
        fx: k.fx,
        fy: k.fy,
        cx: k.cx,
        cy: k.cy,
        color: color.pixels().to_vec(),
        depth,
        mask: mask.pixels().to_vec(),
        mask_margin: 0.0,
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    #[test]
    fn the_crop_is_that_of_the_whole_image_eroded() {
        let config = Config::default();
        let (frame, _) = flat_frame(120, 90);
        // In the middle, and cut off by the image's borders.
        for (x0, y0, radius) in [(60, 45, 20), (4, 50, 25), (116, 86, 30), (60, 45, 200)] {
            let mask = Image::from_fn(120, 90, |x, y| {
                255 * u8::from(x.abs_diff(x0).pow(2) + y.abs_diff(y0).pow(2) < radius * radius)
            });
            let o = Observation::new(0, &frame, &mask, &config).unwrap();
            let (whole, width) = (erode(&mask, config.preprocess.mask_erosion), o.mask.width());
            for (k, m) in o.mask.pixels().iter().enumerate() {
                let at = [k % width / o.zoom + o.origin[0], k / width / o.zoom + o.origin[1]];
                assert_eq!(*m, whole[(at[0], at[1])], "{at:?}");
            }
            let count = |mask: &Mask| mask.pixels().iter().filter(|m| **m != 0).count();
            assert_eq!(count(&o.mask), count(&whole) * o.zoom * o.zoom);
        }
    }

    pub(crate) fn flat_frame(width: usize, height: usize) -> (RgbdFrame, Mask) {
        let frame = RgbdFrame {
            id: "0".into(),
            color: Image::from_fn(width, height, |x, y| [(x * 7 % 251) as u8, (y * 13 % 241) as u8, 90]),
            depth: Image::filled(width, height, 0.5),
            mask: None,
            intrinsics: Intrinsics { fx: 120.0, fy: 130.0, cx: width as f64 / 2.0, cy: height as f64 / 2.0 },
        };
        let mask = Image::from_fn(width, height, |x, y| {
            u8::from((width / 4..width * 3 / 4).contains(&x) && (height / 4..height * 3 / 4).contains(&y))
                * 255
        });
        (frame, mask)
    }

    pub(crate) fn flat_observation() -> Observation {
        let (frame, mask) = flat_frame(160, 120);
        Observation::new(0, &frame, &mask, &Config::default()).unwrap()
    }

    #[test]
    fn points_of_the_crop_are_those_of_the_whole_image() {
        let (frame, mask) = flat_frame(160, 120);
        let o = Observation::new(0, &frame, &mask, &Config::default()).unwrap();
        assert_eq!(o.zoom, 2);
        let in_crop = |u: f32, v: f32| {
            let at = |whole: f32, origin: usize| (whole - origin as f32 + 0.5) * o.zoom as f32 - 0.5;
            [at(u, o.origin[0]), at(v, o.origin[1])]
        };
        for u in [80.0, 80.5] {
            let (lifted, normal) = o.lift(in_crop(u, 60.0)).unwrap();
            let full = frame.intrinsics.unproject(f64::from(u), 60.0, 0.5);
            assert!((0..3).all(|i| (f64::from(lifted[i]) - full[i]).abs() < 1e-6), "{lifted:?} {full:?}");
            assert!(normal[2] < -0.999);
        }
        let c = o.centre();
        assert!((c.z - 0.5).abs() < 1e-6 && c.x.abs() < 0.01 && c.y.abs() < 0.01);
    }

    #[test]
    fn a_double_size_image_gives_the_same_points() {
        let small = flat_observation();
        let (mut frame, mask) = flat_frame(160, 120);
        let twice = |x: usize, y: usize| (x / 2, y / 2);
        frame.intrinsics = frame.intrinsics.scaled(2.0, 2.0);
        frame.color = Image::from_fn(320, 240, |x, y| frame.color[twice(x, y)]);
        frame.depth = Image::filled(320, 240, 0.5);
        let mask = Image::from_fn(320, 240, |x, y| mask[twice(x, y)]);
        let mut config = Config::default();
        config.preprocess.working_side = 120;
        let large = Observation::new(0, &frame, &mask, &config).unwrap();
        assert_eq!(small.mask.size(), large.mask.size());
        let extent = |o: &Observation| {
            let xs = o.points.pixels().iter().filter(|p| p[2] > 0.0).map(|p| p[0]);
            xs.fold((f32::MAX, f32::MIN), |(lo, hi), x| (lo.min(x), hi.max(x)))
        };
        // The block's nearest pixel is half an original pixel off its centre at most.
        let half_pixel = 0.5 / 240.0 * 0.5 + 1e-5;
        assert!((extent(&small).0 - extent(&large).0).abs() < half_pixel);
        assert!((extent(&small).1 - extent(&large).1).abs() < half_pixel);
    }

    #[test]
    fn what_cannot_be_tracked_is_refused_with_its_reason() {
        let config = Config::default();
        let (frame, mask) = flat_frame(160, 120);
        let reason = |frame: &RgbdFrame, mask: &Mask| Observation::new(0, frame, mask, &config).unwrap_err();
        assert_eq!(reason(&frame, &Image::filled(160, 120, 0)), Unusable::NoMask);
        assert_eq!(reason(&frame, &Image::filled(10, 10, 1)), Unusable::Malformed);
        let mut dark = frame.clone();
        dark.depth = Image::filled(160, 120, f32::NAN);
        assert_eq!(reason(&dark, &mask), Unusable::NoDepth);
        let mut camera = frame.clone();
        camera.intrinsics.fx = 0.0;
        assert_eq!(reason(&camera, &mask), Unusable::Malformed);
    }
}
