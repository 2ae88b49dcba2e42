//! Minimum cut on part of an 8-connected grid: the augmenting-path algorithm with two search trees of Boykov and
//! Kolmogorov, "An experimental comparison of min-cut/max-flow algorithms for energy minimization in vision"
//! (PAMI 2004), with the timestamp and distance marks of Kolmogorov's thesis.

use std::collections::VecDeque;

/// Offsets of the eight neighbours; the reverse of direction `d` is `7 - d`.
pub(crate) const OFFSETS: [(i32, i32); 8] =
    [(-1, -1), (0, -1), (1, -1), (-1, 0), (1, 0), (-1, 1), (0, 1), (1, 1)];

const TERMINAL: u8 = 8;
const ORPHAN: u8 = 9;
const FREE: u8 = 10;

/// A graph whose nodes have at most eight neighbours, one in each direction. A node that isn't there is the one after
/// the last, over whose edges nothing flows.
pub(crate) struct Graph {
    neighbours: Vec<[u32; 8]>,
    capacity: Vec<[i32; 8]>,
    /// Residual to a terminal: positive from the source, negative to the sink.
    terminal: Vec<i32>,
    parent: Vec<u8>,
    sink_side: Vec<bool>,
    stamp: Vec<u32>,
    depth: Vec<u32>,
    queued: Vec<bool>,
    active: VecDeque<u32>,
    orphans: VecDeque<u32>,
    time: u32,
}

impl Graph {
    pub(crate) fn new(nodes: usize) -> Self {
        let n = nodes + 1;
        Self {
            neighbours: vec![[nodes as u32; 8]; n],
            capacity: vec![[0; 8]; n],
            terminal: vec![0; n],
            parent: vec![FREE; n],
            sink_side: vec![false; n],
            stamp: vec![0; n],
            depth: vec![0; n],
            queued: vec![false; n],
            active: VecDeque::new(),
            orphans: VecDeque::new(),
            time: 0,
        }
    }

    #[inline]
    fn neighbour(&self, i: usize, d: usize) -> usize {
        self.neighbours[i][d] as usize
    }

    /// Preference of node `i`: positive for the object (source), negative for the background (sink).
    pub(crate) fn set_unary(&mut self, i: usize, value: i32) {
        self.terminal[i] = value;
    }

    /// Cost `weight >= 0` of giving node `i` and its neighbour `j` in direction `d` different labels.
    pub(crate) fn set_edge(&mut self, i: usize, j: usize, d: usize, weight: i32) {
        self.neighbours[i][d] = j as u32;
        self.neighbours[j][7 - d] = i as u32;
        self.capacity[i][d] = weight.max(0);
        self.capacity[j][7 - d] = weight.max(0);
    }

    /// The labels of the minimum cut: `true` = object.
    pub(crate) fn solve(mut self) -> Vec<bool> {
        for i in 0..self.terminal.len() {
            if self.terminal[i] != 0 {
                self.parent[i] = TERMINAL;
                self.sink_side[i] = self.terminal[i] < 0;
                self.depth[i] = 1;
                self.activate(i);
            }
        }
        let mut current: Option<usize> = None;
        loop {
            let i = match current.take() {
                Some(i) => i,
                None => match self.active.pop_front() {
                    Some(i) => {
                        self.queued[i as usize] = false;
                        i as usize
                    }
                    None => break,
                },
            };
            if self.parent[i] == FREE {
                continue;
            }
            let bridge = self.grow(i);
            self.time += 1;
            if let Some((from, d)) = bridge {
                current = Some(i);
                self.augment(from, d);
                while let Some(orphan) = self.orphans.pop_front() {
                    self.adopt(orphan as usize);
                }
            }
        }
        let nodes = self.terminal.len() - 1;
        (0..nodes).map(|i| self.parent[i] != FREE && !self.sink_side[i]).collect()
    }

    fn activate(&mut self, i: usize) {
        if !self.queued[i] {
            self.queued[i] = true;
            self.active.push_back(i as u32);
        }
    }

    /// Residual of the edge over which flow enters `i` from (source tree) or leaves `i` to (sink tree) its
    /// neighbour in direction `d`.
    #[inline]
    fn residual_towards_tree(&self, i: usize, d: usize, sink: bool) -> i32 {
        if sink { self.capacity[i][d] } else { self.capacity[self.neighbour(i, d)][7 - d] }
    }

    /// Grows the tree at `i`; returns the edge (source-side node, direction) where the two trees meet.
    fn grow(&mut self, i: usize) -> Option<(usize, usize)> {
        let sink = self.sink_side[i];
        for d in 0..8 {
            let j = self.neighbour(i, d);
            let residual = if sink { self.capacity[j][7 - d] } else { self.capacity[i][d] };
            if residual <= 0 {
                continue;
            }
            if self.parent[j] == FREE {
                self.sink_side[j] = sink;
                self.parent[j] = (7 - d) as u8;
                self.stamp[j] = self.stamp[i];
                self.depth[j] = self.depth[i] + 1;
                self.activate(j);
            } else if self.sink_side[j] != sink {
                return Some(if sink { (j, 7 - d) } else { (i, d) });
            } else if self.stamp[j] <= self.stamp[i] && self.depth[j] > self.depth[i] {
                self.parent[j] = (7 - d) as u8;
                self.stamp[j] = self.stamp[i];
                self.depth[j] = self.depth[i] + 1;
            }
        }
        None
    }

