//! The multi-resolution feature grid (Müller et al., Instant NGP, 2022, section 3): trilinear interpolation on a
//! few lattices, dense where they fit the table, hashed where they do not.

use crate::adam::PartState;
use crate::lanes::Lanes;
use crate::real::{Isa, Kernel, Real};
use crate::simd::prefetch;
use crate::tile::{PANEL, Panel, VECTOR};
use std::ops::Range;

/// Features per lattice vertex. Fixed: a pair of vertices is then one 128-bit load.
pub(crate) const FEATURES: usize = 2;

/// Vertices of one lattice in memory; a multiple of it is allocated, and Adam updates whole groups.
pub(crate) const GROUP: usize = 8;

/// Features of a vector of points, and their derivatives along the axes.
type Encoded<V> = ([V; FEATURES], [[V; 3]; FEATURES]);

/// One lattice over the unit cube.
#[derive(Clone, Debug)]
pub(crate) struct Level {
    /// Vertices per axis.
    pub(crate) vertices: u32,
    /// Cells per unit; a point lies at `p * scale + 0.5` in vertex units (the half keeps the lattices of
    /// different levels from sharing vertices).
    pub(crate) scale: f64,
    /// Number of stored vertices.
    pub(crate) len: usize,
    pub(crate) hash_mask: Option<u32>,
}

impl Level {
    fn new(resolution: f64, log2_table: u32) -> Self {
        let scale = resolution - 1.0;
        let vertices = scale.ceil() as u32 + 2;
        let dense = (vertices as usize).pow(3);
        let table = 1usize << log2_table;
        if dense <= table {
            Self { vertices, scale, len: dense.next_multiple_of(GROUP), hash_mask: None }
        } else {
            Self { vertices, scale, len: table, hash_mask: Some((table - 1) as u32) }
        }
    }
}

/// Where dense lattices are cut into parts that are updated side by side, as a height in the unit cube: through the middle
/// of the object. Every part looks at all samples, so that more parts cost more than they gain on few cores.
const CUT: f64 = 1.0 / 2.0;

/// Lattices of so many vertices don't stay in a core's own cache.
const FAR: usize = 1 << 15;

/// Lattices with fewer vertices stay in one part.
const LEAST_CUT: usize = 1 << 14;

impl Level {
    /// Parts of the vertices, in groups of [`GROUP`]. Fixed, so that sums don't depend on the number of threads.
    pub(crate) fn parts(&self) -> impl Iterator<Item = Range<usize>> + use<> {
        let (n, len) = (self.vertices as usize, self.len);
        let whole = self.hash_mask.is_some() || len < LEAST_CUT;
        let cut = if whole { len } else { ((CUT * n as f64) as usize * n * n).next_multiple_of(GROUP) };
        [0..cut, cut..len].into_iter().take(if whole { 1 } else { 2 })
    }
}

/// Where some points lie in a lattice.
pub(crate) struct Cells<R> {
    /// Cell along each axis, `[axis][point]`; of a hashed lattice only.
    cell: [[u32; VECTOR]; 3],
    /// Where the first vertex's features are in the table of a dense lattice.
    pub(crate) base: [u32; VECTOR],
    /// The same as numbers.
    pub(crate) start: [R; VECTOR],
    /// Position within the cell, `[axis][point]`.
    pub(crate) frac: [[R; VECTOR]; 3],
}

impl<R> Cells<R> {
    /// A point's cell along each axis; of a hashed lattice only.
    #[inline(always)]
    pub(crate) fn cell(&self, p: usize) -> [u32; 3] {
        [self.cell[0][p], self.cell[1][p], self.cell[2][p]]
    }
}

