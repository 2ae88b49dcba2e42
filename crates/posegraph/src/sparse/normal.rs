//! The normal equations in compressed columns and their sparse Cholesky solution.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt::factor::LltRegularization;
use faer::sparse::linalg::SupernodalThreshold;
use faer::sparse::linalg::cholesky::{
    CholeskySymbolicParams, SymbolicCholesky, SymmetricOrdering, factorize_symbolic_cholesky,
};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMatRef};
use faer::{Conj, MatMut, Par, Side, Spec};
use nalgebra::{Matrix6, Vector6};

use super::edge::Linearisation;
use super::graph::{Error, Graph};
use super::ordering::{BlockPattern, order};

/// Where a 6x6 block lies in the values: column `k` starts at `start + k stride + k (k + 1) / 2`.
#[derive(Debug, Clone, Copy)]
struct Place {
    start: usize,
    stride: usize,
}

impl Place {
    #[inline(always)]
    fn column(self, k: usize) -> usize {
        self.start + k * self.stride + k * (k + 1) / 2
    }
}

/// The off-diagonal block of an edge.
#[derive(Debug, Clone, Copy)]
struct Cross {
    place: Place,
    /// Whether `from` is eliminated after `to`, so that the block's transpose is stored.
    transposed: bool,
}

/// `H delta = -g` over the free nodes, in elimination order; only the upper triangle of `H` is kept.
pub(super) struct SparseNormal {
    slots: Vec<Option<usize>>,
    crosses: Vec<Option<Cross>>,
    /// Diagonal block of each column.
    own: Vec<Place>,
    pointers: Vec<usize>,
    rows: Vec<usize>,
    values: Vec<f64>,
    /// Undamped diagonal.
    diagonal: Vec<f64>,
    gradient: Vec<f64>,
    step: Vec<f64>,
    symbolic: SymbolicCholesky<usize>,
    factor: Vec<f64>,
    memory: MemBuffer,
}

impl SparseNormal {
    /// Orders the graph and factorises its pattern; all buffers of the solve are allocated here.
    pub(super) fn new(graph: &Graph, constant: &[bool]) -> Result<Self, Error> {
        let (slots, pattern) = order(graph, constant)?;
        let (pointers, rows) = pattern.scalars();
        let n = pointers.len() - 1;
        let too_large = || Error::TooLarge { nodes: n / 6 };
        // 6x6 blocks always make supernodes, whatever the fill.
        let params = CholeskySymbolicParams {
            supernodal_flop_ratio_threshold: SupernodalThreshold::FORCE_SUPERNODAL,
            ..Default::default()
        };
        let upper = SymbolicSparseColMatRef::new_checked(n, n, &pointers, None, &rows);
        let symbolic = factorize_symbolic_cholesky(upper, Side::Upper, SymmetricOrdering::Identity, params)
            .map_err(|_| too_large())?;
        let scratch =
            symbolic
                .factorize_numeric_llt_scratch::<f64>(Par::Seq, Spec::default())
                .or(symbolic.solve_in_place_scratch::<f64>(1, Par::Seq));
        let memory = MemBuffer::try_new(scratch).map_err(|_| too_large())?;
        let crosses = graph.edges.iter().map(|e| {
            let (from, to) = (slots[e.from]?, slots[e.to]?);
            let place = place(&pattern, &pointers, from.min(to), from.max(to))?;
            Some(Cross { place, transposed: from > to })
        });
        let crosses = crosses.collect();
        let own = (0..pattern.len()).filter_map(|k| place(&pattern, &pointers, k, k)).collect();
        Ok(Self {
            crosses,
            slots,
            own,
            values: vec![0.0; rows.len()],
            pointers,
            rows,
            diagonal: vec![0.0; n],
            gradient: vec![0.0; n],
            step: vec![0.0; n],
            factor: vec![0.0; symbolic.len_val()],
            symbolic,
            memory,
        })
    }

    /// Whether there is nothing to solve for.
    pub(super) fn is_empty(&self) -> bool {
        self.gradient.is_empty()
    }

    pub(super) fn clear(&mut self) {
        self.values.fill(0.0);
        self.gradient.fill(0.0);
    }

    /// Adds the blocks of edge number `edge`, all multiplied by the loss weight `w`.
    pub(super) fn add(&mut self, edge: usize, (from, to): (usize, usize), l: &Linearisation, w: f64) {
        for (node, h, g) in [(from, &l.h_from, &l.g_from), (to, &l.h_to, &l.g_to)] {
            let Some(slot) = self.slots[node] else { continue };
            for k in 0..6 {
                let column = self.own[slot].column(k);
                for (value, &h) in self.values[column..=column + k].iter_mut().zip(h.column(k)) {
                    *value += w * h;
                }
                self.gradient[6 * slot + k] += w * g[k];
            }
        }
        if let Some(cross) = self.crosses[edge] {
            if cross.transposed {
                self.add_cross(cross.place, &l.h_cross.transpose(), w);
            } else {
                self.add_cross(cross.place, &l.h_cross, w);
            }
        }
    }

    fn add_cross(&mut self, place: Place, h: &Matrix6<f64>, w: f64) {
        for k in 0..6 {
            let column = place.column(k);
            for (value, &h) in self.values[column..column + 6].iter_mut().zip(h.column(k)) {
                *value += w * h;
            }
        }
    }

    /// To be called when all edges are added: remembers the diagonal. False if a number is not finite.
    pub(super) fn finish(&mut self) -> bool {
        for (d, end) in self.diagonal.iter_mut().zip(&self.pointers[1..]) {
            // Rows ascend, so the last entry of a column of the upper triangle is the diagonal.
            *d = self.values[end - 1];
        }
        self.gradient.iter().chain(&self.diagonal).all(|x| x.is_finite())
    }

