//! The normal equations over the free nodes and their dense Cholesky solution. Terms only ever add 6x6 blocks.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn, Matrix6, SymmetricEigen, Vector6};

/// `H delta = -g` over the free nodes; only the lower triangle of `H` is kept.
#[derive(Debug)]
pub(crate) struct NormalEquations {
    /// Block index of each node; `None` = eliminated.
    slots: Vec<Option<usize>>,
    free: usize,
    h: DMatrix<f64>,
    g: DVector<f64>,
    /// Buffer that the factorisation consumes and gives back.
    scratch: DMatrix<f64>,
    step: DVector<f64>,
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
        let inverse = self.inverse();
        let block = |node: usize| {
            let a = self.slot(node)?;
            inverse.as_ref().map(|m| m.fixed_view::<6, 6>(6 * a, 6 * a).into_owned())
        };
        (0..self.slots.len()).map(block).collect()
    }

    /// `H^-1`, after scaling to a unit diagonal so that "singular" does not depend on units.
    fn inverse(&self) -> Option<DMatrix<f64>> {
        let n = self.g.len();
        if (0..n).any(|k| self.h[(k, k)] <= 0.0) {
            return None;
        }
        let scale = DVector::from_fn(n, |k, _| 1.0 / self.h[(k, k)].sqrt());
        let scaled = DMatrix::from_fn(n, n, |r, c| self.h[(r, c)] * scale[r] * scale[c]);
        let factor: Cholesky<f64, Dyn> = Cholesky::new(scaled)?;
        let smallest = (0..n).map(|k| factor.l_dirty()[(k, k)]).fold(f64::INFINITY, f64::min);
        if smallest.is_nan() || smallest * smallest < 1e-11 {
            return None;
        }
        let inverse = factor.inverse();
        Some(DMatrix::from_fn(n, n, |r, c| inverse[(r, c)] * scale[r] * scale[c]))
    }

    /// Information on `node` when all other free nodes are marginalised out (Schur complement). Directions in which
    /// the others are loose are regularised with 1e-9 of their diagonal.
    pub(crate) fn marginal_information(&self, node: usize) -> Option<Matrix6<f64>> {
        let a = 6 * self.slot(node)?;
        let n = self.g.len();
        let full = |r: usize, c: usize| if r >= c { self.h[(r, c)] } else { self.h[(c, r)] };
        let own = Matrix6::from_fn(|r, c| full(a + r, a + c));
        let others: Vec<usize> = (0..n).filter(|k| !(a..a + 6).contains(k)).collect();
        if others.is_empty() {
            return Some(own);
        }
        let floor = 1e-9 * self.h.diagonal().amax().max(f64::MIN_POSITIVE);
        let rest = DMatrix::from_fn(others.len(), others.len(), |r, c| {
            let h = full(others[r], others[c]);
            if r == c { h + 1e-9 * h + floor * 1e-3 } else { h }
        });
        let cross = DMatrix::from_fn(others.len(), 6, |r, c| full(others[r], a + c));
        let solved = Cholesky::new(rest)?.solve(&cross);
        let schur = cross.transpose() * solved;
        Some(own - schur.fixed_view::<6, 6>(0, 0))
    }
}

/// Eigenvalues of a symmetric matrix, ascending, rounding noise below zero cut off.
pub(crate) fn ascending_eigenvalues(m: &Matrix6<f64>) -> [f64; 6] {
    let symmetric = (m + m.transpose()) * 0.5;
    let mut values: [f64; 6] = SymmetricEigen::new(symmetric).eigenvalues.into();
    values.sort_by(f64::total_cmp);
    values.map(|v| v.max(0.0))
}