impl Level {
    /// Cells of the points from `start` in `pos[axis * lanes + point]`, in the unit cube (clamped to it).
    #[inline(always)]
    pub(crate) fn locate<R: Real, I: Isa>(&self, pos: &[R], lanes: usize, start: usize) -> Cells<R> {
        let mut cells = Cells {
            cell: [[0; VECTOR]; 3],
            base: [0; VECTOR],
            start: [R::ZERO; VECTOR],
            frac: [[R::ZERO; VECTOR]; 3],
        };
        let n = R::of_int(self.vertices as i32);
        let (scale, half) = (<R::V<I>>::splat(R::of(self.scale)), <R::V<I>>::splat(R::of(0.5)));
        let features = <R::V<I>>::splat(R::of_int(FEATURES as i32));
        let (n, last) = (<R::V<I>>::splat(n), <R::V<I>>::splat(n - R::of(2.0)));
        for p in (0..VECTOR).step_by(<R::V<I>>::N) {
            // Numbers of vertices are at most 2^24 and exact.
            let mut base = <R::V<I>>::splat(R::ZERO);
            for a in [2, 1, 0] {
                let x = <R::V<I>>::load(pos, a * lanes + start + p).madd(scale, half);
                let i = x.positive().min(last).trunc();
                x.sub(i).store(&mut cells.frac[a], p);
                base = base.madd(n, i);
                if self.hash_mask.is_some() {
                    i.store_ints(&mut cells.cell[a], p);
                }
            }
            if self.hash_mask.is_none() {
                base = base.mul(features);
                base.store(&mut cells.start, p);
                base.store_ints(&mut cells.base, p);
            }
        }
        cells
    }

    /// Whether the lattice is larger than the caches that are near: what is asked for early is then worth asking.
    #[inline(always)]
    fn is_far(&self) -> bool {
        self.hash_mask.is_none() && self.len >= FAR
    }

    /// Asks for the features of a dense lattice's cells.
    #[inline(always)]
    fn prefetch<R: Real>(&self, table: &[R], cells: &Cells<R>) {
        for base in cells.base {
            for stride in self.strides() {
                prefetch(table, base as usize + FEATURES * stride);
            }
        }
    }

    /// How far a dense lattice's rows along x are from a cell's first vertex, for (y, z) = (0, 0), (1, 0), (0, 1), (1, 1).
    #[inline(always)]
    pub(crate) fn strides(&self) -> [usize; 4] {
        let n = self.vertices as usize;
        [0, n, n * n, n * n + n]
    }

    /// From where a cell's features start in a dense lattice's table to where they end.
    #[inline(always)]
    pub(crate) fn reach(&self) -> usize {
        FEATURES * (self.strides()[3] + 2)
    }

    /// Vertices of a cell in a hashed lattice, rows as in [`strides`](Self::strides).
    #[inline(always)]
    pub(crate) fn hashed(&self, mask: u32, [x, y, z]: [u32; 3]) -> [[usize; 2]; 4] {
        let (y0, y1) = (y.wrapping_mul(HASH_Y), (y + 1).wrapping_mul(HASH_Y));
        let (z0, z1) = (z.wrapping_mul(HASH_Z), (z + 1).wrapping_mul(HASH_Z));
        let mut rows = [[0; 2]; 4];
        for (row, h) in rows.iter_mut().zip([y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1]) {
            *row = [((h ^ x) & mask) as usize, ((h ^ (x + 1)) & mask) as usize];
        }
        rows
    }

    /// Rows of the cells of every fourth point from `place`, each a vector of quads: the features of a row's two
    /// vertices, `[a0, a1, b0, b1]`.
    #[inline(always)]
    fn rows<R: Real, I: Isa>(
        &self,
        table: &[R],
        cells: &Cells<R>,
        first: usize,
        place: usize,
    ) -> [R::V<I>; 4] {
        let mut rows = [<R::V<I>>::splat(R::ZERO); 4];
        match self.hash_mask {
            None => {
                for (row, stride) in rows.iter_mut().zip(self.strides()) {
                    *row = <R::V<I>>::load_quads(table, &cells.base[first..], place, FEATURES * stride);
                }
            }
            Some(mask) => {
                let mut found = [[R::ZERO; VECTOR]; 4];
                for q in 0..<R::V<I>>::N / 4 {
                    let vertices = self.hashed(mask, cells.cell(first + 4 * q + place));
                    for (found, [a, b]) in found.iter_mut().zip(vertices) {
                        found[4 * q..4 * q + 2].copy_from_slice(&table[2 * a..2 * a + 2]);
                        found[4 * q + 2..4 * q + 4].copy_from_slice(&table[2 * b..2 * b + 2]);
                    }
                }
                for (row, found) in rows.iter_mut().zip(&found) {
                    *row = <R::V<I>>::load(found, 0);
                }
            }
        }
        rows
    }

