//! The normal equations over the free nodes and their dense Cholesky solution. Terms only ever add 6x6 blocks.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn, Matrix6, Vector6};

/// `H delta = -g` over the free nodes; only the lower triangle of `H` is kept.
#[derive(Debug)]
pub(crate) struct NormalEquations {
    /// Block index of each node; `None` = eliminated.
    slots: Vec<Option<usize>>,
    free: usize,
    h: DMatrix<f64>,
    g: DVector<f64>,
    /// Information that noise in normals gives each free node, see [`PairBlocks::noise`].
    noise: Vec<f64>,
    /// Information that each free node's matches only claim, see [`PairBlocks::doubt`].
    doubt: Vec<Matrix6<f64>>,
    /// Buffer that the factorisation consumes and gives back.
    scratch: DMatrix<f64>,
    step: DVector<f64>,
}

/// What an edge that sees its two nodes only relative to each other adds: their blocks are `h`, `h` and `-h`, the
/// gradients `g` (first) and `-g` (second).
#[derive(Debug, Clone, Copy)]
pub(crate) struct PairBlocks {
    pub(crate) nodes: (usize, usize),
    pub(crate) h: Matrix6<f64>,
    pub(crate) g: Vector6<f64>,
    pub(crate) cost: f64,
    /// What noise in the normals alone gives to any motion, 1/m^2 by the way of a typical point.
    pub(crate) noise: f64,
    /// Share of `h` that doesn't tell whether a motion is seen at all.
    pub(crate) doubt: f64,
}

/// What the equations tell of one node, the others given.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Own {
    pub(crate) information: Matrix6<f64>,
    /// The part of it that doesn't tell whether a motion is seen at all.
    pub(crate) doubt: Matrix6<f64>,
    /// What noise in normals has part in it.
    pub(crate) noise: f64,
}

impl NormalEquations {
    /// One 6-vector unknown for each node that is not in `eliminated`.
    pub(crate) fn new(eliminated: &[bool]) -> Self {
        let mut free = 0;
        let slots = eliminated
            .iter()
            .map(|&constant| {
                (!constant).then(|| {
                    free += 1;
                    free - 1
                })
            })
            .collect();
        let n = 6 * free;
        Self {
            slots,
            free,
            h: DMatrix::zeros(n, n),
            g: DVector::zeros(n),
            noise: vec![0.0; free],
            doubt: vec![Matrix6::zeros(); free],
            scratch: DMatrix::zeros(n, n),
            step: DVector::zeros(n),
        }
    }

    pub(crate) fn free(&self) -> usize {
        self.free
    }

    pub(crate) fn is_free(&self, node: usize) -> bool {
        self.slot(node).is_some()
    }

    fn slot(&self, node: usize) -> Option<usize> {
        self.slots.get(node).copied().flatten()
    }

    pub(crate) fn clear(&mut self) {
        self.h.fill(0.0);
        self.g.fill(0.0);
        self.noise.fill(0.0);
        self.doubt.fill(Matrix6::zeros());
    }

    /// Adds a node's own block and gradient; ignored for eliminated nodes.
    pub(crate) fn add(&mut self, node: usize, h: &Matrix6<f64>, g: &Vector6<f64>) {
        if let Some(a) = self.slot(node) {
            let mut block = self.h.fixed_view_mut::<6, 6>(6 * a, 6 * a);
            block += h;
            let mut gradient = self.g.fixed_rows_mut::<6>(6 * a);
            gradient += g;
        }
    }

    /// Adds the block `J_i^T W J_j`; ignored unless both nodes are free.
    pub(crate) fn add_cross(&mut self, i: usize, j: usize, h: &Matrix6<f64>) {
        let (Some(a), Some(b)) = (self.slot(i), self.slot(j)) else { return };
        if a > b {
            let mut block = self.h.fixed_view_mut::<6, 6>(6 * a, 6 * b);
            block += h;
        } else {
            let mut block = self.h.fixed_view_mut::<6, 6>(6 * b, 6 * a);
            block += h.transpose();
        }
    }

    /// Adds an edge's blocks and gradients and returns its cost.
    pub(crate) fn add_pair(&mut self, pair: &PairBlocks) -> f64 {
        let PairBlocks { nodes: (a, b), h, g, .. } = pair;
        self.add(*a, h, g);
        self.add(*b, h, &-g);
        self.add_cross(*a, *b, &-h);
        for node in [*a, *b] {
            self.add_noise(node, pair.noise);
            if let Some(slot) = self.slot(node)
                && pair.doubt > 0.0
            {
                self.doubt[slot] += h * pair.doubt;
            }
        }
        pair.cost
    }

