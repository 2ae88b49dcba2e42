//! EdgePoint2: a small network for keypoints at full and descriptors at quarter resolution.
//!
//! Yao, Hao et al., *EdgePoint2: Compact Descriptors for Superior Efficiency and Accuracy*, 2025. Own writing of the
//! forward pass; the weights are the authors'.

use super::detect::{Detections, detect};
use super::keypoints::{bilinear, centroid, descriptors, local_maxima, sample};
use super::nn::{After, Conv, Map, add_upsampled, average_pool, pixel_shuffle};
use super::weights::{Folded, Tensor, Weights};
use super::{Error, LearnedOptions, cosine};
use crate::crop::RollCrop;
use crate::matching::{FeatureMatcher, Features, Match};
use rgbd_io::{Image, Mask};

const NETWORK: &str = "EdgePoint2";
/// Sides of the input are multiples of this.
const MULTIPLE: usize = 32;
/// Pixels of the image per pixel of the descriptor map.
const CELL: f32 = 4.0;
/// Smallest raw score of a keypoint (a logit), and its distance from the image's edge, as the authors have them.
const MIN_SCORE: f32 = -5.0;
const BORDER: usize = 4;

/// The published sizes: channels of the three stages (the first has two), of a descriptor and of the detector.
const SIZES: [(&str, [usize; 6]); 5] = [
    ("EdgePoint2-T32", [8, 8, 16, 24, 32, 8]),
    ("EdgePoint2-S64", [8, 8, 24, 32, 64, 8]),
    ("EdgePoint2-M64", [8, 16, 32, 48, 64, 8]),
    ("EdgePoint2-L64", [8, 16, 48, 64, 64, 8]),
    ("EdgePoint2-E64", [16, 16, 48, 64, 64, 16]),
];

/// The network with its weights, as a matcher.
#[derive(Clone, Debug)]
pub struct EdgePoint2 {
    /// How features are chosen and matched.
    pub options: LearnedOptions,
    name: &'static str,
    stem: [Conv; 2],
    stages: [Residual; 3],
    /// The first layer of the descriptor head, cut by the stage whose channels it takes.
    describe_stages: [Conv; 3],
    describe_group: Conv,
    describe_last: Conv,
    score_stages: [Conv; 3],
    score_head: [Conv; 3],
}

/// `relu(conv(relu(conv(x))) + skip(x))`.
#[derive(Clone, Debug)]
struct Residual {
    first: Conv,
    second: Conv,
    skip: Option<Conv>,
}

impl Residual {
    fn new(weights: &Weights, name: &str, inputs: usize) -> Result<Self, Error> {
        let first = weights.conv(&format!("{name}.layer.0"), inputs, 3, 1, NETWORK)?;
        let second = weights.conv(&format!("{name}.layer.3"), first.outputs(), 3, 1, NETWORK)?;
        let skip = format!("{name}.skip");
        let skip =
            if weights.has_conv(&skip) { Some(weights.conv(&skip, inputs, 1, 1, NETWORK)?) } else { None };
        let width = skip.as_ref().map_or(inputs, Conv::outputs);
        if width != second.outputs() {
            return Err(Error::Tensor {
                name: format!("{name}.skip.weight"),
                problem: format!(
                    "gives {width} channels where the layer beside it gives {}",
                    second.outputs()
                ),
                network: NETWORK,
            });
        }
        Ok(Self { first, second, skip })
    }

    fn run(&self, x: &Map) -> Map {
        let inner = self.first.run(x, After::Relu);
        match &self.skip {
            Some(skip) => self.second.run(&inner, After::AddRelu(&skip.run(x, After::Linear))),
            None => self.second.run(&inner, After::AddRelu(x)),
        }
    }

    fn outputs(&self) -> usize {
        self.second.outputs()
    }
}

/// The network's two outputs.
struct Maps {
    /// Inputs of the last layer of the descriptor head, at a quarter of the resolution.
    before_descriptors: Map,
    /// Raw scores (logits) at full resolution.
    scores: Map,
}

