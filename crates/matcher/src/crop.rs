//! Tight crops of the object, turned so that two views have no roll between them.

use crate::gray::{downsample, is_interior, sample_clamped, sample_interior};
use nalgebra::UnitQuaternion;
use rgbd_io::{Image, Mask};

/// Size of a crop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CropOptions {
    /// Longer side of the crop, pixels.
    pub side: usize,
    /// Space around the object, source pixels.
    pub margin: f32,
    /// The crop is at most this many times finer than the source; a small object gets a crop smaller than `side`.
    pub max_upscale: f32,
}

impl Default for CropOptions {
    fn default() -> Self {
        Self { side: 320, margin: 10.0, max_upscale: 2.0 }
    }
}

/// The object cut out of an image, rotated in the image plane and scaled isotropically, with exact pixel maps.
///
/// The crop's box is tight around the *rotated* mask. The gray values around the object are kept: what a matcher does
/// with the background is its own business, the mask says where it is.
#[derive(Clone, Debug)]
pub struct RollCrop {
    gray: Image<f32>,
    mask: Mask,
    /// Crop from image: `[cos -sin; sin cos] * scale * p + shift`.
    cos: f64,
    sin: f64,
    scale: f64,
    shift: [f64; 2],
}

impl RollCrop {
    /// Cuts the object in `mask` out of `gray` (0 to 255, same size), rotated by `roll` radians: the direction from u
    /// (right) to v (down) is positive, as about the camera's z-axis. See [`roll_between`] for the angle.
    ///
    /// `None` for an empty mask, sizes that differ, a roll that is not finite, or a `side` of 0.
    pub fn new(gray: &Image<f32>, mask: &Mask, roll: f64, options: &CropOptions) -> Option<Self> {
        if mask.size() != gray.size() || !roll.is_finite() || options.side == 0 {
            return None;
        }
        let (sin, cos) = roll.sin_cos();
        let [left, top, right, bottom] = rotated_bounds(mask, cos, sin)?;
        let margin = f64::from(options.margin).clamp(0.0, 1e4);
        let (width, height) = (right - left + 2.0 * margin + 1.0, bottom - top + 2.0 * margin + 1.0);
        let max_upscale = f64::from(options.max_upscale).clamp(1e-3, 1e3);
        // Pixels are squares about their centres: `side` of them span `side / scale` source pixels.
        let scale = (options.side as f64 / width.max(height)).min(max_upscale);
        let size = |length: f64| ((length * scale).round() as usize).clamp(1, options.side);
        // The box's corner is half a source pixel outside its first centre; the crop's is at -0.5.
        let corner = |first: f64| -(first - margin - 0.5) * scale - 0.5;
        let shift = [corner(left), corner(top)];
        let mut crop = Self { gray: Image::default(), mask: Mask::default(), cos, sin, scale, shift };
        crop.resample(gray, mask, size(width), size(height));
        Some(crop)
    }

    fn resample(&mut self, gray: &Image<f32>, mask: &Mask, width: usize, height: usize) {
        // Coarser than half: sample a level of the pyramid that is at most twice as fine as the crop.
        let mut level: Option<Image<f32>> = None;
        let mut step = 1.0;
        while self.scale * step < 0.5 && step < 64.0 {
            level = Some(downsample(level.as_ref().unwrap_or(gray)));
            step *= 2.0;
        }
        let source = level.as_ref().unwrap_or(gray);
        let per_step = 1.0 / step as f32;
        let last = [gray.width() as f32 - 1.0, gray.height() as f32 - 1.0];
        let mut values = Image::filled(width, height, 0.0);
        let mut inside = Mask::filled(width, height, 0);
        let along = [(self.cos / self.scale) as f32, (-self.sin / self.scale) as f32];
        for y in 0..height {
            let [u0, v0] = self.to_image_f64([0.0, y as f64]).map(|c| c as f32);
            let (u1, v1) = (u0 + along[0] * width as f32, v0 + along[1] * width as f32);
            let is_in = |u: f32, v: f32| is_interior(source, [u * per_step, v * per_step], [0.01, 0.01]);
            let interior = is_in(u0, v0) && is_in(u1, v1);
            let span = y * width..(y + 1) * width;
            let lines = values.pixels_mut()[span.clone()].iter_mut().zip(&mut inside.pixels_mut()[span]);
            for (x, (value, object)) in lines.enumerate() {
                let (u, v) = (u0 + along[0] * x as f32, v0 + along[1] * x as f32);
                let (us, vs) = (u * per_step, v * per_step);
                *value =
                    if interior { sample_interior(source, us, vs) } else { sample_clamped(source, us, vs) };
                if u > -0.5 && v > -0.5 && u < last[0] + 0.5 && v < last[1] + 0.5 {
                    *object = mask[((u + 0.5) as usize, (v + 0.5) as usize)];
                }
            }
        }
        self.gray = values;
        self.mask = inside;
    }

