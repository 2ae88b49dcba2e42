//! The built-in matcher: difference-of-Gaussians keypoints with gradient-histogram descriptors.
//!
//! Own writing after Lowe, *Distinctive image features from scale-invariant keypoints*, IJCV 2004. Two things are
//! different because the input is a masked, roll-normalised crop: the background is replaced by a smooth continuation of
//! the object, so that the silhouette neither makes keypoints nor enters descriptors; and descriptors are upright by
//! default, because the roll is gone and an orientation estimate would only add ambiguity.

use crate::blur::Gaussian;
use crate::corners::erode;
use crate::crop::RollCrop;
use crate::descriptor::{Describer, LEN};
use crate::fill::fill_background;
use crate::matching::{Descriptors, FeatureMatcher, Features, Match, nearest_neighbours};
use rgbd_io::{Image, Mask};

/// Which way is up for a descriptor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Orientation {
    /// The crop's own: right where the roll between the views is known to about 25 degrees.
    #[default]
    Upright,
    /// The strongest gradient of the patch: any roll, a little less distinctive.
    Dominant,
}

/// How keypoints are found and matched.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScaleSpaceOptions {
    /// At most this many keypoints of a crop, strongest first.
    pub max_features: usize,
    /// Smallest difference of Gaussians at a keypoint, gray levels (0 to 255).
    pub contrast: f32,
    /// Largest ratio of the principal curvatures (Lowe's r): above are edges.
    pub edge_ratio: f32,
    /// At most this many octaves.
    pub octaves: usize,
    /// Which way is up.
    pub orientation: Orientation,
    /// Largest ratio of the distances to the best and to the second best descriptor.
    pub max_ratio: f32,
}

impl Default for ScaleSpaceOptions {
    fn default() -> Self {
        Self {
            max_features: 500,
            contrast: 2.0,
            edge_ratio: 10.0,
            octaves: 4,
            orientation: Orientation::Upright,
            max_ratio: 0.8,
        }
    }
}

/// Scale-space features with mutual nearest neighbours and the ratio test.
#[derive(Clone, Copy, Debug, Default)]
pub struct ScaleSpaceMatcher {
    /// How keypoints are found and matched.
    pub options: ScaleSpaceOptions,
}

impl FeatureMatcher for ScaleSpaceMatcher {
    fn detect(&self, crop: &RollCrop) -> Features {
        detect(crop, &self.options)
    }

    fn match_features(&self, a: &Features, b: &Features) -> Vec<Match> {
        nearest_neighbours(a, b, self.options.max_ratio)
    }
}

/// Scales sampled in an octave.
const INTERVALS: usize = 3;
/// Blur of the first image of each octave, its pixels.
const SIGMA: f32 = 1.6;
/// Blur of a camera's image, pixels.
const CAMERA_SIGMA: f32 = 0.5;

/// A keypoint in pixels of its octave.
#[derive(Clone, Copy, Debug)]
struct Keypoint {
    octave: usize,
    /// Gaussian image from which it is described.
    layer: usize,
    x: f32,
    y: f32,
    /// Blur at which it was found, octave pixels.
    sigma: f32,
    response: f32,
}

/// The blurred images of one octave.
type Octave = Vec<Image<f32>>;

fn detect(crop: &RollCrop, options: &ScaleSpaceOptions) -> Features {
    let mut inner = erode(crop.mask(), 2);
    if inner.pixels().iter().all(|&m| m == 0) {
        inner = crop.mask().clone();
    }
    if inner.pixels().iter().all(|&m| m == 0) || crop.gray().pixels().iter().any(|v| !v.is_finite()) {
        return Features::default();
    }
    let octaves =
        build(&fill_background(crop.gray(), &inner), crop.scale() as f32, options.octaves.clamp(1, 8));
    let mut keypoints = Vec::new();
    for (index, images) in octaves.iter().enumerate() {
        find_extrema(index, images, &inner, options, &mut keypoints);
    }
    // Strongest first; ties by position so that the order is defined.
    keypoints.sort_by(|a, b| {
        b.response
            .total_cmp(&a.response)
            .then(a.octave.cmp(&b.octave))
            .then(a.y.total_cmp(&b.y))
            .then(a.x.total_cmp(&b.x))
    });
    keypoints.truncate(options.max_features);
    describe(crop, &octaves, &keypoints, options)
}

