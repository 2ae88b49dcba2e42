//! How well a frame shows the object: what makes one view of a side of it a better keyframe than another.

use rgbd_io::gray_sharpness;

use crate::observation::{MIN_MARGIN, Observation};

/// Depth steps towards the camera beyond this (metres), just outside of the mask, are something in front of the object.
const STEP: f32 = 0.01;
/// Pixels of blur between two surfaces.
const BLUR: usize = 2;
/// [`gray_sharpness`] of a step edge.
const STEP_EDGE: f64 = 0.125;

/// What a view is worth, each part without unit, the better the larger.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quality {
    /// 1 for step edges, more for fine print, near 0 for smeared ones; `None` on an object without strong edges.
    pub sharpness: Option<f64>,
    /// Share of the mask's outline that is the object's own: neither the image's border nor the edge of something in
    /// front of it.
    pub completeness: f64,
    /// Share of the mask with usable depth.
    pub depth: f64,
    /// What is seen of the object: usable depth pixels at their distance, square metres across the line of sight.
    area: f64,
}

impl Quality {
    /// Measures `observation`; time linear in the pixels of its crop.
    pub(crate) fn of(observation: &Observation) -> Self {
        let (mask, zoom) = (&observation.mask, observation.zoom);
        let gray = observation.pyramid.levels().first();
        let sharpness = gray.and_then(|gray| gray_sharpness(gray, mask, zoom)).map(|s| s / STEP_EDGE);
        let pixels = mask.pixels().iter().filter(|m| **m != 0).count() as f64;
        let depths = observation.samples.iter().map(|(p, _)| f64::from(p[2]).powi(2));
        let squared = depths.sum::<f64>() / observation.samples.len().max(1) as f64;
        let valid = (observation.valid * zoom * zoom) as f64;
        Self {
            sharpness,
            completeness: own_outline(observation),
            depth: (valid / pixels.max(1.0)).min(1.0),
            area: valid * squared / (observation.intrinsics.fx * observation.intrinsics.fy),
        }
    }

    /// How many times better this view is than `other`, of about the same side of the object: the ratio of the parts'
    /// products. Edges that one of them doesn't have compare nothing. 0 when less of the object is seen, however well.
    pub fn over(&self, other: &Self) -> f64 {
        /// Of what the other shows; less may be noise at the rim.
        const AS_MUCH: f64 = 0.9;
        if self.area < AS_MUCH * other.area {
            return 0.0;
        }
        let ratio = |a: f64, b: f64| a.max(1e-6) / b.max(1e-6);
        let sharper = self.sharpness.zip(other.sharpness).map_or(1.0, |(a, b)| ratio(a, b));
        sharper * ratio(self.completeness, other.completeness) * ratio(self.depth, other.depth)
    }
}

/// The share of steps out of the mask that end neither at the image's border nor at something nearer than the object.
fn own_outline(observation: &Observation) -> f64 {
    let Observation { mask, images, zoom, .. } = observation;
    let (width, height) = mask.size();
    // Past what was eroded and blurred. The crop has so much margin, unless the image ends there.
    let margin = (images.mask_margin as usize + BLUR * zoom).min(MIN_MARGIN * zoom);
    let at = |x: usize, y: usize| (x < width && y < height).then_some(y * width + x);
    let (mut own, mut all) = (0_usize, 0_usize);
    for y in (0..height).step_by(*zoom) {
        for x in (0..width).step_by(*zoom).filter(|x| mask[(*x, y)] != 0) {
            for (dx, dy) in [(1, 0), (-1, 0), (0, 1), (0, -1)] {
                let step = |by: usize| {
                    let (dx, dy) = (dx * by as isize, dy * by as isize);
                    at(x.checked_add_signed(dx)?, y.checked_add_signed(dy)?)
                };
                let is_object = |i: usize| mask.pixels().get(i).is_some_and(|m| *m != 0);
                if step(*zoom).is_some_and(is_object) {
                    continue;
                }
                all += 1;
                let Some(beyond) = step(margin) else { continue };
                let depth = |i: usize| images.depth.get(i).copied().filter(|d| *d > 0.0);
                let hidden = depth(beyond).zip(depth(y * width + x)).is_some_and(|(b, d)| b < d - STEP);
                own += usize::from(is_object(beyond) || !hidden);
            }
        }
    }
    own as f64 / all.max(1) as f64
}

#[cfg(test)]
mod tests {
    use rgbd_io::{Image, Intrinsics, Mask, RgbdFrame};

    use super::*;
    use crate::config::Config;

    const BACKGROUND: f32 = 0.9;