    /// Gray values of the crop, 0 to 255, background included.
    pub fn gray(&self) -> &Image<f32> {
        &self.gray
    }

    /// The object in the crop.
    pub fn mask(&self) -> &Mask {
        &self.mask
    }

    /// Crop pixels per source pixel.
    pub fn scale(&self) -> f64 {
        self.scale
    }

    /// The angle by which the image was rotated, radians, in (-pi, pi].
    pub fn roll(&self) -> f64 {
        self.sin.atan2(self.cos)
    }

    /// The crop pixel that shows source pixel `p`.
    pub fn to_crop(&self, p: [f32; 2]) -> [f32; 2] {
        let [u, v] = p.map(f64::from);
        [
            (self.scale * (self.cos * u - self.sin * v) + self.shift[0]) as f32,
            (self.scale * (self.sin * u + self.cos * v) + self.shift[1]) as f32,
        ]
    }

    /// The source pixel that crop pixel `p` shows: the inverse of [`RollCrop::to_crop`].
    pub fn to_image(&self, p: [f32; 2]) -> [f32; 2] {
        self.to_image_f64(p.map(f64::from)).map(|v| v as f32)
    }

    fn to_image_f64(&self, p: [f64; 2]) -> [f64; 2] {
        let (x, y) = ((p[0] - self.shift[0]) / self.scale, (p[1] - self.shift[1]) / self.scale);
        [self.cos * x + self.sin * y, -self.sin * x + self.cos * y]
    }
}

/// `[left, top, right, bottom]` of the object's pixel centres after rotation about pixel (0, 0).
fn rotated_bounds(mask: &Mask, cos: f64, sin: f64) -> Option<[f64; 4]> {
    let mut bounds: Option<[f64; 4]> = None;
    for y in 0..mask.height() {
        let row = mask.row(y);
        let Some(first) = row.iter().position(|&m| m != 0) else { continue };
        let last = row.iter().rposition(|&m| m != 0).unwrap_or(first);
        // The ends of a row are its extremes in every direction.
        for x in [first, last] {
            let (u, v) = (x as f64, y as f64);
            let (ru, rv) = (cos * u - sin * v, sin * u + cos * v);
            let b = bounds.get_or_insert([ru, rv, ru, rv]);
            *b = [b[0].min(ru), b[1].min(rv), b[2].max(ru), b[3].max(rv)];
        }
    }
    bounds
}

