//! Extraction from the part of a lattice that some boxes cover, on all cores.

use crate::dense::{crossing, for_ones};
use crate::table::{CASES, EDGES};
use crate::{TriMesh, mesh::usable_lattice};
use rayon::prelude::*;
use std::collections::HashMap;

/// Lattice points of all cells that touch a set of boxes, kept in blocks of 8x8x8.
///
/// The lattice is the multiples of the spacing. Ask for [`points`](Self::points), evaluate a field there, and hand
/// the values to [`extract`](Self::extract). Memory follows the covered volume: a thin shell of voxels around a
/// surface costs about its area.
#[derive(Clone, Debug)]
pub struct SparseGrid {
    spacing: f64,
    /// Sorted by block coordinate, z first.
    blocks: Vec<Block>,
    slots: HashMap<[i32; 3], u32>,
    len: usize,
}

/// 8x8x8 lattice points: which of them belong to the grid, and their place in the list of points.
#[derive(Clone, Debug)]
struct Block {
    coord: [i32; 3],
    points: Ranked,
}

/// 512 bits with the number that the first set bit of each word has in a running count.
#[derive(Clone, Debug, Default)]
struct Ranked {
    words: [u64; 8],
    before: [u32; 8],
}

impl Ranked {
    /// Numbers the set bits from `start`; returns the number after the last.
    fn number_from(&mut self, start: u32) -> u32 {
        let mut next = start;
        for (before, word) in self.before.iter_mut().zip(&self.words) {
            *before = next;
            next += word.count_ones();
        }
        next
    }

    /// Number of a bit, if it is set.
    #[inline]
    fn get(&self, bit: usize) -> Option<u32> {
        let (word, mask) = (self.words[bit / 64], 1 << (bit % 64));
        // Most words of points are full; counting bits is slow where the processor is not known to do it.
        let rank = if word == !0 { (bit % 64) as u32 } else { (word & (mask - 1)).count_ones() };
        (word & mask != 0).then_some(self.before[bit / 64] + rank)
    }
}

/// Largest lattice coordinate; keeps differences and neighbours within `i32`, positions exact in `f64`.
const MAX_COORDINATE: f64 = (1 << 29) as f64;

impl SparseGrid {
    /// The lattice points of all cells that overlap one of the `(min, max)` boxes.
    ///
    /// A box that is inverted or not finite is skipped; one without volume covers the cells that it touches. `None`
    /// when more than `max_points` (at most 2^30) points would be needed, a box lies more than 2^29 spacings from
    /// zero, or `spacing` is not a positive number. Overlapping and adjacent boxes share points.
    #[must_use]
    pub fn covering(
        boxes: impl Iterator<Item = ([f32; 3], [f32; 3])>,
        spacing: f32,
        max_points: usize,
    ) -> Option<SparseGrid> {
        if !usable_lattice([0.0; 3], spacing) {
            return None;
        }
        let max_points = max_points.min(1 << 30);
        let mut grid =
            Self { spacing: f64::from(spacing), blocks: Vec::new(), slots: HashMap::new(), len: 0 };
        for (lo, hi) in boxes {
            if !(0..3).all(|a| lo[a] <= hi[a] && lo[a].is_finite() && hi[a].is_finite()) {
                continue;
            }
            let first = lo.map(|v| (f64::from(v) / grid.spacing).floor());
            // A box that ends on a lattice plane does not reach into the next cell.
            let last: [f64; 3] =
                std::array::from_fn(|a| (f64::from(hi[a]) / grid.spacing).ceil().max(first[a] + 1.0));
            let count: f64 = (0..3).map(|a| last[a] - first[a] + 1.0).product();
            if first.iter().chain(&last).any(|v| v.abs() > MAX_COORDINATE) || count > max_points as f64 {
                return None;
            }
            grid.add_points(first.map(|v| v as i32), last.map(|v| v as i32));
            if grid.len > max_points {
                return None;
            }
        }
        grid.finish();
        Some(grid)
    }

    /// Adds the lattice points from `first` to `last`, inclusive.
    fn add_points(&mut self, first: [i32; 3], last: [i32; 3]) {
        let blocks = |a: usize| first[a] >> 3..=last[a] >> 3;
        // Bits of the points within a block, of eight in a row.
        let within = |a: usize, block: i32| {
            let from = (first[a] - 8 * block).max(0);
            let to = (last[a] - 8 * block).min(7);
            from as usize..=to as usize
        };
        for bz in blocks(2) {
            for by in blocks(1) {
                for bx in blocks(0) {
                    let row: u64 = within(0, bx).map(|x| 1 << x).sum();
                    let plane: u64 = within(1, by).map(|y| row << (8 * y)).sum();
                    let slot = *self.slots.entry([bx, by, bz]).or_insert_with(|| {
                        self.blocks.push(Block { coord: [bx, by, bz], points: Ranked::default() });
                        self.blocks.len() as u32 - 1
                    });
                    let words = &mut self.blocks[slot as usize].points.words;
                    for z in within(2, bz) {
                        self.len += (plane & !words[z]).count_ones() as usize;
                        words[z] |= plane;
                    }
                }
            }
        }
    }

