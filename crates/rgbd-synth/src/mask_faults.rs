//! What a segmenter gets wrong: the given masks differ from the visible ones.

use crate::noise::{fractal_noise, mix, stream, unit};
use rgbd_io::{Image, Mask};

/// Frames for which a false or missing blob stays.
const STAY: usize = 5;

/// Faults of the masks that a frame comes with; the first frame's mask is always right.
///
/// The kinds of error are those that benchmarks of video segmentation tell apart (Perazzi et al., CVPR 2016: region
/// and contour errors): boundaries that waver, parts of the object left out, parts of the surroundings taken in, and
/// frames in which the object is lost.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MaskFaults {
    /// Largest displacement of the boundary inwards and outwards, pixels.
    pub boundary: f32,
    /// Probability that a piece of the object is missing.
    pub missing: f32,
    /// Probability that a piece beside the object is taken for it.
    pub false_near: f32,
    /// Probability that a piece far from the object is taken for it.
    pub false_far: f32,
    /// Size of the pieces: radius as a share of the root of the mask's area.
    pub size: f32,
    /// Probability that a frame's mask is empty.
    pub dropped: f32,
}

impl MaskFaults {
    /// The true visible masks.
    pub fn none() -> Self {
        Self { boundary: 0.0, missing: 0.0, false_near: 0.0, false_far: 0.0, size: 0.2, dropped: 0.0 }
    }

    /// A segmenter that is often wrong: every other frame has a false or missing piece, one in thirty no mask.
    pub fn severe() -> Self {
        Self { boundary: 4.0, missing: 0.35, false_near: 0.35, false_far: 0.15, size: 0.2, dropped: 0.035 }
    }

    /// The mask that is given for frame `index` in place of `truth`.
    pub(crate) fn apply(&self, truth: &Mask, seed: u64, index: usize) -> Mask {
        let nothing = Self { size: self.size, ..Self::none() };
        let area = truth.pixels().iter().filter(|m| **m != 0).count();
        if index == 0 || *self == nothing || area == 0 {
            return truth.clone();
        }
        if unit(stream(seed ^ 0xd209, index as u64, 0), 0) < self.dropped {
            return Image::filled(truth.width(), truth.height(), 0);
        }
        let mut mask = if self.boundary > 0.0 { self.waver(truth, seed, index) } else { truth.clone() };
        let radius = self.size * (area as f32).sqrt();
        for (kind, probability) in [self.missing, self.false_near, self.false_far].into_iter().enumerate() {
            let random = stream(seed ^ 0xb10b, (index / STAY) as u64, kind as u64);
            if unit(random, 0) < probability {
                // The piece keeps its place relative to the object while it stays.
                let middle = match kind {
                    0 => on_mask(truth, unit(random, 16)),
                    1 => beside(truth, unit(random, 16), radius),
                    _ => [unit(random, 16) * truth.width() as f32, unit(random, 32) * truth.height() as f32],
                };
                let radius = radius * (0.6 + 0.6 * unit(random, 48));
                blob(&mut mask, middle, radius, mix(random) as u32, if kind == 0 { 0 } else { 255 });
            }
        }
        mask
    }

    /// Moves the boundary by smooth random amounts: the share of object around a pixel against a threshold that
    /// varies over the image.
    fn waver(&self, truth: &Mask, seed: u64, index: usize) -> Mask {
        let reach = self.boundary.ceil().max(1.0) as usize;
        let (w, h) = truth.size();
        let sums = prefix_sums(truth);
        let salt = stream(seed ^ 0x3a7e, 0, 0) as u32;
        Image::from_fn(w, h, |x, y| {
            let (left, right) = (x.saturating_sub(reach), (x + reach + 1).min(w));
            let (top, bottom) = (y.saturating_sub(reach), (y + reach + 1).min(h));
            let corner = |x: usize, y: usize| sums[y * (w + 1) + x];
            let inside =
                corner(right, bottom) + corner(left, top) - corner(left, bottom) - corner(right, top);
            let all = ((right - left) * (bottom - top)) as u32;
            if inside == 0 || inside == all {
                return if inside == 0 { 0 } else { 255 };
            }
            let p = [x as f32 / 26.0, y as f32 / 26.0, index as f32 / 4.0];
            let noise = (fractal_noise(p, 2, salt) - 0.5) * 2.4 * self.boundary / reach as f32;
            if inside as f32 / all as f32 > 0.5 + 0.5 * noise.clamp(-0.96, 0.96) { 255 } else { 0 }
        })
    }
}

/// `sums[y * (width + 1) + x]`: object pixels above and left of `(x, y)`.
fn prefix_sums(mask: &Mask) -> Vec<u32> {
    let (w, h) = mask.size();
    let mut sums = vec![0u32; (w + 1) * (h + 1)];
    for y in 0..h {
        let mut row = 0;
        for x in 0..w {
            row += u32::from(mask[(x, y)] != 0);
            sums[(y + 1) * (w + 1) + x + 1] = sums[y * (w + 1) + x + 1] + row;
        }
    }
    sums
}

