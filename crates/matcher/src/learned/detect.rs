//! What the networks share around their forward pass: the crop goes in, features of the source image come out.

use super::LearnedOptions;
use crate::corners::erode;
use crate::crop::RollCrop;
use crate::fill::fill_background;
use crate::matching::{Descriptors, Features};
use rgbd_io::{Image, Mask};

/// What a network finds in an image, strongest first.
pub(super) struct Detections {
    /// Pixels of the image.
    pub(super) points: Vec<[f32; 2]>,
    /// Of length 1, one after the other.
    pub(super) descriptors: Vec<f32>,
    /// Values of a descriptor.
    pub(super) descriptor_len: usize,
    /// About the size of what a point stands for, pixels.
    pub(super) size: f32,
}

/// Runs `find` on the crop's gray values with the pixels that may be keypoints.
pub(super) fn detect(
    crop: &RollCrop,
    options: &LearnedOptions,
    find: impl FnOnce(&Image<f32>, &Mask) -> Detections,
) -> Features {
    let allowed = erode(crop.mask(), options.border);
    let is_empty = allowed.pixels().iter().all(|&m| m == 0);
    if is_empty || options.max_features == 0 || crop.gray().pixels().iter().any(|v| !v.is_finite()) {
        return Features::default();
    }
    let found = if options.fill_background {
        find(&fill_background(crop.gray(), &allowed), &allowed)
    } else {
        find(crop.gray(), &allowed)
    };
    let scale = crop.scale() as f32;
    Features {
        scales: vec![found.size / scale; found.points.len()],
        points: found.points.into_iter().map(|p| crop.to_image(p)).collect(),
        descriptors: Descriptors::F32 { len: found.descriptor_len, values: found.descriptors },
    }
}