    /// Puts blocks in an order that does not depend on the boxes' order, and numbers the points.
    fn finish(&mut self) {
        self.blocks.sort_by_key(|b| [b.coord[2], b.coord[1], b.coord[0]]);
        let mut next = 0;
        for (slot, block) in self.blocks.iter_mut().enumerate() {
            next = block.points.number_from(next);
            self.slots.insert(block.coord, slot as u32);
        }
    }

    /// Number of lattice points.
    #[must_use]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether no box covered anything.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Distance between lattice neighbours.
    #[must_use]
    pub fn spacing(&self) -> f32 {
        self.spacing as f32
    }

    /// Positions of the lattice points, in the order in which [`extract`](Self::extract) wants their values. The
    /// order depends only on the set of points.
    #[must_use]
    pub fn points(&self) -> Vec<[f32; 3]> {
        let mut points = Vec::with_capacity(self.len);
        for block in &self.blocks {
            for (z, &word) in block.points.words.iter().enumerate() {
                for_ones(word, |b| {
                    let p = lattice(block.coord, [b & 7, b >> 3, z]);
                    points.push(p.map(|c| (c * self.spacing) as f32));
                });
            }
        }
        points
    }

    /// Mesh of the level set `value = iso`, with the conventions of [`extract_dense`](crate::extract_dense).
    ///
    /// `values[i]` belongs to `points()[i]`; a missing value counts as NaN. Only cells whose eight corners are all
    /// lattice points with a number give triangles: where the grid ends the mesh is open, and no wall is made up. Runs
    /// on the current rayon pool; the mesh does not depend on the number of threads.
    #[must_use]
    pub fn extract(&self, values: &[f32], iso: f32) -> TriMesh {
        let mut mesh = TriMesh::default();
        if iso.is_nan() {
            return mesh;
        }
        let slots = 0..self.blocks.len();
        // The edges that start at a block's points and are crossed, numbered as their vertices, for each axis.
        let mut crossed: Vec<Option<Box<Crossed>>> = slots
            .clone()
            .into_par_iter()
            .map(|slot| {
                let patch = self.patch(slot, values, iso);
                patch.mixed.then(|| self.vertices(&patch, iso))
            })
            .collect();
        for block in crossed.iter_mut().flatten() {
            let first = mesh.vertices.len() as u32;
            for before in block.edges.iter_mut().flat_map(|e| &mut e.before) {
                *before += first;
            }
            mesh.vertices.append(&mut block.vertices);
        }
        let triangles: Vec<Vec<[u32; 3]>> = slots
            .into_par_iter()
            .filter(|slot| crossed[*slot].is_some())
            .map(|slot| triangles(&self.patch(slot, values, iso), &crossed))
            .collect();
        mesh.triangles = triangles.concat();
        mesh.drop_unused_vertices();
        mesh
    }

    /// Block `slot`'s values with one more row, column and layer from its neighbours; NaN where there is no point.
    fn patch(&self, slot: usize, values: &[f32], iso: f32) -> Patch {
        let coord = self.blocks[slot].coord;
        let mut patch = Patch::empty(coord);
        for n in 0..8usize {
            let offset = [n & 1, n >> 1 & 1, n >> 2];
            let Some(&slot) = self.slots.get(&std::array::from_fn(|a| coord[a] + offset[a] as i32)) else {
                continue;
            };
            patch.neighbours[n] = Some(slot);
            let points = &self.blocks[slot as usize].points;
            // Of a neighbour, only the points next to the block.
            let row = if offset[0] == 0 { 0xFF } else { 1 };
            let plane = if offset[1] == 0 { 0x0101_0101_0101_0101 * row } else { row };
            for z in 0..if offset[2] == 0 { 8 } else { 1 } {
                for_ones(points.words[z] & plane, |b| {
                    let v = points.get(b + 64 * z).and_then(|i| values.get(i as usize));
                    patch.values[z + 8 * offset[2]][(b >> 3) + 8 * offset[1]][(b & 7) + 8 * offset[0]] =
                        v.copied().unwrap_or(f32::NAN);
                });
            }
        }
        patch.find_signs(iso);
        patch
    }

    /// The vertices on edges that start at the block's own points, numbered from 0.
    fn vertices(&self, patch: &Patch, iso: f32) -> Box<Crossed> {
        let mut block = Box::<Crossed>::default();
        let Crossed { edges, vertices } = &mut *block;
        for axis in 0..3 {
            let first = vertices.len() as u32;
            for z in 0..8 {
                let word = patch.crossed(axis, z);
                edges[axis].words[z] = word;
                for_ones(word, |b| {
                    let at = [b & 7, b >> 3, z];
                    let mut to = at;
                    to[axis] += 1;
                    let mut p = lattice(patch.coord, at);
                    p[axis] += crossing(patch.at(at), patch.at(to), iso);
                    vertices.push(p.map(|c| (c * self.spacing) as f32));
                });
            }
            edges[axis].number_from(first);
        }
        block
    }
}