    /// A printed disk of 30 pixels' radius at `centre`, half a metre away, smeared over `blur` pixels.
    fn disk(centre: [usize; 2], blur: usize) -> (RgbdFrame, Mask) {
        let mask = Image::from_fn(160, 120, |x, y| {
            255 * u8::from(x.abs_diff(centre[0]).pow(2) + y.abs_diff(centre[1]).pow(2) < 900)
        });
        let print = |x: usize, y: usize| 40 + (x / 5 * 37 + y / 5 * 61 + (x / 5) * (y / 5) * 17) % 180;
        let color = Image::from_fn(160, 120, |x, y| {
            let sum: usize = (0..blur).map(|i| print(x + i, y)).sum();
            [(sum / blur) as u8; 3]
        });
        let depth = mask.map(|m| if *m != 0 { 0.5 } else { BACKGROUND });
        let intrinsics = Intrinsics { fx: 150.0, fy: 150.0, cx: 80.0, cy: 60.0 };
        (RgbdFrame { id: "0".into(), color, depth, mask: None, intrinsics }, mask)
    }

    fn quality((frame, mask): &(RgbdFrame, Mask)) -> Quality {
        Quality::of(&Observation::new(0, frame, mask, &Config::default()).unwrap())
    }

    #[test]
    fn a_clear_view_has_everything() {
        let clear = quality(&disk([80, 60], 1));
        assert_eq!((clear.completeness, clear.depth), (1.0, 1.0));
        assert!(clear.sharpness.unwrap() > 0.5, "{clear:?}");
        assert!((clear.over(&clear) - 1.0).abs() < 1e-12);
        // What the eroded disk covers.
        let radius = (30.0 - Config::default().preprocess.mask_erosion as f64) * 0.5 / 150.0;
        let expected = std::f64::consts::PI * radius * radius;
        assert!((clear.area / expected - 1.0).abs() < 0.15, "{} {expected}", clear.area);
    }

    #[test]
    fn blur_costs_sharpness_alone() {
        let [clear, soft, smeared] = [1, 3, 6].map(|blur| quality(&disk([80, 60], blur)));
        let of = |q: &Quality| q.sharpness.unwrap();
        assert!(
            of(&soft) < 0.7 * of(&clear) && of(&smeared) < 0.7 * of(&soft),
            "{clear:?} {soft:?} {smeared:?}"
        );
        assert_eq!((clear.completeness, clear.depth), (smeared.completeness, smeared.depth));
        assert!(clear.over(&smeared) > 2.0 && smeared.over(&clear) < 0.5);
    }

    #[test]
    fn plain_views_are_compared_by_the_rest() {
        let mut plain = disk([80, 60], 1);
        plain.0.color = Image::filled(160, 120, [90; 3]);
        assert_eq!(quality(&plain).sharpness, None);
        assert_eq!(quality(&plain).over(&quality(&disk([80, 60], 1))), 1.0);
    }

    #[test]
    fn the_image_border_and_something_in_front_cut_the_object_off() {
        let clear = quality(&disk([80, 60], 1));
        // Half of it is outside: of a half disk's outline 2 of 2 + 3 radii is the cut, counted in steps 2 of 2 + 2 + 2.
        let cut = quality(&disk([0, 60], 1));
        assert!((0.5..0.75).contains(&cut.completeness), "{cut:?}");
        // Something in front of its right half, which the mask leaves out.
        let (mut frame, mut mask) = disk([80, 60], 1);
        mask = Image::from_fn(160, 120, |x, y| if x < 80 { mask[(x, y)] } else { 0 });
        let beside = quality(&(frame.clone(), mask.clone()));
        frame.depth = Image::from_fn(160, 120, |x, y| if x < 80 { frame.depth[(x, y)] } else { 0.4 });
        let hidden = quality(&(frame, mask));
        assert!((0.5..0.75).contains(&hidden.completeness), "{hidden:?}");
        assert_eq!(beside.completeness, 1.0);
        for worse in [cut, hidden] {
            assert!(clear.over(&worse) > 1.3 && worse.over(&clear) == 0.0);
        }
    }

    #[test]
    fn missing_depth_costs_its_share() {
        let (mut frame, mask) = disk([80, 60], 1);
        frame.depth = Image::from_fn(160, 120, |x, y| if y < 60 { frame.depth[(x, y)] } else { 0.0 });
        let half = quality(&(frame, mask));
        assert!((0.4..0.55).contains(&half.depth), "{half:?}");
        assert!(quality(&disk([80, 60], 1)).over(&half) > 1.8);
    }
}
