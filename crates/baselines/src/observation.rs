//! One frame, cut to the object.

use crate::depth::{bilateral, halved, without_flying};
use crate::point_map::PointMap;
use crate::rigid::{dot, unit};
use crate::tsdf::DepthView;
use matcher::Rect;
use rgbd_io::{Image, Intrinsics, Mask, RgbdFrame};

/// Fewer points than this are no object.
pub(crate) const MIN_POINTS: usize = 50;
/// Pixels around the mask: windows of point tracks look there.
const MARGIN: usize = 12;
const MAX_LEVELS: usize = 3;
/// A level that is smaller than this, pixels, says nothing.
const MIN_SIDE: usize = 16;

/// The object's part of a frame. All images are crops of one size.
#[derive(Clone, Debug)]
pub(crate) struct Observation {
    /// Where in the frame the crop is.
    pub(crate) rect: Rect,
    /// Camera of the whole frame.
    pub(crate) camera: Intrinsics,
    /// Camera of the crop.
    pub(crate) intrinsics: Intrinsics,
    pub(crate) color: Image<[u8; 3]>,
    pub(crate) mask: Mask,
    /// Depth as measured, 0 outside the mask and at flying pixels.
    pub(crate) depth: Image<f32>,
    /// Smoothed depth.
    pub(crate) smooth: Image<f32>,
    /// Confidence for fusion: cosine of the angle of view.
    weights: Image<f32>,
    /// Smoothed surface in the camera's frame, finest first; at least one level.
    pub(crate) levels: Vec<PointMap>,
}

impl Observation {
    /// `None` without a mask, with too little depth inside it, or with images of different sizes.
    pub(crate) fn new(frame: &RgbdFrame) -> Option<Self> {
        let mask = frame.mask.as_ref()?;
        let size = frame.depth.size();
        if mask.size() != size || frame.color.size() != size || !frame.intrinsics.is_valid() {
            return None;
        }
        let rect = Rect::around_mask(mask, MARGIN)?;
        let intrinsics = frame.intrinsics.cropped(rect.x, rect.y);
        let mask = rect.cut(mask);
        let mut depth = rect.cut(&frame.depth);
        for (z, &m) in depth.pixels_mut().iter_mut().zip(mask.pixels()) {
            if m == 0 || !(*z > 0.01 && z.is_finite()) {
                *z = 0.0;
            }
        }
        let depth = without_flying(&depth, &intrinsics);
        let smooth = bilateral(&depth);
        let levels = pyramid(&smooth, &intrinsics)?;
        let weights = fusion_weights(levels.first()?);
        let color = rect.cut(&frame.color);
        Some(Self { rect, camera: frame.intrinsics, intrinsics, color, mask, depth, smooth, weights, levels })
    }

    /// What there is to fuse.
    pub(crate) fn view(&self) -> DepthView<'_> {
        DepthView {
            depth: &self.depth,
            weights: &self.weights,
            color: &self.color,
            intrinsics: self.intrinsics,
        }
    }

    /// Middle and size (metres, camera frame) of the box around the cloud, less two percent of the points on each side
    /// of each axis: depth of the background that the mask lets in should not move the object.
    pub(crate) fn bounds(&self) -> ([f64; 3], [f64; 3]) {
        let (mut middle, mut size) = ([0.0; 3], [0.0; 3]);
        for a in 0..3 {
            let points = self.levels.iter().take(1).flat_map(|level| &level.points);
            let mut values: Vec<f32> = points.map(|p| p[a]).filter(|v| !v.is_nan()).collect();
            values.sort_unstable_by(f32::total_cmp);
            let at = |share: usize| values.get((values.len() * share / 100).min(values.len().max(1) - 1));
            let (low, high) = (at(2).copied().unwrap_or(0.0), at(98).copied().unwrap_or(0.0));
            middle[a] = 0.5 * f64::from(low + high);
            size[a] = f64::from(high - low);
        }
        (middle, size)
    }
}

fn pyramid(smooth: &Image<f32>, k: &Intrinsics) -> Option<Vec<PointMap>> {
    let (mut depth, mut k) = (smooth.clone(), *k);
    let mut levels: Vec<PointMap> = Vec::new();
    for _ in 0..MAX_LEVELS {
        let map = PointMap::from_depth(&depth, &k);
        if map.count() < MIN_POINTS || map.width.min(map.height) < MIN_SIDE {
            break;
        }
        levels.push(map);
        depth = halved(&depth, &k);
        k = k.scaled(0.5, 0.5);
    }
    (!levels.is_empty()).then_some(levels)
}

/// Depth at grazing angles is uncertain (KinectFusion section 3.3).
fn fusion_weights(map: &PointMap) -> Image<f32> {
    let weight = |i: usize| {
        let view = unit(map.points[i]).map_or(0.0, |ray| -dot(ray, map.normals[i]));
        // Also for NaN: no normal.
        view.max(0.1)
    };
    Image::from_vec(map.width, map.height, (0..map.points.len()).map(weight).collect()).unwrap_or_default()
}