/// What a block adds to the mesh's vertices.
#[derive(Default)]
struct Crossed {
    /// Crossed edges along each axis, numbered as their vertices.
    edges: [Ranked; 3],
    /// Emptied when they go to the mesh.
    vertices: Vec<[f32; 3]>,
}

/// The triangles of the cells that start in a block.
fn triangles(patch: &Patch, crossed: &[Option<Box<Crossed>>]) -> Vec<[u32; 3]> {
    let mut triangles = Vec::new();
    let edges_of = patch.neighbours.map(|slot| Some(&crossed.get(slot? as usize)?.as_deref()?.edges));
    let cases = &*CASES;
    for z in 0..8 {
        for_ones(patch.mixed_cells(z), |b| {
            let at = [b & 7, b >> 3, z];
            let corner = |c: usize| [at[0] + (c & 1), at[1] + (c >> 1 & 1), at[2] + (c >> 2)];
            let case = (0..8).map(|c| usize::from(patch.is_outside(corner(c))) << c).sum::<usize>();
            let vertex = |edge: u8| {
                let (axis, lower) = EDGES[usize::from(edge)];
                let p = corner(lower);
                let neighbour = p[0] >> 3 | p[1] >> 3 << 1 | p[2] >> 3 << 2;
                edges_of[neighbour]?[axis].get((p[0] & 7) + 8 * (p[1] & 7) + 64 * (p[2] & 7))
            };
            for t in cases[case].triangles() {
                // Every edge that a case names is crossed between two numbers, so it has a vertex.
                if let (Some(a), Some(b), Some(c)) = (vertex(t[0]), vertex(t[1]), vertex(t[2])) {
                    triangles.push([a, b, c]);
                }
            }
        });
    }
    triangles
}

/// A block's surroundings, as the cells that start in it see them.
struct Patch {
    coord: [i32; 3],
    /// Indexed z, y, x.
    values: [[[f32; 9]; 9]; 9],
    /// Signs of the values, one bit for each x, indexed z, y; NaN is not outside.
    outside: [[u16; 9]; 9],
    nan: [[u16; 9]; 9],
    /// Slots of the block itself and its seven neighbours towards larger coordinates.
    neighbours: [Option<u32>; 8],
    /// Whether there are values on both sides of the level.
    mixed: bool,
}

impl Patch {
    fn empty(coord: [i32; 3]) -> Self {
        Self {
            coord,
            values: [[[f32::NAN; 9]; 9]; 9],
            outside: [[0; 9]; 9],
            nan: [[0; 9]; 9],
            neighbours: [None; 8],
            mixed: false,
        }
    }

    fn find_signs(&mut self, iso: f32) {
        let (mut any_inside, mut any_outside) = (0, 0);
        for z in 0..9 {
            for y in 0..9 {
                let (mut outside, mut nan) = (0, 0);
                for (x, v) in self.values[z][y].iter().enumerate() {
                    outside |= u16::from(*v > iso) << x;
                    nan |= u16::from(v.is_nan()) << x;
                }
                (self.outside[z][y], self.nan[z][y]) = (outside, nan);
                any_outside |= outside;
                any_inside |= !(outside | nan) & 0x1FF;
            }
        }
        self.mixed = any_inside != 0 && any_outside != 0;
    }

    #[inline]
    fn at(&self, [x, y, z]: [usize; 3]) -> f32 {
        self.values[z][y][x]
    }

    #[inline]
    fn is_outside(&self, [x, y, z]: [usize; 3]) -> bool {
        self.outside[z][y] >> x & 1 != 0
    }

    /// Edges along `axis` that start in layer `z` of the block and change sign between two numbers, 8 to a row.
    fn crossed(&self, axis: usize, z: usize) -> u64 {
        let mut word = 0;
        for y in 0..8 {
            let (outside, nan) = (self.outside[z][y], self.nan[z][y]);
            let (to_outside, to_nan) = match axis {
                0 => (outside >> 1, nan >> 1),
                1 => (self.outside[z][y + 1], self.nan[z][y + 1]),
                _ => (self.outside[z + 1][y], self.nan[z + 1][y]),
            };
            let row = (outside ^ to_outside) & !(nan | to_nan) & 0xFF;
            word |= u64::from(row) << (8 * y);
        }
        word
    }

    /// Cells of layer `z` with eight numbers on both sides of the level, 8 to a row.
    fn mixed_cells(&self, z: usize) -> u64 {
        let mut word = 0;
        for y in 0..8 {
            let (mut any, mut all, mut nan) = (0, 0x1FF, 0);
            for (z, y) in [(z, y), (z, y + 1), (z + 1, y), (z + 1, y + 1)] {
                any |= self.outside[z][y];
                all &= self.outside[z][y];
                nan |= self.nan[z][y];
            }
            let row = (any | any >> 1) & !(all & all >> 1) & !(nan | nan >> 1) & 0xFF;
            word |= u64::from(row) << (8 * y);
        }
        word
    }
}

/// Lattice coordinates of a point of a block.
fn lattice(block: [i32; 3], within: [usize; 3]) -> [f64; 3] {
    std::array::from_fn(|a| f64::from(block[a]) * 8.0 + within[a] as f64)
}