/// The object pixel that comes after the given share of all of them, row after row.
fn on_mask(mask: &Mask, share: f32) -> [f32; 2] {
    let all: Vec<usize> = (0..mask.pixels().len()).filter(|&i| mask.pixels()[i] != 0).collect();
    let i = all.get((share * all.len() as f32) as usize).copied().unwrap_or(0);
    let w = mask.width().max(1);
    [(i % w) as f32, (i / w) as f32]
}

/// A place just outside the mask, in the direction of the given share of a turn from its middle.
fn beside(mask: &Mask, share: f32, radius: f32) -> [f32; 2] {
    let (mut sum, mut count) = ([0.0f32; 2], 0.0f32);
    for (i, _) in mask.pixels().iter().enumerate().filter(|(_, m)| **m != 0) {
        let w = mask.width();
        sum = [sum[0] + (i % w) as f32, sum[1] + (i / w) as f32];
        count += 1.0;
    }
    let middle = sum.map(|v| v / count.max(1.0));
    let (dy, dx) = (share * std::f32::consts::TAU).sin_cos();
    let limit = (mask.width() + mask.height()) as f32;
    let mut along = 0.0;
    let at = |t: f32| [middle[0] + dx * t, middle[1] + dy * t];
    // The last object pixel in this direction.
    let mut t = 0.0;
    while t < limit {
        let [x, y] = at(t);
        if x >= 0.0 && y >= 0.0 && mask.get(x as usize, y as usize).is_some_and(|m| *m != 0) {
            along = t;
        }
        t += 1.0;
    }
    at(along + 0.7 * radius)
}

/// Fills a round piece with a ragged edge.
fn blob(mask: &mut Mask, [cx, cy]: [f32; 2], radius: f32, seed: u32, value: u8) {
    let (w, h) = mask.size();
    let span = |c: f32, limit: usize| {
        let reach = 1.4 * radius;
        (c - reach).max(0.0) as usize..((c + reach).max(0.0) as usize + 1).min(limit)
    };
    for y in span(cy, h) {
        for x in span(cx, w) {
            let (dx, dy) = (x as f32 - cx, y as f32 - cy);
            let r = (dx * dx + dy * dy).sqrt().max(1e-6);
            let ragged = fractal_noise([2.0 * dx / r, 2.0 * dy / r, 0.0], 2, seed);
            if r < radius * (0.6 + 0.8 * ragged) {
                mask[(x, y)] = value;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn disc() -> Mask {
        Image::from_fn(160, 120, |x, y| {
            let (dx, dy) = (x as f32 - 90.0, y as f32 - 55.0);
            if dx * dx + dy * dy < 30.0 * 30.0 { 255 } else { 0 }
        })
    }

    /// Pixels that are object in `a` and not in `b`.
    fn more(a: &Mask, b: &Mask) -> usize {
        a.pixels().iter().zip(b.pixels()).filter(|(a, b)| **a != 0 && **b == 0).count()
    }

    #[test]
    fn each_fault_does_what_it_says() {
        let (truth, none) = (disc(), MaskFaults::none());
        let over = |faults: MaskFaults| {
            (1..80).step_by(7).fold((0, 0), |sum, i| {
                let given = faults.apply(&truth, 5, i);
                assert_eq!(given, faults.apply(&truth, 5, i));
                (sum.0 + more(&given, &truth), sum.1 + more(&truth, &given))
            })
        };
        assert_eq!(over(none), (0, 0));
        let (added, lost) = over(MaskFaults { missing: 1.0, ..none });
        assert!(added == 0 && lost > 500, "{added} {lost}");
        for far in [0.0, 1.0] {
            let (added, lost) = over(MaskFaults { false_near: 1.0 - far, false_far: far, ..none });
            assert!(added > 500 && lost == 0, "{added} {lost}");
        }
        let (added, lost) = over(MaskFaults { boundary: 3.0, ..none });
        assert!(added > 200 && lost > 200, "{added} {lost}");
        let empty = (1..400).filter(|i| {
            MaskFaults { dropped: 0.2, ..none }.apply(&truth, 5, *i).pixels().iter().all(|m| *m == 0)
        });
        assert!((50..110).contains(&empty.count()));
    }

    #[test]
    fn the_boundary_moves_no_further_than_asked_and_the_first_frame_is_right() {
        let truth = disc();
        let wavering = MaskFaults { boundary: 3.0, ..MaskFaults::none() };
        let given = wavering.apply(&truth, 9, 4);
        for (i, (a, b)) in given.pixels().iter().zip(truth.pixels()).enumerate() {
            let (x, y) = (i % 160, i / 160);
            let r = (x as f32 - 90.0).hypot(y as f32 - 55.0);
            assert!(a == b || (r - 30.0).abs() < 3.0 * 1.5, "{r}");
        }
        assert_eq!(MaskFaults::severe().apply(&truth, 9, 0), truth);
        let nothing = Mask::filled(160, 120, 0);
        assert_eq!(MaskFaults::severe().apply(&nothing, 9, 3), nothing);
    }
}