/// Gaussian octaves of `image`, which is `upscale` times as fine as the camera's.
fn build(image: &Image<f32>, upscale: f32, count: usize) -> Vec<Octave> {
    const SMALLEST: usize = 24;
    let mut scratch = Vec::new();
    let blurred = CAMERA_SIGMA * upscale.max(1.0);
    let mut base =
        Gaussian::new((SIGMA * SIGMA - blurred * blurred).max(0.01).sqrt()).filter(image, &mut scratch);
    let step = 2.0_f32.powf(1.0 / INTERVALS as f32);
    let filters: Vec<Gaussian> = (0..INTERVALS + 2)
        .map(|i| {
            let (from, to) = (SIGMA * step.powi(i as i32), SIGMA * step.powi(i as i32 + 1));
            Gaussian::new((to * to - from * from).sqrt())
        })
        .collect();
    let mut octaves: Vec<Octave> = Vec::new();
    loop {
        let mut images = vec![base];
        for filter in &filters {
            if let Some(last) = images.last() {
                let next = filter.filter(last, &mut scratch);
                images.push(next);
            }
        }
        let (width, height) = images[0].size();
        let doubled = &images[INTERVALS];
        let next = Image::from_fn(width / 2, height / 2, |x, y| doubled[(2 * x, 2 * y)]);
        octaves.push(images);
        if octaves.len() == count || next.width().min(next.height()) < SMALLEST {
            return octaves;
        }
        base = next;
    }
}

/// Appends the extrema of the differences of Gaussians of one octave (Lowe, sections 3 and 4).
fn find_extrema(
    octave: usize,
    images: &[Image<f32>],
    inner: &Mask,
    options: &ScaleSpaceOptions,
    out: &mut Vec<Keypoint>,
) {
    let dogs: Vec<Image<f32>> = images
        .windows(2)
        .map(|pair| {
            let differences = pair[1].pixels().iter().zip(pair[0].pixels()).map(|(b, a)| b - a).collect();
            Image::from_vec(pair[0].width(), pair[0].height(), differences).unwrap_or_default()
        })
        .collect();
    let (width, height) = images[0].size();
    let space = Dogs { images: &dogs, width };
    const BORDER: usize = 3;
    for layer in 1..=INTERVALS {
        for y in BORDER..height.saturating_sub(BORDER) {
            let row = dogs[layer].row(y);
            for x in BORDER..width.saturating_sub(BORDER) {
                let value = row[x];
                // Most pixels lie between their two neighbours: told here, without a call.
                let is_candidate = value.abs() >= 0.5 * options.contrast
                    && (value - row[x - 1]) * (value - row[x + 1]) >= 0.0;
                let at = y * width + x;
                if !is_candidate || !space.is_extremum(layer, at) {
                    continue;
                }
                if let Some(k) = space.refine(octave, layer, at, options)
                    && in_mask(inner, &k)
                {
                    out.push(k);
                }
            }
        }
    }
}

fn in_mask(mask: &Mask, k: &Keypoint) -> bool {
    let scale = (1_u32 << k.octave) as f32;
    let (x, y) = ((k.x * scale + 0.5) as usize, (k.y * scale + 0.5) as usize);
    mask.get(x, y).is_some_and(|&m| m != 0)
}

/// The differences of one octave.
struct Dogs<'a> {
    images: &'a [Image<f32>],
    width: usize,
}