    pub(super) fn gradient_is_zero(&self) -> bool {
        self.gradient.iter().all(|&g| g == 0.0)
    }

    /// Solves `(H + damping D) delta = -g` with `D` the diagonal of `H`, where it vanishes its largest entry. Returns
    /// the decrease of the cost that the quadratic model predicts; `None` if the damped matrix is not positive definite.
    pub(super) fn solve(&mut self, damping: f64) -> Option<f64> {
        let largest = self.diagonal.iter().fold(0.0f64, |a, &b| a.max(b));
        let floor = if largest > 0.0 { 1e-9 * largest } else { 1.0 };
        let damp = |d: f64| damping * d.max(floor);
        for (&d, end) in self.diagonal.iter().zip(&self.pointers[1..]) {
            self.values[end - 1] = d + damp(d);
        }
        let n = self.step.len();
        let pattern = SymbolicSparseColMatRef::new_checked(n, n, &self.pointers, None, &self.rows);
        let stack = MemStack::new(&mut self.memory);
        let factor = self
            .symbolic
            .factorize_numeric_llt(
                &mut self.factor,
                SparseColMatRef::new(pattern, &self.values),
                Side::Upper,
                LltRegularization::default(),
                Par::Seq,
                stack,
                Spec::default(),
            )
            .ok()?;
        for (step, g) in self.step.iter_mut().zip(&self.gradient) {
            *step = -g;
        }
        let rhs = MatMut::from_column_major_slice_mut(&mut self.step, n, 1);
        factor.solve_in_place_with_conj(Conj::No, rhs, Par::Seq, stack);
        // -(g.s + s.H s / 2) with H s = -g - damping D s.
        let predicted: f64 = (self.step.iter().zip(&self.gradient).zip(&self.diagonal))
            .map(|((s, g), &d)| 0.5 * s * (damp(d) * s - g))
            .sum();
        predicted.is_finite().then_some(predicted)
    }

    /// The last solution's twist of `node`; `None` for constants.
    pub(super) fn step(&self, node: usize) -> Option<Vector6<f64>> {
        self.slots[node].map(|slot| Vector6::from_column_slice(&self.step[6 * slot..6 * slot + 6]))
    }
}

/// Place of the block (`row`, `column`), `row <= column`.
fn place(pattern: &BlockPattern, pointers: &[usize], row: usize, column: usize) -> Option<Place> {
    let blocks = pattern.column(column);
    let index = blocks.binary_search(&row).ok()?;
    Some(Place { start: pointers[6 * column] + 6 * index, stride: 6 * (blocks.len() - 1) })
}

#[cfg(test)]
mod tests {
    use nalgebra::{Cholesky, DMatrix, DVector, Isometry3};
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;
    use se3_lie::se3;

    use super::*;
    use crate::sparse::edge::linearise;
    use crate::sparse::graph::RelativePose;

    /// Random graph of 12 nodes with repeated and reversed edges.
    fn graph() -> Graph {
        let mut rng = Pcg64Mcg::seed_from_u64(3);
        let mut pose = |s: f64| se3::exp(&Vector6::from_fn(|_, _| rng.random_range(-s..s)));
        let poses: Vec<Isometry3<f64>> = (0..12).map(|_| pose(1.0)).collect();
        let joins = (0..11).map(|k| (k, k + 1)).chain([(7, 2), (2, 7), (0, 9), (11, 0), (5, 3), (3, 8)]);
        let edges = joins.map(|(a, b)| {
            let measured = poses[a].inverse() * poses[b] * pose(0.2);
            RelativePose::new(a, b, measured, Matrix6::from_diagonal_element(3.0))
        });
        Graph { edges: edges.collect(), poses: poses.clone(), fixed: [4].into() }
    }

    #[test]
    fn step_is_that_of_the_dense_system() {
        let graph = graph();
        let constant = graph.constants();
        let mut normal = SparseNormal::new(&graph, &constant).unwrap();
        normal.clear();
        let (mut h, mut g) = (DMatrix::zeros(72, 72), DVector::zeros(72));
        for (k, e) in graph.edges.iter().enumerate() {
            let l = linearise(e, &graph.poses[e.from], &graph.poses[e.to]);
            normal.add(k, (e.from, e.to), &l, 0.5);
            let (a, b) = (6 * e.from, 6 * e.to);
            for r in 0..6 {
                for c in 0..6 {
                    h[(a + r, a + c)] += 0.5 * l.h_from[(r, c)];
                    h[(b + r, b + c)] += 0.5 * l.h_to[(r, c)];
                    h[(a + r, b + c)] += 0.5 * l.h_cross[(r, c)];
                    h[(b + c, a + r)] += 0.5 * l.h_cross[(r, c)];
                }
                g[a + r] += 0.5 * l.g_from[r];
                g[b + r] += 0.5 * l.g_to[r];
            }
        }
        assert!(normal.finish());
        let predicted = normal.solve(0.1).unwrap();
        for k in 0..72 {
            if k / 6 == 4 {
                h.row_mut(k).fill(0.0);
                h.column_mut(k).fill(0.0);
                g[k] = 0.0;
                h[(k, k)] = 1.0;
            }
        }
        let mut damped = h.clone();
        (0..72).for_each(|k| damped[(k, k)] *= 1.1);
        let step = -Cholesky::new(damped).unwrap().solve(&g);
        for node in 0..12 {
            match normal.step(node) {
                None => assert_eq!(node, 4),
                Some(got) => assert!((got - step.fixed_rows::<6>(6 * node)).amax() < 1e-10),
            }
        }
        let expected = -(g.dot(&step) + 0.5 * step.dot(&(h * &step)));
        assert!((predicted - expected).abs() < 1e-9 * expected);
    }
}