    /// Encodes a vector of points: features, and if `SLOPES` their derivatives by position in the unit cube.
    #[inline(always)]
    fn interpolate<R: Real, I: Isa, const SLOPES: bool>(
        &self,
        table: &[R],
        cells: &Cells<R>,
        first: usize,
    ) -> Encoded<R::V<I>> {
        let zero = <R::V<I>>::splat(R::ZERO);
        let (mut values, mut slopes) = ([zero; 4], [zero; 4]);
        let fx = <R::V<I>>::load(&cells.frac[0], first);
        let fy = <R::V<I>>::load(&cells.frac[1], first);
        let fz = <R::V<I>>::load(&cells.frac[2], first);
        for place in 0..4 {
            let r = self.rows::<R, I>(table, cells, first, place);
            let (fx, fy, fz) = (fx.splat_in_quads(place), fy.splat_in_quads(place), fz.splat_in_quads(place));
            let (low, high) = (r[1].sub(r[0]), r[3].sub(r[2]));
            let (y0, y1) = (fy.madd(low, r[0]), fy.madd(high, r[2]));
            let dz = y1.sub(y0);
            let value = fz.madd(dz, y0);
            let dy = fz.madd(high.sub(low), low);
            // Along x, values and slopes by y in one: `[v, v, dy, dy]`.
            let (a, b) = (value.low_pairs(dy), value.high_pairs(dy));
            let dx = b.sub(a);
            values[place] = fx.madd(dx, a);
            if SLOPES {
                let dz = fx.madd(dz.high_pairs(dz).sub(dz), dz);
                slopes[place] = dx.low_pairs(dz);
            }
        }
        let [v0, v1, y0, y1] = Lanes::transpose_quads(values);
        let [x0, x1, z0, z1] = Lanes::transpose_quads(slopes);
        let scale = <R::V<I>>::splat(R::of(self.scale));
        (
            [v0, v1],
            [[x0.mul(scale), y0.mul(scale), z0.mul(scale)], [x1.mul(scale), y1.mul(scale), z1.mul(scale)]],
        )
    }

    /// Mixed second derivatives of each feature (the pure ones are zero): `out[f * 3 + k][point]` with k for xy, xz, yz.
    #[inline(always)]
    pub(crate) fn mixed<R: Real, I: Isa>(&self, table: &[R], cells: &Cells<R>, out: &mut [R]) {
        let zero = <R::V<I>>::splat(R::ZERO);
        let scale2 = <R::V<I>>::splat(R::of(self.scale * self.scale));
        for first in (0..VECTOR).step_by(<R::V<I>>::N) {
            let fx = <R::V<I>>::load(&cells.frac[0], first);
            let fy = <R::V<I>>::load(&cells.frac[1], first);
            let fz = <R::V<I>>::load(&cells.frac[2], first);
            let (mut by_x, mut by_yz) = ([zero; 4], [zero; 4]);
            for place in 0..4 {
                let r = self.rows::<R, I>(table, cells, first, place);
                let (fx, fy, fz) =
                    (fx.splat_in_quads(place), fy.splat_in_quads(place), fz.splat_in_quads(place));
                let (y0, y1) = (r[1].sub(r[0]), r[3].sub(r[2]));
                let (z0, z1) = (r[2].sub(r[0]), r[3].sub(r[1]));
                let twist = y1.sub(y0);
                let (dy, dz) = (fz.madd(twist, y0), fy.madd(z1.sub(z0), z0));
                by_x[place] = dy.high_pairs(dz).sub(dy.low_pairs(dz));
                by_yz[place] = fx.madd(twist.high_pairs(twist).sub(twist), twist);
            }
            let [xy0, xy1, xz0, xz1] = Lanes::transpose_quads(by_x);
            let [yz0, yz1, _, _] = Lanes::transpose_quads(by_yz);
            for (row, v) in [xy0, xz0, yz0, xy1, xz1, yz1].into_iter().enumerate() {
                v.mul(scale2).store(out, row * VECTOR + first);
            }
        }
    }
}

const HASH_Y: u32 = 2_654_435_761;
const HASH_Z: u32 = 805_459_861;

/// All lattices with their tables (`FEATURES` numbers a vertex).
#[derive(Clone, Debug)]
pub(crate) struct Grid<R> {
    pub(crate) levels: Vec<Level>,
    pub(crate) tables: Vec<Vec<R>>,
}