    fn augment(&mut self, from: usize, d: usize) {
        let to = self.neighbour(from, d);
        let flow = self.capacity[from][d].min(self.bottleneck(from, false)).min(self.bottleneck(to, true));
        self.capacity[from][d] -= flow;
        self.capacity[to][7 - d] += flow;
        self.push(from, flow, false);
        self.push(to, flow, true);
    }

    fn bottleneck(&self, mut i: usize, sink: bool) -> i32 {
        let mut flow = i32::MAX;
        while self.parent[i] < TERMINAL {
            let d = self.parent[i] as usize;
            flow = flow.min(self.residual_towards_tree(i, d, sink));
            i = self.neighbour(i, d);
        }
        flow.min(self.terminal[i].abs())
    }

    fn push(&mut self, mut i: usize, flow: i32, sink: bool) {
        while self.parent[i] < TERMINAL {
            let d = self.parent[i] as usize;
            let p = self.neighbour(i, d);
            let sign = if sink { 1 } else { -1 };
            self.capacity[i][d] -= sign * flow;
            self.capacity[p][7 - d] += sign * flow;
            if self.residual_towards_tree(i, d, sink) == 0 {
                self.parent[i] = ORPHAN;
                self.orphans.push_front(i as u32);
            }
            i = p;
        }
        self.terminal[i] += if sink { flow } else { -flow };
        if self.terminal[i] == 0 {
            self.parent[i] = ORPHAN;
            self.orphans.push_front(i as u32);
        }
    }

    /// Distance of `j` from its terminal, `None` when its path ends at an orphan.
    fn origin(&self, mut j: usize) -> Option<u32> {
        let mut steps = 0;
        loop {
            if self.stamp[j] == self.time {
                return Some(steps + self.depth[j]);
            }
            steps += 1;
            match self.parent[j] {
                TERMINAL => return Some(steps),
                ORPHAN | FREE => return None,
                d => j = self.neighbour(j, d as usize),
            }
        }
    }

    fn mark(&mut self, mut j: usize, mut distance: u32) {
        while self.stamp[j] != self.time {
            self.stamp[j] = self.time;
            self.depth[j] = distance;
            if self.parent[j] >= TERMINAL {
                break;
            }
            distance = distance.saturating_sub(1);
            j = self.neighbour(j, self.parent[j] as usize);
        }
    }

    fn adopt(&mut self, i: usize) {
        let sink = self.sink_side[i];
        let mut best: Option<(u32, usize)> = None;
        for d in 0..8 {
            let j = self.neighbour(i, d);
            if self.parent[j] == FREE
                || self.sink_side[j] != sink
                || self.residual_towards_tree(i, d, sink) <= 0
            {
                continue;
            }
            if let Some(distance) = self.origin(j) {
                if best.is_none_or(|(b, _)| distance < b) {
                    best = Some((distance, d));
                }
                self.mark(j, distance);
            }
        }
        if let Some((distance, d)) = best {
            self.parent[i] = d as u8;
            self.stamp[i] = self.time;
            self.depth[i] = distance + 1;
            return;
        }
        self.parent[i] = FREE;
        for d in 0..8 {
            let j = self.neighbour(i, d);
            if self.parent[j] == FREE || self.sink_side[j] != sink {
                continue;
            }
            if self.residual_towards_tree(i, d, sink) > 0 {
                self.activate(j);
            }
            if self.parent[j] as usize == 7 - d {
                self.parent[j] = ORPHAN;
                self.orphans.push_back(j as u32);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn energy(labels: u32, w: usize, h: usize, unary: &[i32], edges: &[i32]) -> i64 {
        let label = |i: usize| labels >> i & 1 == 1;
        let mut sum = 0i64;
        for y in 0..h {
            for x in 0..w {
                let i = y * w + x;
                if label(i) != (unary[i] > 0) {
                    sum += i64::from(unary[i].abs());
                }
                for (k, d) in (4..8).enumerate() {
                    let (nx, ny) = (x as i32 + OFFSETS[d].0, y as i32 + OFFSETS[d].1);
                    if nx >= 0 && ny >= 0 && (nx as usize) < w && (ny as usize) < h {
                        let j = ny as usize * w + nx as usize;
                        if label(i) != label(j) {
                            sum += i64::from(edges[i * 4 + k]);
                        }
                    }
                }
            }
        }
        sum
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(60))]
        #[test]
        fn cut_is_the_minimum_over_all_labellings(
            unary in prop::collection::vec(-20i32..20, 12),
            edges in prop::collection::vec(0i32..12, 48),
        ) {
            let (w, h) = (4, 3);
            let mut cut = Graph::new(w * h);
            for y in 0..h {
                for x in 0..w {
                    let i = y * w + x;
                    cut.set_unary(i, unary[i]);
                    for (k, d) in (4..8).enumerate() {
                        let (nx, ny) = (x as i32 + OFFSETS[d].0, y as i32 + OFFSETS[d].1);
                        if nx >= 0 && ny >= 0 && (nx as usize) < w && (ny as usize) < h {
                            cut.set_edge(i, ny as usize * w + nx as usize, d, edges[i * 4 + k]);
                        }
                    }
                }
            }
            let found = cut.solve().iter().enumerate().fold(0u32, |s, (i, &l)| s | (u32::from(l) << i));
            let best = (0..1u32 << 12).map(|s| energy(s, w, h, &unary, &edges)).min().unwrap();
            prop_assert_eq!(energy(found, w, h, &unary, &edges), best);
        }
    }
}
