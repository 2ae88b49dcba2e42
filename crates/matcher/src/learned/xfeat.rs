//! XFeat: keypoints by cell-wise classification, descriptors at an eighth of the resolution.
//!
//! Potje, Cadar, Araujo, Martins and Nascimento, *XFeat: Accelerated Features for Lightweight Image Matching*, CVPR 2024.
//! Own writing of the forward pass of the sparse variant; the weights are the authors'.

use super::detect::{Detections, detect};
use super::keypoints::{bicubic, bilinear, centroid, descriptors, local_maxima, sample};
use super::nn::{After, Conv, Map, add_upsampled, average_pool, pixel_shuffle, pixel_unshuffle};
use super::weights::{Tensor, Weights};
use super::{Error, LearnedOptions, cosine};
use crate::crop::RollCrop;
use crate::matching::{FeatureMatcher, Features, Match};
use rgbd_io::{Image, Mask};

const NETWORK: &str = "XFeat";
/// Sides of the input are multiples of this.
const MULTIPLE: usize = 32;
/// Pixels along a cell of the detector and of the descriptor map.
const CELL: usize = 8;
/// Smallest probability of a keypoint, as the authors have it.
const MIN_PROBABILITY: f32 = 0.05;

/// A convolution: name, kernel, stride and whether ReLU follows.
type Layer = (&'static str, usize, usize, bool);
/// Convolutions in a row: the first and the rest.
type Plan = (Layer, &'static [Layer]);

const BLOCK1: Plan = (
    ("block1.0", 3, 1, true),
    &[("block1.1", 3, 2, true), ("block1.2", 3, 1, true), ("block1.3", 3, 2, true)],
);
const BLOCK2: Plan = (("block2.0", 3, 1, true), &[("block2.1", 3, 1, true)]);
const BLOCK3: Plan = (("block3.0", 3, 2, true), &[("block3.1", 3, 1, true), ("block3.2", 1, 1, true)]);
const BLOCK4: Plan = (("block4.0", 3, 2, true), &[("block4.1", 3, 1, true), ("block4.2", 3, 1, true)]);
const BLOCK5: Plan = (
    ("block5.0", 3, 2, true),
    &[("block5.1", 3, 1, true), ("block5.2", 3, 1, true), ("block5.3", 1, 1, true)],
);
const FUSION: Plan =
    (("block_fusion.0", 3, 1, true), &[("block_fusion.1", 3, 1, true), ("block_fusion.2", 1, 1, false)]);
const RELIABILITY: Plan =
    (("heatmap_head.0", 1, 1, true), &[("heatmap_head.1", 1, 1, true), ("heatmap_head.2", 1, 1, false)]);
const KEYPOINTS: Plan = (
    ("keypoint_head.0", 1, 1, true),
    &[("keypoint_head.1", 1, 1, true), ("keypoint_head.2", 1, 1, true), ("keypoint_head.3", 1, 1, false)],
);

/// The network with its weights, as a matcher.
#[derive(Clone, Debug)]
pub struct XFeat {
    /// How features are chosen and matched.
    pub options: LearnedOptions,
    skip: Conv,
    blocks: [Chain; 5],
    fusion: Chain,
    reliability: Chain,
    keypoints: Chain,
}

/// Convolutions in a row, each with its ReLU or without.
#[derive(Clone, Debug)]
struct Chain {
    first: (Conv, bool),
    rest: Vec<(Conv, bool)>,
}

impl Chain {
    fn new(weights: &Weights, (first, rest): Plan, inputs: usize) -> Result<Self, Error> {
        let conv = |(name, kernel, stride, relu): Layer, inputs| {
            Ok::<_, Error>((weights.conv(name, inputs, kernel, stride, NETWORK)?, relu))
        };
        let mut chain = Self { first: conv(first, inputs)?, rest: Vec::with_capacity(rest.len()) };
        for layer in rest {
            let next = conv(*layer, chain.outputs())?;
            chain.rest.push(next);
        }
        Ok(chain)
    }

    fn run(&self, x: &Map) -> Map {
        let run =
            |conv: &Conv, relu: bool, x: &Map| conv.run(x, if relu { After::Relu } else { After::Linear });
        let mut out = run(&self.first.0, self.first.1, x);
        for (conv, relu) in &self.rest {
            out = run(conv, *relu, &out);
        }
        out
    }

    fn outputs(&self) -> usize {
        self.rest.last().unwrap_or(&self.first).0.outputs()
    }
}

struct Maps {
    features: Map,
    logits: Map,
    reliability: Map,
}

/// The network's outputs for an image whose sides are `height` and `width`, rounded up to multiples of 32.
#[derive(Clone, Debug, PartialEq)]
pub struct XFeatMaps {
    /// Descriptors `[64, height / 8, width / 8]`, not normalised.
    pub features: Tensor,
    /// For each cell, scores of its 64 pixels and of "no keypoint" `[65, height / 8, width / 8]`, logits.
    pub keypoint_logits: Tensor,
    /// Probability that a descriptor can be matched `[1, height / 8, width / 8]`.
    pub reliability: Tensor,
}

impl XFeat {
    /// The network of the tensors of the authors' file. Those of the semi-dense variant's matcher may be there; they are
    /// not used.
    ///
    /// # Errors
    /// Tensors that are missing or do not fit each other.
    pub fn new(weights: &Weights, options: LearnedOptions) -> Result<Self, Error> {
        let block1 = Chain::new(weights, BLOCK1, 1)?;
        let skip = weights.conv("skip1.1", 1, 1, 1, NETWORK)?;
        let block2 = Chain::new(weights, BLOCK2, block1.outputs())?;
        let block3 = Chain::new(weights, BLOCK3, block2.outputs())?;
        let block4 = Chain::new(weights, BLOCK4, block3.outputs())?;
        let block5 = Chain::new(weights, BLOCK5, block4.outputs())?;
        let fusion = Chain::new(weights, FUSION, block3.outputs())?;
        let reliability = Chain::new(weights, RELIABILITY, fusion.outputs())?;
        let keypoints = Chain::new(weights, KEYPOINTS, CELL * CELL)?;
        let fits = [
            ("skip1.1.weight", skip.outputs() == block1.outputs()),
            ("block4.2.weight", block4.outputs() == block3.outputs()),
            ("block5.3.weight", block5.outputs() == block3.outputs()),
            ("heatmap_head.2.weight", reliability.outputs() == 1),
            ("keypoint_head.3.weight", keypoints.outputs() == CELL * CELL + 1),
        ];
        if let Some((name, _)) = fits.iter().find(|(_, fits)| !fits) {
            let problem = "has another number of outputs than the network needs".into();
            return Err(Error::Tensor { name: (*name).into(), problem, network: NETWORK });
        }
        Ok(Self {
            options,
            skip,
            blocks: [block1, block2, block3, block4, block5],
            fusion,
            reliability,
            keypoints,
        })
    }

    /// The network's outputs for a gray image in any unit; its edges are repeated up to multiples of 32 pixels.
    pub fn maps(&self, gray: &Image<f32>) -> XFeatMaps {
        let maps = self.forward(gray);
        let tensor = |map: &Map| Tensor {
            shape: vec![map.channels(), map.height(), map.width()],
            values: map.to_dense(),
        };
        XFeatMaps {
            features: tensor(&maps.features),
            keypoint_logits: tensor(&maps.logits),
            reliability: tensor(&maps.reliability),
        }
    }

    fn forward(&self, gray: &Image<f32>) -> Maps {
        let input = Map::normalised(gray, MULTIPLE);
        let mut quarter = self.blocks[0].run(&input);
        // Same size, so that "enlarging" only adds.
        add_upsampled(&mut quarter, &self.skip.run(&average_pool(&input, 4), After::Linear));
        let mut eighth = self.blocks[2].run(&self.blocks[1].run(&quarter));
        let x4 = self.blocks[3].run(&eighth);
        let x5 = self.blocks[4].run(&x4);
        add_upsampled(&mut eighth, &x4);
        add_upsampled(&mut eighth, &x5);
        let features = self.fusion.run(&eighth);
        let logits = self.keypoints.run(&pixel_unshuffle(&input, CELL));
        let scores = self.reliability.run(&features);
        let sigmoid = |_: usize, x: usize, y: usize| 1.0 / (1.0 + (-scores.at(0, x, y)).exp());
        let reliability = Map::from_fn(1, scores.width(), scores.height(), sigmoid);
        Maps { features, logits, reliability }
    }

    fn find(&self, gray: &Image<f32>, allowed: &Mask) -> Detections {
        let Maps { mut features, logits, reliability } = self.forward(gray);
        features.normalise_pixels();
        let heat = heat_map(&logits);
        // The authors' maps from pixels of the image to those of the small maps.
        let per_pixel = |size: usize, cells: usize| cells as f32 / (size as f32 - 1.0).max(1.0);
        let steps = [per_pixel(heat.width(), features.width()), per_pixel(heat.height(), features.height())];
        let small = |p: [f32; 2]| [p[0] * steps[0] - 0.5, p[1] * steps[1] - 0.5];

        let pixels = local_maxima(&heat, allowed, 1, MIN_PROBABILITY);
        let taps: Vec<_> =
            pixels.iter().map(|p| bilinear(&reliability, small(p.map(|v| v as f32)))).collect();
        let trust = sample(&reliability, &taps);
        let mut found: Vec<_> =
            pixels.iter().zip(trust.row(0, 0)).map(|(&[x, y], r)| (heat.at(0, x, y) * r, [x, y])).collect();
        found.sort_by(|a, b| b.0.total_cmp(&a.0));
        found.truncate(self.options.max_features);

        let place = |&(_, [x, y]): &(f32, [usize; 2])| {
            let [dx, dy] = centroid(&heat, [x, y], |v| v);
            [x as f32 + dx, y as f32 + dy]
        };
        let points: Vec<[f32; 2]> = found.iter().map(place).collect();
        let taps: Vec<_> = points.iter().map(|&p| bicubic(&features, small(p))).collect();
        Detections {
            points,
            descriptors: descriptors(sample(&features, &taps)),
            descriptor_len: features.channels(),
            size: 0.5 * CELL as f32,
        }
    }
}

/// Probability of a keypoint at each pixel: softmax over the 64 pixels of a cell and "none", put in their places.
fn heat_map(logits: &Map) -> Map {
    let (width, height) = (logits.width(), logits.height());
    let mut cells = Map::zeros(CELL * CELL, width, height);
    let (mut largest, mut sum) = (vec![0.0_f32; width], vec![0.0_f32; width]);
    for y in 0..height {
        largest.fill(f32::NEG_INFINITY);
        sum.fill(0.0);
        for c in 0..logits.channels() {
            largest.iter_mut().zip(logits.row(c, y)).for_each(|(m, v)| *m = m.max(*v));
        }
        for c in 0..logits.channels() {
            let row = logits.row(c, y);
            for x in 0..width {
                let e = (row[x] - largest[x]).exp();
                sum[x] += e;
                if c < CELL * CELL {
                    cells.row_mut(c, y)[x] = e;
                }
            }
        }
        for c in 0..CELL * CELL {
            cells.row_mut(c, y).iter_mut().zip(&sum).for_each(|(v, s)| *v /= s);
        }
    }
    pixel_shuffle(&cells, CELL)
}

impl FeatureMatcher for XFeat {
    fn detect(&self, crop: &RollCrop) -> Features {
        detect(crop, &self.options, |gray, allowed| self.find(gray, allowed))
    }

    fn match_features(&self, a: &Features, b: &Features) -> Vec<Match> {
        cosine::mutual_nearest(a, b, self.options.min_cosine)
    }
}