impl Dogs<'_> {
    #[inline]
    fn at(&self, layer: usize, at: usize) -> f32 {
        self.images[layer].pixels()[at]
    }

    /// Whether the pixel is the largest or the smallest of its 26 neighbours in space and scale.
    fn is_extremum(&self, layer: usize, at: usize) -> bool {
        let value = self.at(layer, at);
        let sign = if value > 0.0 { 1.0 } else { -1.0 };
        let value = sign * value;
        // Own layer first: most pixels fail there.
        for l in [layer, layer - 1, layer + 1] {
            let pixels = self.images[l].pixels();
            for row in [at - self.width, at, at + self.width] {
                for o in row - 1..=row + 1 {
                    let other = sign * pixels[o];
                    if other > value || (other == value && (l < layer || (l == layer && o < at))) {
                        return false;
                    }
                }
            }
        }
        true
    }

    /// Gradient and Hessian `[xx, yy, ss, xy, xs, ys]` by differences.
    fn derivatives(&self, layer: usize, at: usize) -> ([f32; 3], [f32; 6]) {
        let w = self.width;
        let d = |l: usize, a: usize| self.at(l, a);
        let centre = d(layer, at);
        let gradient = [
            0.5 * (d(layer, at + 1) - d(layer, at - 1)),
            0.5 * (d(layer, at + w) - d(layer, at - w)),
            0.5 * (d(layer + 1, at) - d(layer - 1, at)),
        ];
        let hessian = [
            d(layer, at + 1) + d(layer, at - 1) - 2.0 * centre,
            d(layer, at + w) + d(layer, at - w) - 2.0 * centre,
            d(layer + 1, at) + d(layer - 1, at) - 2.0 * centre,
            0.25 * (d(layer, at + w + 1) - d(layer, at + w - 1) - d(layer, at - w + 1)
                + d(layer, at - w - 1)),
            0.25 * (d(layer + 1, at + 1) - d(layer + 1, at - 1) - d(layer - 1, at + 1)
                + d(layer - 1, at - 1)),
            0.25 * (d(layer + 1, at + w) - d(layer + 1, at - w) - d(layer - 1, at + w)
                + d(layer - 1, at - w)),
        ];
        (gradient, hessian)
    }

    /// Fits a quadric, moves to its top, and tests contrast and edges there.
    fn refine(
        &self,
        octave: usize,
        mut layer: usize,
        mut at: usize,
        options: &ScaleSpaceOptions,
    ) -> Option<Keypoint> {
        let width = self.width;
        let height = self.images[0].height();
        for _ in 0..5 {
            let (g, h) = self.derivatives(layer, at);
            let offset = solve(g, h)?;
            if offset.iter().all(|o| o.abs() <= 0.6) {
                let value =
                    self.at(layer, at) + 0.5 * (g[0] * offset[0] + g[1] * offset[1] + g[2] * offset[2]);
                let (trace, det) = (h[0] + h[1], h[0] * h[1] - h[3] * h[3]);
                let r = options.edge_ratio;
                if value.abs() < options.contrast
                    || det <= 0.0
                    || trace * trace * r >= (r + 1.0) * (r + 1.0) * det
                {
                    return None;
                }
                let scale = layer as f32 + offset[2];
                return Some(Keypoint {
                    octave,
                    layer: (scale.round() as usize).min(INTERVALS + 1),
                    x: (at % width) as f32 + offset[0],
                    y: (at / width) as f32 + offset[1],
                    sigma: SIGMA * 2.0_f32.powf(scale / INTERVALS as f32),
                    response: value.abs(),
                });
            }
            let step = offset.map(|o| o.round().clamp(-1.0, 1.0) as isize);
            let (x, y) = ((at % width) as isize + step[0], (at / width) as isize + step[1]);
            let next = layer as isize + step[2];
            if step == [0, 0, 0]
                || !(1..=INTERVALS as isize).contains(&next)
                || !(1..width as isize - 1).contains(&x)
                || !(1..height as isize - 1).contains(&y)
            {
                return None;
            }
            layer = next as usize;
            at = y as usize * width + x as usize;
        }
        None
    }
}

/// `-H^-1 g` for the symmetric Hessian `[xx, yy, ss, xy, xs, ys]`.
fn solve(g: [f32; 3], [xx, yy, ss, xy, xs, ys]: [f32; 6]) -> Option<[f32; 3]> {
    let (a, b, c) = (yy * ss - ys * ys, xs * ys - xy * ss, xy * ys - yy * xs);
    let det = xx * a + xy * b + xs * c;
    let (e, f, i) = (xx * ss - xs * xs, xy * xs - xx * ys, xx * yy - xy * xy);
    let solution = [
        -(a * g[0] + b * g[1] + c * g[2]) / det,
        -(b * g[0] + e * g[1] + f * g[2]) / det,
        -(c * g[0] + f * g[1] + i * g[2]) / det,
    ];
    solution.iter().all(|v| v.is_finite()).then_some(solution)
}

fn describe(
    crop: &RollCrop,
    octaves: &[Octave],
    keypoints: &[Keypoint],
    options: &ScaleSpaceOptions,
) -> Features {
    let mut features = Features::default();
    let mut values = Vec::with_capacity(keypoints.len() * LEN);
    let mut describer = Describer::new();
    let mut angles = vec![0.0];
    for k in keypoints {
        let image = &octaves[k.octave][k.layer];
        if options.orientation == Orientation::Dominant {
            describer.orientations(image, k.x, k.y, k.sigma, &mut angles);
        }
        let scale = (1_u32 << k.octave) as f32;
        for &angle in &angles {
            if describer.describe(image, [k.x, k.y], k.sigma, angle, &mut values) {
                features.points.push(crop.to_image([k.x * scale, k.y * scale]));
                features.scales.push(k.sigma * scale / crop.scale() as f32);
            }
        }
    }
    features.descriptors = Descriptors::U8 { len: LEN, values };
    features
}