impl<R: Real> Grid<R> {
    /// Lattices from `base` to `finest` cells a side in geometric steps, features uniform in +-`amplitude`.
    pub(crate) fn new(
        levels: usize,
        (base, finest): (u32, u32),
        log2_table: u32,
        amplitude: f64,
        seed: u64,
    ) -> Self {
        let growth = if levels > 1 {
            (f64::from(finest) / f64::from(base)).powf(1.0 / (levels - 1) as f64)
        } else {
            1.0
        };
        let levels: Vec<Level> = (0..levels)
            .map(|l| {
                // Powers of a rounded root: 128 must not become 127.99999.
                let r = f64::from(base) * growth.powi(l as i32);
                Level::new(if (r - r.round()).abs() < 1e-6 { r.round() } else { r }, log2_table)
            })
            .collect();
        let tables = levels
            .iter()
            .enumerate()
            .map(|(l, level)| {
                (0..level.len * FEATURES)
                    .map(|i| {
                        let h = mix(seed ^ mix(((l as u64) << 40) ^ i as u64));
                        R::of(((h >> 40) as f64 / (1u64 << 23) as f64 - 1.0) * amplitude)
                    })
                    .collect()
            })
            .collect();
        Self { levels, tables }
    }

    /// Number of encoded features, before padding.
    pub(crate) fn width(&self) -> usize {
        self.levels.len() * FEATURES
    }

    /// Gives every part, in order of the finest lattice first, its lattice and the features of its vertices.
    pub(crate) fn shares<'a>(
        &'a mut self,
        parts: &'a mut [PartState],
    ) -> Vec<(&'a Level, &'a mut PartState, &'a mut [R])> {
        let mut parts = parts.iter_mut().peekable();
        let mut shares = Vec::new();
        for (l, (level, table)) in self.levels.iter().zip(&mut self.tables).enumerate().rev() {
            let mut table = table.as_mut_slice();
            while let Some(part) = parts.next_if(|p| p.level == l) {
                let (own, rest) = table.split_at_mut(part.grad.len());
                shares.push((level, part, own));
                table = rest;
            }
        }
        shares
    }
}

/// Encodes a panel of the points `pos[axis * lanes + lane]` into `enc[feature][lane]`, and if `SLOPES` its derivatives
/// into `jac[feature * 3 + axis][lane]`. What is not a feature in `enc` becomes zero.
pub(crate) struct Encode<'a, R, const SLOPES: bool> {
    pub(crate) grid: &'a Grid<R>,
    pub(crate) pos: (&'a [R], usize),
    pub(crate) panel: Panel,
    pub(crate) enc: &'a mut [R],
    pub(crate) jac: &'a mut [R],
}

impl<R: Real, const SLOPES: bool> Kernel for Encode<'_, R, SLOPES> {
    #[inline(always)]
    fn run<I: Isa>(self) {
        let Self { grid, pos: (pos, lanes), panel, enc, jac } = self;
        for (l, (level, table)) in grid.levels.iter().zip(&grid.tables).enumerate() {
            for from in (0..panel.width).step_by(VECTOR) {
                let next = panel.start + from + VECTOR;
                if level.is_far() && next < lanes {
                    level.prefetch(table, &level.locate::<R, I>(pos, lanes, next));
                }
                let cells = level.locate::<R, I>(pos, lanes, panel.start + from);
                for p in (0..VECTOR).step_by(<R::V<I>>::N) {
                    let (values, slopes) = level.interpolate::<R, I, SLOPES>(table, &cells, p);
                    for f in 0..FEATURES {
                        let row = FEATURES * l + f;
                        values[f].store(enc, row * PANEL + from + p);
                        if SLOPES {
                            for (a, slope) in slopes[f].iter().enumerate() {
                                slope.store(jac, (row * 3 + a) * PANEL + from + p);
                            }
                        }
                    }
                }
            }
        }
        // What another grid may have left there.
        enc[grid.width() * PANEL..].fill(R::ZERO);
    }
}

