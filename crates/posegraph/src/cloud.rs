//! A view prepared for the dense term: the evenly spread sample of its pixels that is matched with other views, and what
//! the search for matches in it needs.

use crate::lanes::{LANES, Lane};
use crate::options::{Gates, SolveOptions};
use crate::stats::Extent;
use crate::view::{DenseView, Pinhole, Pixel};

/// Eight source pixels of the dense term. Unused lanes have NaN points, which match nothing.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Samples {
    pub(crate) point: [Lane; 3],
    pub(crate) normal: [Lane; 3],
    /// Variance of the depth, square metres.
    pub(crate) variance: Lane,
}

impl Samples {
    const NONE: Self =
        Self { point: [[f32::NAN; LANES]; 3], normal: [[0.0; LANES]; 3], variance: [0.0; LANES] };
}

/// A view with what association needs precomputed.
#[derive(Debug)]
pub(crate) struct Cloud<'a> {
    pub(crate) view: &'a DenseView,
    pub(crate) fx: f32,
    pub(crate) fy: f32,
    pub(crate) cx: f32,
    pub(crate) cy: f32,
    pub(crate) width: i32,
    pub(crate) height: i32,
    /// Metres per pixel of offset and metre of depth that a ray at least keeps from a point.
    pub(crate) reach: f32,
    samples: Vec<Samples>,
    /// Pixels that each of the samples stands for.
    share: f64,
    /// Every `stride`-th of the samples.
    coarse: Vec<Samples>,
    stride: usize,
    /// Of the samples, camera frame.
    pub(crate) extent: Extent,
    /// Mean of the samples, camera frame.
    pub(crate) centre: [f32; 3],
    /// Largest distance of a sample from the centre, metres.
    pub(crate) radius: f32,
    /// Size of a pixel at the depth of the centre, metres.
    pub(crate) pixel_size: f32,
}

impl<'a> Cloud<'a> {
    /// At most `most` samples are matched, while the gates are wide about `coarse`.
    pub(crate) fn new(view: &'a DenseView, options: &SolveOptions, (most, coarse): (usize, usize)) -> Self {
        let pixels = view.spread(most);
        let wanted = view.spread(options.max_dense_per_edge);
        let points = || pixels.clone().map(|k| in_three(&view.pixels[k as usize].point));
        let extent = Extent::of(points());
        let centre: [f32; 3] = extent.centre.cast::<f32>().into();
        let squared = |p: [f32; 3]| (0..3).map(|k| (p[k] - centre[k]).powi(2)).sum::<f32>();
        let radius = points().map(squared).fold(0.0, f32::max).sqrt();
        let stride = (pixels.len() / coarse.max(1)).max(1);
        let every = pixels.clone().skip(stride / 2).step_by(stride);
        // The ray of a pixel `k` pixels from the projection of a point at depth z passes it at a distance of at
        // least `k z / f` times the cosine of the ray's angle, which is smallest in a corner of the image.
        let Pinhole { fx, fy, cx, cy } = view.camera;
        let x = cx.abs().max((view.width as f64 - cx).abs()) / fx;
        let y = cy.abs().max((view.height as f64 - cy).abs()) / fy;
        let focal = fx.max(fy);
        Self {
            view,
            fx: fx as f32,
            fy: fy as f32,
            cx: cx as f32,
            cy: cy as f32,
            width: view.width as i32,
            height: view.height as i32,
            reach: (1.0 / ((1.0 + x * x + y * y).sqrt() * focal)) as f32,
            samples: in_lanes(view, pixels.clone(), options),
            coarse: in_lanes(view, every, options),
            share: wanted.len() as f64 / pixels.len().max(1) as f64,
            stride,
            pixel_size: centre[2] / focal as f32,
            extent,
            centre,
            radius,
        }
    }

    /// The samples to match under these gates, and how many of an edge's pixels each stands for.
    pub(crate) fn samples(&self, gates: &Gates) -> (&[Samples], f64) {
        if gates.last { (&self.samples, self.share) } else { (&self.coarse, self.share * self.stride as f64) }
    }
}

fn in_lanes(view: &DenseView, pixels: impl Iterator<Item = u32>, options: &SolveOptions) -> Vec<Samples> {
    let mut blocks = Vec::new();
    for (k, pixel) in pixels.enumerate() {
        let (Pixel { point, normal }, l) = (&view.pixels[pixel as usize], k % LANES);
        if l == 0 {
            blocks.push(Samples::NONE);
        }
        let samples = &mut blocks[k / LANES];
        for k in 0..3 {
            samples.point[k][l] = point[k];
            samples.normal[k][l] = normal[k];
        }
        samples.variance[l] = options.depth_variance(f64::from(point[2])) as f32;
    }
    blocks
}

fn in_three(&[x, y, z, _]: &[f32; 4]) -> [f32; 3] {
    [x, y, z]
}