/// The roll, radians, by which the image of camera **b** is rotated to look like the image of camera **a**: the
/// z-component of the rotation vector of `R_a R_b^T`. Give it to the crop of b, and 0 to the crop of a.
///
/// `a_from_obj` and `b_from_obj` are the rotations of the current poses (camera from object).
pub fn roll_between(a_from_obj: &UnitQuaternion<f64>, b_from_obj: &UnitQuaternion<f64>) -> f64 {
    (a_from_obj * b_from_obj.inverse()).scaled_axis().z
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use proptest::prelude::*;

    fn blob(cx: f32, cy: f32, rx: f32, ry: f32) -> Mask {
        Mask::from_fn(200, 150, |x, y| {
            u8::from(((x as f32 - cx) / rx).powi(2) + ((y as f32 - cy) / ry).powi(2) <= 1.0)
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn the_maps_are_inverse_and_the_object_fits(
            roll in -7.0_f64..7.0, cx in 20.0_f32..180.0, cy in 20.0_f32..130.0,
            rx in 2.0_f32..60.0, ry in 2.0_f32..60.0, side in 16_usize..400,
        ) {
            let mask = blob(cx, cy, rx, ry);
            let gray = Image::filled(200, 150, 10.0);
            let crop = RollCrop::new(&gray, &mask, roll, &CropOptions { side, ..CropOptions::default() }).unwrap();
            let (w, h) = crop.gray().size();
            prop_assert!(w.max(h) <= side && crop.scale() <= 2.0);
            prop_assert!(w.max(h) + 1 >= side || crop.scale() == 2.0);
            for y in (0..150).step_by(7) {
                for x in (0..200).step_by(7) {
                    let p = [x as f32, y as f32];
                    let c = crop.to_crop(p);
                    let back = crop.to_image(c);
                    prop_assert!((back[0] - p[0]).hypot(back[1] - p[1]) < 1e-3);
                    if mask[(x, y)] != 0 {
                        prop_assert!(c[0] > -0.5 && c[1] > -0.5);
                        prop_assert!(c[0] < w as f32 + 0.5 && c[1] < h as f32 + 0.5);
                    }
                }
            }
        }
    }

    #[test]
    fn a_quarter_turn_moves_right_to_down() {
        let mask = blob(100.0, 75.0, 50.0, 20.0);
        let gray = Image::from_fn(200, 150, |x, _| x as f32);
        let crop = RollCrop::new(&gray, &mask, std::f64::consts::FRAC_PI_2, &CropOptions::default()).unwrap();
        let (a, b) = (crop.to_crop([100.0, 75.0]), crop.to_crop([110.0, 75.0]));
        assert!((b[0] - a[0]).abs() < 1e-3 && b[1] > a[1] + 10.0);
        assert!(crop.gray().height() > crop.gray().width());
        assert!((crop.roll() - std::f64::consts::FRAC_PI_2).abs() < 1e-9);
        // The gray values went with it.
        let value = crate::gray::sample_bilinear(crop.gray(), b[0], b[1]).unwrap();
        assert!((value - 110.0).abs() < 0.01, "{value}");
    }

    #[test]
    fn the_roll_of_two_cameras_removes_their_relative_rotation() {
        let turn = |v: [f64; 3]| UnitQuaternion::from_scaled_axis(Vector3::from(v));
        let b = turn([0.3, -1.0, 0.4]);
        let a = turn([0.0, 0.0, 0.7]) * b;
        assert!((roll_between(&a, &b) - 0.7).abs() < 1e-12);
        // A direction in the image of b, rotated by the roll, is the direction in the image of a.
        let in_b = b * Vector3::new(0.2, 0.5, -0.3);
        let in_a = a * Vector3::new(0.2, 0.5, -0.3);
        let (s, c) = roll_between(&a, &b).sin_cos();
        assert!((c * in_b.x - s * in_b.y - in_a.x).abs() < 1e-12);
    }

    #[test]
    fn unusable_inputs_give_none() {
        let gray = Image::filled(20, 20, 1.0);
        let full = Mask::filled(20, 20, 1);
        let options = CropOptions::default();
        assert!(RollCrop::new(&gray, &Mask::filled(20, 20, 0), 0.0, &options).is_none());
        assert!(RollCrop::new(&gray, &Mask::filled(20, 19, 1), 0.0, &options).is_none());
        assert!(RollCrop::new(&gray, &full, f64::NAN, &options).is_none());
        assert!(RollCrop::new(&gray, &full, 0.0, &CropOptions { side: 0, ..options }).is_none());
        assert!(RollCrop::new(&Image::default(), &Mask::default(), 0.0, &options).is_none());
        assert!(
            RollCrop::new(&gray, &full, 0.0, &CropOptions { max_upscale: f32::NAN, ..options }).is_some()
        );
    }
}