    /// Adds to what noise in normals gives a node.
    pub(crate) fn add_noise(&mut self, node: usize, noise: f64) {
        if let Some(a) = self.slot(node) {
            self.noise[a] += noise;
        }
    }

    /// A node's own block; `None` for eliminated nodes.
    pub(crate) fn own(&self, node: usize) -> Option<Own> {
        let a = self.slot(node)?;
        let information = self.h.fixed_view::<6, 6>(6 * a, 6 * a).into_owned();
        // Terms add to all of it.
        Some(Own { information, doubt: self.doubt[a], noise: self.noise[a] })
    }

    pub(crate) fn gradient_is_zero(&self) -> bool {
        self.g.iter().all(|&g| g == 0.0)
    }

    pub(crate) fn is_finite(&self) -> bool {
        self.g.iter().all(|g| g.is_finite()) && self.h.iter().all(|h| h.is_finite())
    }

    /// Solves `(H + damping D) delta = -g`; false if the damped matrix is not positive definite.
    ///
    /// `D` is the diagonal of `H` with a floor, see [`Self::floors`]. Directions that no residual sees have zero
    /// gradient up to noise and stay where they are.
    pub(crate) fn solve(&mut self, damping: f64) -> bool {
        let n = self.g.len();
        let floor = self.floors();
        let mut a = std::mem::replace(&mut self.scratch, DMatrix::zeros(0, 0));
        if a.shape() != self.h.shape() {
            a = self.h.clone();
        } else {
            a.copy_from(&self.h);
        }
        for k in 0..n {
            a[(k, k)] += damping * self.h[(k, k)].max(floor[usize::from(k % 6 >= 3)]);
        }
        let Some(factor) = Cholesky::new(a) else { return false };
        self.step.copy_from(&self.g);
        self.step.neg_mut();
        factor.solve_mut(&mut self.step);
        self.scratch = factor.unpack_dirty();
        self.step.iter().all(|x| x.is_finite())
    }

    /// Least entries of `D` for translations and rotations: a thousandth of the largest entry of the kind, and for
    /// rotations at least what the translational information has at a lever of 3 cm.
    fn floors(&self) -> [f64; 2] {
        let mut largest = [0.0f64; 2];
        for (k, &h) in self.h.diagonal().iter().enumerate() {
            let kind = usize::from(k % 6 >= 3);
            largest[kind] = largest[kind].max(h);
        }
        let translation = 1e-3 * largest[0];
        let rotation = (1e-3 * largest[1]).max(1e-3 * largest[0]);
        [translation, rotation].map(|f| if f > 0.0 { f } else { 1.0 })
    }

    /// The last solution's twist of `node`; `None` for eliminated nodes.
    pub(crate) fn step(&self, node: usize) -> Option<Vector6<f64>> {
        self.slot(node).map(|a| self.step.fixed_rows::<6>(6 * a).into_owned())
    }

    /// Marginal covariance of every node; `None` for eliminated nodes and where `H` is singular.
    pub(crate) fn covariances(&self) -> Vec<Option<Matrix6<f64>>> {
        let inverse = self.inverse_factor();
        let block = |node: usize| {
            let a = 6 * self.slot(node)?;
            let columns = inverse.as_ref()?.view_range(a.., a..a + 6);
            Some(Matrix6::from_fn(|r, c| columns.column(r).dot(&columns.column(c))))
        };
        (0..self.slots.len()).map(block).collect()
    }

    /// `L^-1` with `H^-1 = L^-T L^-1`. Decided after scaling to a unit diagonal, so that "singular" does not depend on
    /// units.
    fn inverse_factor(&self) -> Option<DMatrix<f64>> {
        let n = self.g.len();
        if (0..n).any(|k| self.h[(k, k)] <= 0.0) {
            return None;
        }
        let scale = DVector::from_fn(n, |k, _| 1.0 / self.h[(k, k)].sqrt());
        let scaled = DMatrix::from_fn(n, n, |r, c| self.h[(r, c)] * scale[r] * scale[c]);
        let factor: Cholesky<f64, Dyn> = Cholesky::new(scaled)?;
        let l = factor.l_dirty();
        let smallest = (0..n).map(|k| l[(k, k)]).fold(f64::INFINITY, f64::min);
        if smallest.is_nan() || smallest * smallest < 1e-11 {
            return None;
        }
        let mut inverse = DMatrix::zeros(n, n);
        for c in 0..n {
            inverse[(c, c)] = 1.0;
            // Rows above the diagonal stay zero.
            let mut column = inverse.view_range_mut(c.., c);
            l.view_range(c.., c..).solve_lower_triangular_mut(&mut column);
        }
        (0..n).for_each(|c| inverse.column_mut(c).scale_mut(scale[c]));
        Some(inverse)
    }
}
