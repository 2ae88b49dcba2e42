//! The graph cut: boundary costs and the exact minimum of the energy.

use crate::grid::{Grid, depth_noise};
use crate::math::exp_negative;
use crate::maxflow::{Graph, OFFSETS};

/// Integer units of a log-odd of 1.
const SCALE: f32 = 64.0;

/// Costs of a boundary between neighbouring cells.
pub(crate) struct Edges {
    /// By direction, for those of [`OFFSETS`] that point ahead (4 to 7); 0 out of the grid.
    ahead: [Vec<i32>; 4],
    /// Of every cell with all its neighbours together.
    incident: Vec<i32>,
    steps: [isize; 8],
}

impl Edges {
    pub(crate) fn new(grid: &Grid, smoothness: f32) -> Self {
        let (w, h) = (grid.window.w, grid.window.h);
        let contrast = mean_contrast(grid);
        let mut ahead: [Vec<i32>; 4] = std::array::from_fn(|_| vec![0; w * h]);
        let mut incident = vec![0i32; w * h];
        for (costs, (dx, dy)) in ahead.iter_mut().zip(OFFSETS.into_iter().skip(4)) {
            let length = if dx * dy == 0 { 1.0 } else { std::f32::consts::FRAC_1_SQRT_2 };
            let (left, right) = (usize::from(dx < 0), usize::from(dx > 0));
            let cells = w - left - right;
            for y in 0..h - dy as usize {
                let from = y * w + left;
                let to = (from as i32 + dy * w as i32 + dx) as usize;
                row(grid, (from, to), contrast, smoothness * length * SCALE, &mut costs[from..from + cells]);
                add(&mut incident[from..from + cells], &costs[from..from + cells]);
                add(&mut incident[to..to + cells], &costs[from..from + cells]);
            }
        }
        Self { ahead, incident, steps: OFFSETS.map(|(dx, dy)| dy as isize * w as isize + dx as isize) }
    }

    /// Cost of the boundary between cell `i` and its neighbour in direction `d`, with that neighbour; `None` where
    /// there is none or it costs nothing.
    #[inline]
    fn neighbour(&self, i: usize, d: usize) -> Option<(usize, i32)> {
        let j = i.checked_add_signed(self.steps[d])?;
        let cost = if d >= 4 { self.ahead[d - 4].get(i) } else { self.ahead[3 - d].get(j) };
        cost.copied().filter(|&cost| cost > 0).map(|cost| (j, cost))
    }
}

fn add(to: &mut [i32], from: &[i32]) {
    to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
}

/// Costs between the cells from `from` on and those from `to` on: low across colour edges (Boykov and Jolly 2001) and
/// depth steps.
fn row(grid: &Grid, (from, to): (usize, usize), contrast: f32, factor: f32, costs: &mut [i32]) {
    let n = costs.len();
    let [a0, a1, a2] = grid.color_rows(from..from + n);
    let [b0, b1, b2] = grid.color_rows(to..to + n);
    let (za, zb) = (&grid.depth[from..from + n], &grid.depth[to..to + n]);
    if [a0, a1, a2, b0, b1, b2].iter().any(|row| row.len() != n) {
        return;
    }
    let sharpness = -1.0 / contrast;
    for k in 0..n {
        let d = [a0[k] - b0[k], a1[k] - b1[k], a2[k] - b2[k]];
        let d2 = 0.4 * d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
        let color = 0.06 + 0.94 * exp_negative(d2 * sharpness);
        let (a, b) = (za[k], zb[k]);
        let least = if a < b { a } else { b };
        let scale = 0.006 + 2.0 * depth_noise(least);
        let (r2, s2) = ((a - b) * (a - b), scale * scale);
        let level = s2 * s2 / (s2 * s2 + r2 * r2);
        let depth = if least > 0.0 { level } else { 0.7 };
        costs[k] = (factor * color * depth) as i32;
    }
}

fn mean_contrast(grid: &Grid) -> f32 {
    const LANES: usize = 8;
    let (w, h) = (grid.window.w, grid.window.h);
    let mut sums = [0.0f32; LANES];
    for y in 0..h {
        let rows = grid.color_rows(y * w..(y + 1) * w);
        for (row, weight) in rows.into_iter().zip([0.4, 1.0, 1.0]) {
            for (a, b) in row.chunks(LANES).zip(row.get(1..).unwrap_or(&[]).chunks(LANES)) {
                for (sum, (a, b)) in sums.iter_mut().zip(a.iter().zip(b)) {
                    *sum += weight * (a - b) * (a - b);
                }
            }
        }
    }
    let count = (w.saturating_sub(1) * h).max(1) as f32;
    (2.0 * sums.iter().sum::<f32>() / count).clamp(40.0, 1500.0)
}

