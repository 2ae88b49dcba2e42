//! Lines and tints on a photo.

use rgbd_io::{Image, Mask};

/// How a line looks.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pen {
    pub(super) color: [u8; 3],
    /// Pixels.
    pub(super) width: f32,
    /// 0 to 1.
    pub(super) alpha: f32,
    pub(super) dashed: bool,
}

/// A photo that is drawn on. Pixel centres are at integers.
pub(super) struct Canvas {
    image: Image<[u8; 3]>,
}

impl Canvas {
    pub(super) fn new(image: &Image<[u8; 3]>) -> Self {
        Self { image: image.clone() }
    }

    /// A line with a dark halo: it can be seen on any ground.
    pub(super) fn line(&mut self, [a, b]: [[f64; 2]; 2], pen: &Pen) {
        self.stroke(a, b, &Pen { color: [0; 3], width: pen.width + 2.0, alpha: 0.4 * pen.alpha, ..*pen });
        self.stroke(a, b, pen);
    }

    /// A dot in the upper left corner that tells the frame's status.
    pub(super) fn badge(&mut self, color: [u8; 3], unit: f32) {
        let centre = [f64::from(12.0 * unit); 2];
        for (radius, color) in [(7.5, [255; 3]), (5.5, color)] {
            let pen = Pen { color, width: 2.0 * radius * unit, alpha: 1.0, dashed: false };
            self.stroke(centre, centre, &pen);
        }
    }

    /// Mixes `color` in where `coverage` (0 to 255, of the photo's size) says so.
    pub(super) fn tint(&mut self, coverage: &Mask, color: [u8; 3], alpha: f32) {
        for (pixel, cover) in self.image.pixels_mut().iter_mut().zip(coverage.pixels()) {
            if *cover > 0 {
                mix(pixel, color, alpha * f32::from(*cover) / 255.0);
            }
        }
    }

    pub(super) fn into_image(self) -> Image<[u8; 3]> {
        self.image
    }

    /// A line with round ends: the pixels within half its width, their border softened over one pixel.
    fn stroke(&mut self, a: [f64; 2], b: [f64; 2], pen: &Pen) {
        let (width, height) = self.image.size();
        let reach = f64::from(pen.width) / 2.0 + 1.0;
        let Some((a, b)) = clip(a, b, [width as f64 + reach, height as f64 + reach], -reach) else { return };
        let along = [b[0] - a[0], b[1] - a[1]];
        let length = along[0].hypot(along[1]);
        let range = |i: usize, size: usize| {
            let low = (a[i].min(b[i]) - reach).clamp(0.0, size as f64);
            let high = (a[i].max(b[i]) + reach + 1.0).clamp(0.0, size as f64);
            low as usize..high as usize
        };
        let dash = 4.0 * f64::from(pen.width);
        for y in range(1, height) {
            for x in range(0, width) {
                let off = [x as f64 - a[0], y as f64 - a[1]];
                let dot = off[0] * along[0] + off[1] * along[1];
                let t = if length > 0.0 { (dot / length).clamp(0.0, length) } else { 0.0 };
                if pen.dashed && (t / dash) as i64 % 2 == 1 {
                    continue;
                }
                let unit = if length > 0.0 { [along[0] / length, along[1] / length] } else { [0.0; 2] };
                let distance = (off[0] - t * unit[0]).hypot(off[1] - t * unit[1]);
                let cover = (f64::from(pen.width) / 2.0 + 0.5 - distance).clamp(0.0, 1.0) as f32;
                if cover > 0.0 {
                    mix(&mut self.image.pixels_mut()[y * width + x], pen.color, cover * pen.alpha);
                }
            }
        }
    }
}

fn mix(pixel: &mut [u8; 3], color: [u8; 3], share: f32) {
    for (old, new) in pixel.iter_mut().zip(color) {
        *old = (f32::from(*old) + (f32::from(new) - f32::from(*old)) * share).round() as u8;
    }
}

/// The part of a segment between `low` and `high` in both coordinates (Liang and Barsky 1984): one end of a box that
/// reaches close to the camera may be kilometres of pixels away.
fn clip(a: [f64; 2], b: [f64; 2], high: [f64; 2], low: f64) -> Option<([f64; 2], [f64; 2])> {
    if !a.iter().chain(&b).all(|v| v.is_finite()) {
        return None;
    }
    let (mut enter, mut leave) = (0.0_f64, 1.0_f64);
    for i in 0..2 {
        let step = b[i] - a[i];
        for (toward, room) in [(-step, a[i] - low), (step, high[i] - a[i])] {
            if toward == 0.0 && room < 0.0 {
                return None;
            }
            if toward < 0.0 {
                enter = enter.max(room / toward);
            } else if toward > 0.0 {
                leave = leave.min(room / toward);
            }
        }
    }
    let at = |t: f64| [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])];
    (enter <= leave).then(|| (at(enter), at(leave)))
}

#[cfg(test)]
mod tests {
    use super::*;

    const PEN: Pen = Pen { color: [255; 3], width: 2.0, alpha: 1.0, dashed: false };

    fn drawn(a: [f64; 2], b: [f64; 2], pen: &Pen) -> Image<[u8; 3]> {
        let mut canvas = Canvas::new(&Image::filled(20, 20, [0; 3]));
        canvas.stroke(a, b, pen);
        canvas.into_image()
    }

    #[test]
    fn a_line_covers_its_width_times_its_length() {
        let image = drawn([4.0, 10.0], [14.0, 10.0], &PEN);
        let sum: f64 = image.pixels().iter().map(|p| f64::from(p[0]) / 255.0).sum();
        // A rectangle of 10 by 2 and two half discs of radius 1.
        assert!((sum - (20.0 + std::f64::consts::PI)).abs() < 1.5, "{sum}");
        assert_eq!(image.row(10)[9][0], 255);
        assert_eq!(image.row(13)[9][0], 0);
    }

    #[test]
    fn lines_that_leave_the_image_are_cut_and_those_outside_draw_nothing() {
        assert_eq!(drawn([-1e9, 10.0], [1e9, 10.0], &PEN).row(10)[0][0], 255);
        assert!(drawn([-1e9, -50.0], [1e9, -50.0], &PEN).pixels().iter().all(|p| p[0] == 0));
        assert!(drawn([f64::NAN, 1.0], [5.0, 5.0], &PEN).pixels().iter().all(|p| p[0] == 0));
    }

    #[test]
    fn half_of_a_dashed_line_is_missing() {
        let count =
            |pen: &Pen| drawn([0.0, 10.0], [19.0, 10.0], pen).row(10).iter().filter(|p| p[0] > 0).count();
        let (full, dashed) = (count(&PEN), count(&Pen { width: 1.0, dashed: true, ..PEN }));
        assert!(full == 20 && (8..=13).contains(&dashed), "{full} {dashed}");
    }
}
