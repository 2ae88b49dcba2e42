//! Adam (Kingma and Ba, 2015), dense for the small networks, per touched group of vertices for the grid.

use crate::clock::{Clock, Stage};
use crate::grid::{FEATURES, GROUP};
use crate::simd;

const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
const EPSILON: f32 = 1e-15;

/// Bias-corrected step sizes of one iteration.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rate {
    pub(crate) step: f32,
    pub(crate) root: f32,
}

impl Rate {
    /// `iteration` counts from 1.
    pub(crate) fn new(learning_rate: f64, iteration: usize) -> Self {
        let t = iteration as f64;
        Self {
            step: (learning_rate / (1.0 - f64::from(BETA1).powf(t))) as f32,
            root: (1.0 / (1.0 - f64::from(BETA2).powf(t))) as f32,
        }
    }
}

/// One update of every value; clears the gradient.
#[inline(always)]
pub(crate) fn update(rate: Rate, value: &mut [f32], grad: &mut [f32], moments: &mut [[f32; 2]]) {
    for ((x, g), m) in value.iter_mut().zip(grad).zip(moments) {
        m[0] = BETA1 * m[0] + (1.0 - BETA1) * *g;
        m[1] = BETA2 * m[1] + (1.0 - BETA2) * *g * *g;
        *x -= rate.step * m[0] / ((m[1] * rate.root).sqrt() + EPSILON);
        *g = 0.0;
    }
}

/// Gradient, moments and touched vertices of one lattice.
#[derive(Clone, Debug)]
pub(crate) struct LevelState {
    pub(crate) grad: Vec<f32>,
    moments: Vec<[f32; 2]>,
    /// One bit per group of vertices that got a gradient in this step.
    pub(crate) touched: Vec<u64>,
    pub(crate) clock: Clock,
}

impl LevelState {
    pub(crate) fn new(vertices: usize) -> Self {
        Self {
            grad: vec![0.0; vertices * FEATURES],
            moments: vec![[0.0; 2]; vertices * FEATURES],
            touched: vec![0; vertices.div_ceil(GROUP).div_ceil(64)],
            clock: Clock::default(),
        }
    }

    /// Updates the touched groups only: the rest of the lattice neither moves nor costs anything.
    pub(crate) fn step(&mut self, rate: Rate, table: &mut [f32]) {
        const N: usize = GROUP * FEATURES;
        self.clock.lap(Stage::Scatter);
        for (i, word) in self.touched.iter_mut().enumerate() {
            let mut bits = std::mem::take(word);
            while bits != 0 {
                // Neighbouring groups are updated in one call.
                let skip = bits.trailing_zeros();
                let run = (!(bits >> skip)).trailing_zeros();
                let from = (64 * i + skip as usize) * N;
                let to = (from + run as usize * N).min(table.len());
                simd::adam(rate, &mut table[from..to], &mut self.grad[from..to], &mut self.moments[from..to]);
                bits = if skip + run >= 64 { 0 } else { bits >> (skip + run) << (skip + run) };
            }
        }
        self.clock.lap(Stage::Adam);
    }
}
