//! What a frame saw, as the dense term looks it up: an image of points with normals.

use crate::error::Error;
use crate::graph::check_length;

/// A pixel's point and normal, one cache line for two of them.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
#[repr(C, align(32))]
pub(crate) struct Pixel {
    /// x, y, z and a zero.
    pub(crate) point: [f32; 4],
    /// x, y, z and a zero.
    pub(crate) normal: [f32; 4],
}

impl Pixel {
    /// Whether it has a point and a normal, all finite.
    fn is_usable(&self) -> bool {
        let (p, n) = (&self.point, &self.normal);
        // Zero unless something is NaN or infinite.
        let nothing = (p[0] + p[1] + p[2] + n[0] + n[1] + n[2]) * 0.0;
        p[2] > 0.0 && n[0] * n[0] + n[1] * n[1] + n[2] * n[2] > 0.25 && nothing == 0.0
    }
}

/// A pinhole camera: focal lengths and principal point in pixels, pixel centres at integers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pinhole {
    /// Horizontal focal length.
    pub fx: f64,
    /// Vertical focal length.
    pub fy: f64,
    /// Principal point, horizontal.
    pub cx: f64,
    /// Principal point, vertical.
    pub cy: f64,
}

/// Organised point cloud with normals of one frame, in its own camera frame (x right, y down, z forward, metres),
/// already at the resolution the caller wants the dense term to work at.
///
/// Made once per frame and looked at by every solve that the frame takes part in.
#[derive(Debug, Clone, PartialEq)]
pub struct DenseView {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) camera: Pinhole,
    pub(crate) pixels: Vec<Pixel>,
    /// Indices of the pixels with a point and a normal, ascending.
    pub(crate) usable: Vec<u32>,
}

impl DenseView {
    /// An image of `width` x `height` `points` with unit `normals`, row-major. A point with `z <= 0` or NaN is invalid,
    /// and so is a pixel with a zero or NaN normal.
    ///
    /// # Errors
    /// Arrays that are not `width * height` long, an image with more pixels than an index can count, or a camera that
    /// cannot project.
    pub fn new(
        (width, height): (usize, usize),
        camera: Pinhole,
        points: &[[f32; 3]],
        normals: &[[f32; 3]],
    ) -> Result<Self, Error> {
        let pixels = width.saturating_mul(height);
        check_length("points of the view", points.len(), pixels)?;
        check_length("normals of the view", normals.len(), pixels)?;
        let Pinhole { fx, fy, cx, cy } = camera;
        if [fx, fy, cx, cy].iter().any(|c| !c.is_finite()) || fx <= 0.0 || fy <= 0.0 {
            return Err(Error::InvalidCamera);
        }
        if i32::try_from(pixels).is_err() {
            return Err(Error::ViewTooLarge { pixels });
        }
        let pixel = |(&[x, y, z], &[nx, ny, nz]): (&[f32; 3], &[f32; 3])| Pixel {
            point: [x, y, z, 0.0],
            normal: [nx, ny, nz, 0.0],
        };
        let pixels: Vec<Pixel> = points.iter().zip(normals).map(pixel).collect();
        let usable = pixels.iter().enumerate().filter(|(_, pixel)| pixel.is_usable());
        let usable = usable.map(|(k, _)| k as u32).collect();
        Ok(Self { width, height, camera, pixels, usable })
    }

    /// Pixels per row and rows.
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// The camera.
    pub fn camera(&self) -> &Pinhole {
        &self.camera
    }

    /// At most `most` of the usable pixels, evenly spread over them, ascending.
    pub(crate) fn spread(&self, most: usize) -> impl ExactSizeIterator<Item = u32> + Clone {
        let (usable, count) = (self.usable.as_slice(), self.usable.len());
        let samples = count.min(most);
        // The centre of the k-th of equal stretches.
        (0..samples).map(move |k| usable[(2 * k + 1) * count / (2 * samples)])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Pinhole = Pinhole { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };

    #[test]
    fn samples_are_spread_evenly_over_what_is_valid() {
        for (width, every) in [(0, 1), (1, 1), (64, 3), (1000, 7)] {
            let points: Vec<_> =
                (0..width).map(|k| [0.0, 0.0, f32::from(u8::from(k % every == 0))]).collect();
            let view = DenseView::new((width, 1), CAMERA, &points, &vec![[0.0, 0.0, -1.0]; width]).unwrap();
            for most in [0, 1, 7, 2000] {
                let samples: Vec<usize> = view.spread(most).map(|k| k as usize).collect();
                let valid = width.div_ceil(every);
                assert_eq!(samples.len(), valid.min(most));
                assert!(samples.iter().all(|k| k % every == 0));
                let gaps = samples.windows(2).map(|w| w[1] - w[0]);
                let (least, greatest) = gaps.fold((usize::MAX, 0), |(a, b), gap| (a.min(gap), b.max(gap)));
                assert!(samples.len() < 2 || (least > 0 && greatest - least <= every), "{samples:?}");
            }
        }
    }

    #[test]
    fn pixels_with_nan_or_without_a_normal_are_no_samples() {
        let mut points = [[0.0, 0.0, 1.0]; 6];
        let mut normals = [[0.0, 0.0, -1.0]; 6];
        points[0][0] = f32::NAN;
        normals[1] = [0.0; 3];
        normals[2][1] = f32::NAN;
        points[3][1] = f32::INFINITY;
        points[5][2] = 0.0;
        let view = DenseView::new((3, 2), CAMERA, &points, &normals).unwrap();
        assert_eq!(view.spread(10).collect::<Vec<_>>(), [4]);
    }
}
