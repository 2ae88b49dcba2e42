//! Elimination order of the free nodes and the pattern of the block-sparse normal matrix in that order.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::sparse::SymbolicSparseColMatRef;
use faer::sparse::linalg::amd;

use super::graph::{Error, Graph};

/// Upper triangle of a symmetric matrix of 6x6 blocks as compressed columns of blocks. In every column the rows
/// ascend and the last one is the diagonal.
#[derive(Debug)]
pub(super) struct BlockPattern {
    pub(super) starts: Vec<usize>,
    pub(super) rows: Vec<usize>,
}

impl BlockPattern {
    /// The pattern of `pairs` (any order, either triangle, repetitions allowed) plus the diagonal.
    fn new(free: usize, pairs: impl Iterator<Item = (usize, usize)>) -> Self {
        let diagonal = (0..free).map(|k| (k, k));
        let mut entries: Vec<(usize, usize)> =
            pairs.map(|(a, b)| (a.max(b), a.min(b))).chain(diagonal).collect();
        entries.sort_unstable();
        entries.dedup();
        let mut starts = vec![0; free + 1];
        for &(column, _) in &entries {
            starts[column + 1] += 1;
        }
        for column in 0..free {
            starts[column + 1] += starts[column];
        }
        Self { starts, rows: entries.into_iter().map(|(_, row)| row).collect() }
    }

    /// Number of block columns.
    pub(super) fn len(&self) -> usize {
        self.starts.len() - 1
    }

    /// Row indices of a block column.
    pub(super) fn column(&self, column: usize) -> &[usize] {
        &self.rows[self.starts[column]..self.starts[column + 1]]
    }

    /// Column pointers and row indices of the scalar upper triangle.
    pub(super) fn scalars(&self) -> (Vec<usize>, Vec<usize>) {
        let mut pointers = Vec::with_capacity(6 * self.len() + 1);
        let mut rows = Vec::with_capacity(36 * self.rows.len());
        pointers.push(0);
        for column in 0..self.len() {
            for k in 0..6 {
                for &block in self.column(column) {
                    let last = if block == column { k } else { 5 };
                    rows.extend((0..=last).map(|a| 6 * block + a));
                }
                pointers.push(rows.len());
            }
        }
        (pointers, rows)
    }
}

/// Position of each node in the elimination order (`None`: constant), and the pattern in that order.
pub(super) fn order(graph: &Graph, constant: &[bool]) -> Result<(Vec<Option<usize>>, BlockPattern), Error> {
    let mut free = 0;
    let mut count = |&constant: &bool| {
        let slot = free;
        free += usize::from(!constant);
        (!constant).then_some(slot)
    };
    let mut slots: Vec<Option<usize>> = constant.iter().map(&mut count).collect();
    let natural = BlockPattern::new(free, pairs(graph, &slots));
    let position = minimum_degree(&natural)?;
    for slot in &mut slots {
        *slot = slot.map(|k| position[k]);
    }
    let pattern = BlockPattern::new(free, pairs(graph, &slots));
    Ok((slots, pattern))
}

/// Edges between free nodes.
fn pairs<'a>(graph: &'a Graph, slots: &'a [Option<usize>]) -> impl Iterator<Item = (usize, usize)> + 'a {
    graph.edges.iter().filter_map(|e| Some((slots[e.from]?, slots[e.to]?)))
}

/// Position of each block in an approximate minimum degree ordering.
fn minimum_degree(pattern: &BlockPattern) -> Result<Vec<usize>, Error> {
    let n = pattern.len();
    let too_large = || Error::TooLarge { nodes: n };
    let (mut order, mut position) = (vec![0usize; n], vec![0usize; n]);
    let mut memory = MemBuffer::try_new(amd::order_maybe_unsorted_scratch::<usize>(n, pattern.rows.len()))
        .map_err(|_| too_large())?;
    let upper = SymbolicSparseColMatRef::new_checked(n, n, &pattern.starts, None, &pattern.rows);
    let control = amd::Control::default();
    amd::order_maybe_unsorted(&mut order, &mut position, upper, control, MemStack::new(&mut memory))
        .map_err(|_| too_large())?;
    Ok(position)
}