/// The network's outputs for an image whose sides are `height` and `width`, rounded up to multiples of 32.
#[derive(Clone, Debug, PartialEq)]
pub struct EdgePoint2Maps {
    /// Descriptors `[32 or 64, height / 4, width / 4]`, not normalised.
    pub descriptors: Tensor,
    /// Raw scores `[1, height, width]`, logits.
    pub scores: Tensor,
}

impl EdgePoint2 {
    /// The network of the tensors of one of the authors' files; its size is told from their shapes.
    ///
    /// # Errors
    /// Tensors that are missing or do not fit each other.
    pub fn new(weights: &Weights, options: LearnedOptions) -> Result<Self, Error> {
        let conv = |name: &str, inputs, kernel, stride| weights.conv(name, inputs, kernel, stride, NETWORK);
        let stem0 = conv("block1.0", 1, 4, 2)?;
        let stem1 = conv("block1.1", stem0.outputs(), 3, 1)?;
        let stage1 = Residual::new(weights, "block1.2", stem1.outputs())?;
        let stage2 = Residual::new(weights, "block2", stage1.outputs())?;
        let stage3 = Residual::new(weights, "block3", stage2.outputs())?;
        let stages = [stage1, stage2, stage3];
        let widths = [0, 1, 2].map(|i| stages[i].outputs());

        let [d0, d1, d2] = split(&weights.folded("desc_head.0", 1, NETWORK)?, widths)?;
        let describe_group = conv("desc_head.1", d0.outputs(), 3, 1)?;
        let describe_last = conv("desc_head.2", describe_group.outputs(), 1, 1)?;
        let scores = [
            conv("conv1", widths[0], 1, 1)?,
            conv("conv2", widths[1], 1, 1)?,
            conv("conv3", widths[2], 1, 1)?,
        ];
        let detect = scores[0].outputs();
        if scores.iter().any(|c| c.outputs() != detect) {
            return Err(shape_error("conv2.weight", "has another number of outputs than conv1"));
        }
        let head0 = conv("score_head.0", detect, 3, 1)?;
        let head1 = conv("score_head.2", head0.outputs(), 3, 1)?;
        let head2 = conv("score_head.4", head1.outputs(), 3, 1)?;
        if head2.outputs() != 4 {
            return Err(shape_error("score_head.4.weight", "does not have 4 outputs"));
        }
        let sizes = [stem0.outputs(), widths[0], widths[1], widths[2], describe_last.outputs(), detect];
        let name = SIZES.iter().find(|(_, s)| *s == sizes).map_or(NETWORK, |(name, _)| name);
        Ok(Self {
            options,
            name,
            stem: [stem0, stem1],
            stages,
            describe_stages: [d0, d1, d2],
            describe_group,
            describe_last,
            score_stages: scores,
            score_head: [head0, head1, head2],
        })
    }

    /// Which of the published networks it is: "EdgePoint2-L64", or "EdgePoint2" for another size.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// The network's outputs for a gray image in any unit; its edges are repeated up to multiples of 32 pixels.
    pub fn maps(&self, gray: &Image<f32>) -> EdgePoint2Maps {
        let maps = self.forward(gray);
        let tensor = |map: &Map| Tensor {
            shape: vec![map.channels(), map.height(), map.width()],
            values: map.to_dense(),
        };
        let descriptors = self.describe_last.run(&maps.before_descriptors, After::Linear);
        EdgePoint2Maps { descriptors: tensor(&descriptors), scores: tensor(&maps.scores) }
    }