/// Finaliser of SplitMix64 (Steele et al. 2014): a 64-bit hash.
#[inline(always)]
pub(crate) fn mix(x: u64) -> u64 {
    let x = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::real::Baseline;

    #[test]
    fn online_lattices_are_dense_with_one_vertex_more_than_cells() {
        let grid = Grid::<f32>::new(4, (16, 128), 22, 1e-4, 0);
        let vertices: Vec<u32> = grid.levels.iter().map(|l| l.vertices).collect();
        assert_eq!(vertices, [17, 33, 65, 129]);
        assert!(grid.levels.iter().all(|l| l.hash_mask.is_none()));
    }

    /// Cells of one point.
    fn locate<R: Real>(level: &Level, p: [R; 3]) -> Cells<R> {
        level.locate::<R, Baseline>(&p.map(|v| [v; VECTOR]).concat(), VECTOR, 0)
    }

    #[test]
    fn lattices_beyond_the_table_are_hashed_evenly() {
        let grid = Grid::<f32>::new(16, (16, 256), 17, 1e-4, 0);
        let table = 1usize << 17;
        let hashed: Vec<&Level> = grid.levels.iter().filter(|l| l.hash_mask.is_some()).collect();
        assert!(grid.levels.len() == 16 && hashed.len() >= 5 && hashed.len() < 16);
        for level in hashed {
            assert!(level.len == table && (level.vertices as usize).pow(3) > table);
            // Vertices of one layer of cells: as many as there are of them, up to the collisions of a random hash.
            let mut used = std::collections::HashSet::new();
            let n = level.vertices as usize - 1;
            for i in 0..n * n {
                let p = [i % n, i / n, n / 2].map(|c| (c as f64 + 0.01 - 0.5) / level.scale);
                used.insert(level.hashed(level.hash_mask.unwrap(), locate(level, p).cell(0))[0][0]);
            }
            let expected = table as f64 * (1.0 - (-((n * n) as f64) / table as f64).exp());
            assert!(used.len() as f64 > 0.9 * expected, "{} of {expected}", used.len());
        }
    }

    #[test]
    fn slopes_and_mixed_derivatives_match_differences() {
        for log2_table in [20, 8] {
            let grid = Grid::<f64>::new(2, (5, 9), log2_table, 1.0, 3);
            for (level, table) in grid.levels.iter().zip(&grid.tables) {
                let p = [0.313, 0.571, 0.847];
                let h = 1e-6;
                let encode = |p: [f64; 3]| {
                    let (value, slope) =
                        level.interpolate::<f64, Baseline, true>(table, &locate(level, p), 0);
                    // Eight times the same point.
                    (value.map(|v| v.total() / 8.0), slope.map(|s| s.map(|v| v.total() / 8.0)))
                };
                let at = encode(p);
                let mut mixed = [0.0; 3 * FEATURES * VECTOR];
                level.mixed::<f64, Baseline>(table, &locate(level, p), &mut mixed);
                for a in 0..3 {
                    let (mut lo, mut hi) = (p, p);
                    lo[a] -= h;
                    hi[a] += h;
                    let (l, u) = (encode(lo), encode(hi));
                    for f in 0..FEATURES {
                        let slope = (u.0[f] - l.0[f]) / (2.0 * h);
                        assert!((slope - at.1[f][a]).abs() < 1e-6);
                        for (b, pair) in [(0, 1), (0, 2), (1, 2)].iter().enumerate() {
                            if pair.0 == a {
                                let second = (u.1[f][pair.1] - l.1[f][pair.1]) / (2.0 * h);
                                assert!((second - mixed[(3 * f + b) * VECTOR]).abs() < 1e-6);
                            }
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn corners_of_the_cube_stay_in_the_table() {
        let grid = Grid::<f32>::new(3, (16, 64), 22, 1e-4, 0);
        for level in &grid.levels {
            for p in [[0.0; 3], [1.0; 3], [f32::NAN; 3], [-5.0, 7.0, 1e30]] {
                let base = locate(level, p).base[0] as usize;
                assert!(base + level.reach() <= FEATURES * level.len);
            }
        }
    }

    #[test]
    fn parts_cover_every_vertex_once_in_whole_groups() {
        for level in &Grid::<f32>::new(16, (16, 256), 18, 1e-4, 0).levels {
            let parts: Vec<Range<usize>> = level.parts().collect();
            assert!(parts[0].start == 0 && parts.last().unwrap().end == level.len);
            assert!(parts.windows(2).all(|w| w[0].end == w[1].start && w[1].start.is_multiple_of(GROUP)));
            assert!(parts.iter().all(|p| !p.is_empty()));
        }
    }
}
