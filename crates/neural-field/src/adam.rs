//! Adam (Kingma and Ba, 2015), dense for the small networks, per touched group of vertices for the grid.

use crate::clock::{Clock, Stage};
use crate::grid::{FEATURES, GROUP};
use crate::real::{Isa, Kernel};
use crate::scatter::Vertices;
use crate::simd::Set;
use std::ops::Range;

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
pub(crate) struct Update<'a> {
    pub(crate) rate: Rate,
    pub(crate) value: &'a mut [f32],
    pub(crate) grad: &'a mut [f32],
    /// Means of the gradient and of its square.
    pub(crate) mean: &'a mut [f32],
    pub(crate) square: &'a mut [f32],
}

impl Kernel for Update<'_> {
    #[inline(always)]
    fn run<I: Isa>(self) {
        let Self { rate, value, grad, mean, square } = self;
        for ((x, g), (m, v)) in value.iter_mut().zip(grad).zip(mean.iter_mut().zip(square)) {
            *m = BETA1 * *m + (1.0 - BETA1) * *g;
            *v = BETA2 * *v + (1.0 - BETA2) * *g * *g;
            *x -= rate.step * *m / ((*v * rate.root).sqrt() + EPSILON);
            *g = 0.0;
        }
    }
}

/// Gradient, moments and touched groups of some vertices of a lattice.
#[derive(Clone, Debug)]
pub(crate) struct PartState {
    /// The lattice.
    pub(crate) level: usize,
    /// The first of the vertices; a multiple of [`GROUP`].
    pub(crate) first: usize,
    pub(crate) grad: Vec<f32>,
    mean: Vec<f32>,
    square: Vec<f32>,
    /// 1 for every group of vertices that got a gradient in this step.
    touched: Vec<u8>,
    pub(crate) clock: Clock,
}

impl PartState {
    pub(crate) fn new(level: usize, vertices: Range<usize>) -> Self {
        let zeros = || vec![0.0; vertices.len() * FEATURES];
        Self {
            level,
            first: vertices.start,
            grad: zeros(),
            mean: zeros(),
            square: zeros(),
            touched: vec![0; vertices.len().div_ceil(GROUP)],
            clock: Clock::default(),
        }
    }

    /// What gradients are added to.
    pub(crate) fn vertices(&mut self) -> Vertices<'_, f32> {
        Vertices { first: self.first, grad: &mut self.grad, touched: &mut self.touched }
    }

    /// Updates the touched groups only: the rest of the lattice neither moves nor costs anything. `table` has the
    /// features of these vertices.
    pub(crate) fn step(&mut self, set: Set, rate: Rate, table: &mut [f32]) {
        const N: usize = GROUP * FEATURES;
        self.clock.lap(Stage::Scatter);
        let groups = self.touched.len();
        let mut next = 0;
        while let Some(skip) = self.touched[next..].iter().position(|t| *t != 0) {
            // Neighbouring groups are updated in one call.
            let from = next + skip;
            let to = self.touched[from..].iter().position(|t| *t == 0).map_or(groups, |run| from + run);
            self.touched[from..to].fill(0);
            let (a, b) = (from * N, (to * N).min(table.len()));
            set.call(Update {
                rate,
                value: &mut table[a..b],
                grad: &mut self.grad[a..b],
                mean: &mut self.mean[a..b],
                square: &mut self.square[a..b],
            });
            next = to;
        }
        self.clock.lap(Stage::Adam);
    }
}