/// Minimises the energy exactly; `true` = object.
///
/// A cell whose own preference outweighs all its edges together keeps it in every minimum. Such a cell leaves the
/// graph and its edges become preferences of its neighbours, which may settle them in turn; the maximum flow only
/// decides the few cells that remain.
pub(crate) fn cut(edges: &Edges, unaries: &[f32]) -> Vec<bool> {
    const OPEN: u8 = 0;
    const AT_FIRST: u8 = 1;
    const LATER: u8 = 2;
    let n = unaries.len();
    let mut unary: Vec<i32> = unaries.iter().map(|u| (u.clamp(-30.0, 30.0) * SCALE) as i32).collect();
    let mut state: Vec<u8> =
        unary.iter().zip(&edges.incident).map(|(u, sum)| u8::from(u.abs() > *sum)).collect();
    let open: Vec<u32> = (0..n as u32).filter(|&i| state[i as usize] == OPEN).collect();
    let mut incident = edges.incident.clone();
    let mut queue: Vec<usize> = Vec::new();
    for &i in &open {
        let i = i as usize;
        for (j, cost) in (0..8).filter_map(|d| edges.neighbour(i, d)).filter(|&(j, _)| state[j] == AT_FIRST) {
            unary[i] += cost * unary[j].signum();
            incident[i] -= cost;
        }
        if unary[i].abs() > incident[i] {
            state[i] = LATER;
            queue.push(i);
        }
    }
    while let Some(i) = queue.pop() {
        let label = unary[i].signum();
        for (j, cost) in (0..8).filter_map(|d| edges.neighbour(i, d)) {
            if state[j] != OPEN {
                continue;
            }
            unary[j] += cost * label;
            incident[j] -= cost;
            if unary[j].abs() > incident[j] {
                state[j] = LATER;
                queue.push(j);
            }
        }
    }
    let mut labels: Vec<bool> = unary.iter().map(|u| *u > 0).collect();
    let open: Vec<u32> = open.into_iter().filter(|&i| state[i as usize] == OPEN).collect();
    let mut node = vec![0u32; n];
    open.iter().zip(0..).for_each(|(&i, k)| node[i as usize] = k);
    let mut graph = Graph::new(open.len());
    for (k, &i) in open.iter().enumerate() {
        let i = i as usize;
        graph.set_unary(k, unary[i]);
        for d in 4..8 {
            if let Some((j, cost)) = edges.neighbour(i, d).filter(|&(j, _)| state[j] == OPEN) {
                graph.set_edge(k, node[j] as usize, d, cost);
            }
        }
    }
    for (&i, label) in open.iter().zip(graph.solve()) {
        labels[i as usize] = label;
    }
    labels
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::Window;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]
        #[test]
        fn settling_cells_first_keeps_the_minimum(
            unaries in prop::collection::vec(-4.0f32..4.0, 63),
            luma in prop::collection::vec(0.0f32..60.0, 63),
        ) {
            let window = Window { x0: 0, y0: 0, step: 1, w: 9, h: 7 };
            let color: Vec<_> = luma.iter().map(|&y| [y, 0.0, 0.0]).collect();
            let grid = Grid::from_cells(window, &color, vec![0.0; 63]);
            let edges = Edges::new(&grid, 1.5);
            let mut graph = Graph::new(63);
            let mut weights = Vec::new();
            for i in 0..63usize {
                graph.set_unary(i, (unaries[i] * SCALE) as i32);
                for d in 4..8 {
                    let at = ((i % 9) as i32 + OFFSETS[d].0, (i / 9) as i32 + OFFSETS[d].1);
                    let Some(j) = window.index(at) else { continue };
                    let weight = edges.ahead[d - 4][i];
                    prop_assert!(weight > 0);
                    graph.set_edge(i, j, d, weight);
                    weights.push((i, j, weight));
                }
            }
            for i in 0..63 {
                let all: i32 = weights.iter().filter(|(a, b, _)| *a == i || *b == i).map(|e| e.2).sum();
                prop_assert_eq!(all, edges.incident[i]);
            }
            let energy = |labels: &[bool]| {
                let unary: i32 = (0..63)
                    .map(|i| (unaries[i] * SCALE) as i32)
                    .zip(labels)
                    .map(|(u, &l)| if l { -u } else { u })
                    .sum();
                let cut: i32 = weights.iter().filter(|(i, j, _)| labels[*i] != labels[*j]).map(|e| 2 * e.2).sum();
                unary + cut
            };
            prop_assert_eq!(energy(&cut(&edges, &unaries)), energy(&graph.solve()));
        }
    }

    #[test]
    fn a_boundary_costs_less_across_a_step_in_colour_or_depth() {
        let window = Window { x0: 0, y0: 0, step: 1, w: 3, h: 1 };
        let cost = |luma: f32, z: f32| {
            let grid =
                Grid::from_cells(window, &[[50.0; 3], [50.0 + luma; 3], [50.0; 3]], vec![0.5, 0.5 + z, 0.5]);
            Edges::new(&grid, 2.5).ahead[0][0]
        };
        assert!(cost(0.0, 0.0) > 2 * cost(60.0, 0.0) && cost(0.0, 0.0) > 20 * cost(0.0, 0.1));
    }
}