    fn forward(&self, gray: &Image<f32>) -> Maps {
        let input = Map::normalised(gray, MULTIPLE);
        let x = self.stem[1].run(&self.stem[0].run(&input, After::Relu), After::Relu);
        let half = self.stages[0].run(&x);
        let quarter = average_pool(&half, 2);
        let eighth = self.stages[1].run(&average_pool(&quarter, 2));
        let last = self.stages[2].run(&average_pool(&eighth, 4));

        // The head's first layer takes the three stages enlarged to the same size. It is linear, as enlarging is: the
        // two may be exchanged, and the layer then runs on the small maps.
        let mut x = self.describe_stages[0].run(&quarter, After::Linear);
        add_upsampled(&mut x, &self.describe_stages[1].run(&eighth, After::Linear));
        add_upsampled(&mut x, &self.describe_stages[2].run(&last, After::Linear));
        let before_descriptors = self.describe_group.run(&x, After::Relu);

        let mut x = self.score_stages[0].run(&half, After::Linear);
        add_upsampled(&mut x, &self.score_stages[1].run(&eighth, After::Linear));
        add_upsampled(&mut x, &self.score_stages[2].run(&last, After::Linear));
        let x = self.score_head[1].run(&self.score_head[0].run(&x, After::Relu), After::Relu);
        let scores = pixel_shuffle(&self.score_head[2].run(&x, After::Linear), 2);
        Maps { before_descriptors, scores }
    }

    fn find(&self, gray: &Image<f32>, allowed: &Mask) -> Detections {
        let Maps { before_descriptors, scores } = self.forward(gray);
        let mut found: Vec<_> = local_maxima(&scores, allowed, BORDER, MIN_SCORE)
            .into_iter()
            .map(|[x, y]| (scores.at(0, x, y), [x, y]))
            .collect();
        found.sort_by(|a, b| b.0.total_cmp(&a.0));
        found.truncate(self.options.max_features);
        let place = |&(score, [x, y]): &(f32, [usize; 2])| {
            // Soft-argmax at temperature 1.
            let [dx, dy] = centroid(&scores, [x, y], |v| (v - score).exp());
            [x as f32 + dx, y as f32 + dy]
        };
        let points: Vec<[f32; 2]> = found.iter().map(place).collect();
        let at = |p: &[f32; 2]| bilinear(&before_descriptors, p.map(|v| (v + 0.5) / CELL - 0.5));
        let taps: Vec<_> = points.iter().map(at).collect();
        // The last layer is linear, too: only the points need it.
        let described = self.describe_last.run(&sample(&before_descriptors, &taps), After::Linear);
        Detections {
            points,
            descriptors: descriptors(described),
            descriptor_len: self.describe_last.outputs(),
            size: 0.5 * CELL,
        }
    }
}

impl FeatureMatcher for EdgePoint2 {
    fn detect(&self, crop: &RollCrop) -> Features {
        detect(crop, &self.options, |gray, allowed| self.find(gray, allowed))
    }

    fn match_features(&self, a: &Features, b: &Features) -> Vec<Match> {
        cosine::mutual_nearest(a, b, self.options.min_cosine)
    }
}

fn shape_error(name: &str, problem: &str) -> Error {
    Error::Tensor { name: name.into(), problem: problem.into(), network: NETWORK }
}

/// A 1x1 convolution as the sum of three, each of some of the inputs; the first has the bias.
fn split(conv: &Folded, widths: [usize; 3]) -> Result<[Conv; 3], Error> {
    let [outputs, inputs, ..] = conv.shape;
    let wrong =
        || shape_error("desc_head.0.weight", "has another number of inputs than the stages have outputs");
    if inputs != widths.iter().sum::<usize>() {
        return Err(wrong());
    }
    let part = |first: usize, width: usize| {
        let rows = conv.weight.chunks_exact(inputs);
        let weight: Vec<f32> = rows.flat_map(|row| &row[first..first + width]).copied().collect();
        let bias = if first == 0 { conv.bias.clone() } else { vec![0.0; outputs] };
        Conv::new(width, [outputs, width, 1, 1], &weight, &bias, 1).ok_or_else(wrong)
    };
    Ok([part(0, widths[0])?, part(widths[0], widths[1])?, part(widths[0] + widths[1], widths[2])?])
}
