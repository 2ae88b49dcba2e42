//! Shapes and initial values of the two small networks, kept in one flat vector of weights.

use crate::gemm::transpose;
use crate::grid::mix;
use crate::harmonics;
use crate::real::Real;
use crate::tile::Aligned;
use std::ops::Range;

/// Rows of a matrix and its bias inside the flat weight vector. Weights are `[output][input]`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Layer {
    pub(crate) inputs: usize,
    pub(crate) outputs: usize,
    start: usize,
}

impl Layer {
    pub(crate) fn weights(&self) -> Range<usize> {
        self.start..self.start + self.inputs * self.outputs
    }

    pub(crate) fn bias(&self) -> Range<usize> {
        let end = self.weights().end;
        end..end + self.outputs
    }
}

/// One code per frame, input of the colour network: what light and exposure made of that frame. A last code stands
/// for no frame in particular.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Codes {
    /// Numbers in a code; 0 switches codes off.
    pub(crate) size: usize,
    frames: usize,
    start: usize,
}

impl Codes {
    pub(crate) fn of(&self, frame: usize) -> Range<usize> {
        let from = self.start + frame * self.size;
        from..from + self.size
    }

    pub(crate) fn neutral(&self) -> Range<usize> {
        self.of(self.frames)
    }

    /// Sets the neutral code to the mean of the frames'.
    pub(crate) fn settle(&self, weights: &mut [f32]) {
        for k in 0..self.size {
            let sum: f32 = (0..self.frames).map(|f| weights[self.of(f).start + k]).sum();
            weights[self.neutral().start + k] = sum / self.frames.max(1) as f32;
        }
    }
}

/// Places of transposed weights.
pub(crate) struct Flipped {
    /// Of the first geometry layer.
    pub(crate) hidden: Range<usize>,
    /// Of the geometry features' rows of the second, padded to [`Networks::padded_features`] columns of zeros.
    pub(crate) features: Range<usize>,
    /// Of the first two colour layers.
    pub(crate) color: [Range<usize>; 2],
}

/// Geometry: encoding -> hidden ReLU -> `[sdf | features]`. Colour: `[features | harmonics | code]` -> hidden
/// ReLU -> hidden ReLU -> 3, then a sigmoid. Input widths are padded to multiples of 8 with inputs that stay zero.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Networks {
    /// Geometry features that the colour network sees.
    pub(crate) features: usize,
    pub(crate) geometry: [Layer; 2],
    pub(crate) color: [Layer; 3],
    pub(crate) codes: Codes,
    pub(crate) len: usize,
}

impl Networks {
    /// `codes`: numbers in a frame's appearance code, and the number of frames.
    pub(crate) fn new(encoding: usize, hidden: usize, features: usize, codes: (usize, usize)) -> Self {
        let mut len = 0;
        let mut layer = |inputs: usize, outputs: usize| {
            let layer = Layer { inputs, outputs, start: len };
            len = layer.bias().end;
            layer
        };
        let geometry = [layer(encoding.next_multiple_of(8), hidden), layer(hidden, 1 + features)];
        let colour_in = (features + harmonics::COUNT + codes.0).next_multiple_of(8);
        let color = [layer(colour_in, hidden), layer(hidden, hidden), layer(hidden, 3)];
        let codes = Codes { size: codes.0, frames: codes.1, start: len };
        len += codes.size * (codes.frames + 1);
        Self { features, geometry, color, codes, len }
    }

    /// Geometry features in the transposed layer, rounded up to whole vectors.
    pub(crate) fn padded_features(&self) -> usize {
        self.features.next_multiple_of(8)
    }

    /// Inputs of the colour network from the last multiple of 8 among the geometry features on.
    pub(crate) fn view_inputs(&self) -> usize {
        self.color[0].inputs - self.features / 8 * 8
    }

    /// Transposes `[input][output]` of what the forward pass multiplies from the right; see [`flip`](Self::flip).
    pub(crate) fn flip_all<R: Real>(&self, weights: &[R]) -> Aligned<R> {
        let mut flipped = Aligned::zeros(self.flipped().1);
        self.flip(weights, &mut flipped);
        flipped
    }

    /// Writes the transposes anew.
    pub(crate) fn flip<R: Real>(&self, weights: &[R], flipped: &mut [R]) {
        let ([g0, g1], [c0, c1, _]) = (self.geometry, self.color);
        let Flipped { hidden, features, color } = self.flipped().0;
        let mut put = |w: &[R], layer: &Layer, outputs: usize, to: Range<usize>, stride: usize| {
            transpose((w, layer.inputs), (outputs, layer.inputs), (&mut flipped[to], stride));
        };
        put(&weights[g0.weights()], &g0, g0.outputs, hidden, g0.outputs);
        put(&weights[g1.weights()][g1.inputs..], &g1, self.features, features, self.padded_features());
        let [first, second] = color;
        put(&weights[c0.weights()], &c0, c0.outputs, first, c0.outputs);
        put(&weights[c1.weights()], &c1, c1.outputs, second, c1.outputs);
    }

    /// Where [`flip`](Self::flip) writes what, and the length of it all.
    pub(crate) fn flipped(&self) -> (Flipped, usize) {
        let ([g0, g1], [c0, c1, _]) = (self.geometry, self.color);
        let mut len = 0;
        let mut next = |n: usize| {
            len += n;
            len - n..len
        };
        let hidden = next(g0.inputs * g0.outputs);
        let features = next(g1.inputs * self.padded_features());
        let color = [next(c0.inputs * c0.outputs), next(c1.inputs * c1.outputs)];
        (Flipped { hidden, features, color }, len)
    }

    pub(crate) fn encoding(&self) -> usize {
        self.geometry[0].inputs
    }

    pub(crate) fn hidden(&self) -> usize {
        self.geometry[0].outputs
    }

    /// Uniform weights that keep the variance through ReLUs (He et al. 2015; with the smaller customary bound the
    /// colour's gradient is so faint beside the distance's that the colour never leaves its mean), zero biases, and
    /// +0.1 for the last geometry biases: an untrained point is outside. Codes start at zero.
    pub(crate) fn init<R: Real>(&self, seed: u64) -> Vec<R> {
        let mut weights = vec![R::ZERO; self.len];
        for layer in self.geometry.iter().chain(&self.color) {
            let bound = (6.0 / layer.inputs as f64).sqrt();
            for i in layer.weights() {
                let h = mix(seed ^ mix(0x6d6c_7000 ^ i as u64));
                weights[i] = R::of(((h >> 40) as f64 / (1u64 << 23) as f64 - 1.0) * bound);
            }
        }
        weights[self.geometry[1].bias()].fill(R::of(0.1));
        weights
    }
}
