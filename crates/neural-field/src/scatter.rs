//! From the gradients of a tile's encoding to those of a lattice's vertices.

use crate::grid::{Cells, FEATURES, GROUP, Level};
use crate::lanes::Lanes;
use crate::real::{Isa, Kernel, Real};
use crate::tile::{TileGradient, VECTOR};

/// Gradients of some of a lattice's vertices.
pub(crate) struct Vertices<'a, R> {
    /// The first of them.
    pub(crate) first: usize,
    /// `FEATURES` numbers a vertex.
    pub(crate) grad: &'a mut [R],
    /// 1 for every group of vertices that got a gradient, else as it was.
    pub(crate) touched: &'a mut [u8],
}

impl<R: Real> Vertices<'_, R> {
    /// Adds to a vertex of the lattice if it is one of these.
    #[inline(always)]
    fn add(&mut self, vertex: usize, add: &[R]) {
        let at = vertex.wrapping_sub(self.first);
        if at < self.grad.len() / FEATURES {
            for (g, add) in self.grad[FEATURES * at..][..FEATURES].iter_mut().zip(add) {
                *g += *add;
            }
            self.touched[at / GROUP] = 1;
        }
    }

    /// Adds rows of two neighbours' gradients where the features of the first are, counted from these vertices'.
    #[inline(always)]
    fn add_rows(&mut self, base: usize, strides: [usize; 4], rows: &[[R; 4 * VECTOR]; 4], p: usize) {
        for (row, stride) in rows.iter().zip(strides) {
            let at = base + FEATURES * stride;
            <R::Quad>::load(self.grad, at).add(<R::Quad>::load(row, 4 * p)).store(self.grad, at);
            self.touched[at / (GROUP * FEATURES)] = 1;
            self.touched[(at + FEATURES) / (GROUP * FEATURES)] = 1;
        }
    }
}

/// Adds a tile's gradients to vertices of the lattice number `l`.
pub(crate) struct Scatter<'a, 'v, R> {
    pub(crate) level: &'a Level,
    pub(crate) l: usize,
    pub(crate) tile: &'a TileGradient<R>,
    pub(crate) to: &'a mut Vertices<'v, R>,
}

impl<R: Real> Kernel for Scatter<'_, '_, R> {
    #[inline(always)]
    fn run<I: Isa>(self) {
        let Self { level, l, tile, to } = self;
        let (lanes, from) = (tile.lanes, tile.lanes - tile.central);
        let strides = level.strides();
        let reach = Reach::<R, I>::new(level, to);
        let mut rows = [[R::ZERO; 4 * VECTOR]; 4];
        for start in (0..lanes).step_by(VECTOR) {
            let eikonal = tile.has_eikonal && start >= from;
            let cells = level.locate::<R, I>(&tile.pos, lanes, start);
            let mut bits = if eikonal { u32::MAX >> (32 - VECTOR) } else { nonzero::<R, I>(tile, l, start) };
            let (all, some) = reach.of(&cells);
            bits &= some;
            if bits == 0 {
                continue;
            }
            if eikonal {
                gradients::<R, I, true>(level, l, tile, start, &cells, &mut rows);
            } else {
                gradients::<R, I, false>(level, l, tile, start, &cells, &mut rows);
            }
            while bits != 0 {
                let p = bits.trailing_zeros() as usize;
                if all >> p & 1 == 1 {
                    to.add_rows(cells.base[p] as usize - FEATURES * to.first, strides, &rows, p);
                } else {
                    add_single(level, &cells, p, &rows, to);
                }
                bits &= bits - 1;
            }
        }
    }
}

/// Which points of a vector have a gradient.
#[inline(always)]
fn nonzero<R: Real, I: Isa>(tile: &TileGradient<R>, l: usize, start: usize) -> u32 {
    let zero = <R::V<I>>::splat(R::ZERO);
    let mut bits = 0;
    for p in (0..VECTOR).step_by(<R::V<I>>::N) {
        for f in 0..FEATURES {
            let value = <R::V<I>>::load(&tile.enc, (FEATURES * l + f) * tile.lanes + start + p);
            bits |= (value.less(zero) | zero.less(value)) << p;
        }
    }
    bits
}

/// Which cells of a lattice have all or some of a part's vertices, by where they start in the table. All these places are
/// even and at most 2^25, hence exact.
struct Reach<R: Real, I: Isa> {
    hashed: bool,
    first: R::V<I>,
    end: R::V<I>,
    /// How far a cell's features reach.
    cell: R::V<I>,
}

impl<R: Real, I: Isa> Reach<R, I> {
    #[inline(always)]
    fn new(level: &Level, part: &Vertices<'_, R>) -> Self {
        let (first, cell) = (FEATURES * part.first, FEATURES * (level.strides()[3] + 2));
        Self {
            hashed: level.hash_mask.is_some(),
            first: <R::V<I>>::splat(R::of_int(first as i32)),
            end: <R::V<I>>::splat(R::of_int((first + part.grad.len()) as i32)),
            cell: <R::V<I>>::splat(R::of_int(cell as i32)),
        }
    }

    /// A bit per cell for all of its vertices, and one for some.
    #[inline(always)]
    fn of(&self, cells: &Cells<R>) -> (u32, u32) {
        if self.hashed {
            return (0, !0);
        }
        let (mut not_all, mut some) = (0, 0);
        for p in (0..VECTOR).step_by(<R::V<I>>::N) {
            let from = <R::V<I>>::load(&cells.start, p);
            let to = from.add(self.cell);
            not_all |= (from.less(self.first) | self.end.less(to)) << p;
            some |= (from.less(self.end) & self.first.less(to)) << p;
        }
        (!not_all, some)
    }
}

/// Adds the gradients of a point of which not all vertices are in one part of the lattice, or in rows.
#[inline(always)]
fn add_single<R: Real>(
    level: &Level,
    cells: &Cells<R>,
    p: usize,
    rows: &[[R; 4 * VECTOR]; 4],
    to: &mut Vertices<'_, R>,
) {
    let mut vertices = [[0; 2]; 4];
    match level.hash_mask {
        Some(mask) => vertices = level.hashed(mask, cells, p),
        None => {
            for (vertex, stride) in vertices.iter_mut().zip(level.strides()) {
                let at = cells.base[p] as usize / FEATURES + stride;
                *vertex = [at, at + 1];
            }
        }
    }
    for (row, [a, b]) in rows.iter().zip(vertices) {
        to.add(a, &row[4 * p..4 * p + 2]);
        to.add(b, &row[4 * p + 2..4 * p + 4]);
    }
}

/// What the vertices around a vector of points get: `rows[row][point * 4 + i]` with i for the features of a row's two
/// vertices. By the features' gradients, and if `SLOPE` by those of their derivatives, `v[feature] * gamma[axis]`.
#[inline(always)]
fn gradients<R: Real, I: Isa, const SLOPE: bool>(
    level: &Level,
    l: usize,
    tile: &TileGradient<R>,
    start: usize,
    cells: &Cells<R>,
    rows: &mut [[R; 4 * VECTOR]; 4],
) {
    let (lanes, row) = (tile.lanes, FEATURES * l);
    let one = <R::V<I>>::splat(R::ONE);
    for p in (0..VECTOR).step_by(<R::V<I>>::N) {
        let value = [
            <R::V<I>>::load(&tile.enc, row * lanes + start + p),
            <R::V<I>>::load(&tile.enc, (row + 1) * lanes + start + p),
        ];
        let fx = <R::V<I>>::load(&cells.frac[0], p);
        let fy = <R::V<I>>::load(&cells.frac[1], p);
        let fz = <R::V<I>>::load(&cells.frac[2], p);
        let (gx, gy, gz) = (one.sub(fx), one.sub(fy), one.sub(fz));
        let mut flat = [gx.mul(value[0]), gx.mul(value[1]), fx.mul(value[0]), fx.mul(value[1])];
        let (mut by_y, mut by_z) = (flat, flat);
        if SLOPE {
            let (m, c) = (tile.central, start + p + tile.central - lanes);
            let scale = <R::V<I>>::splat(R::of(level.scale));
            let x = <R::V<I>>::load(&tile.gamma, c).mul(scale);
            let y = <R::V<I>>::load(&tile.gamma, m + c).mul(scale);
            let z = <R::V<I>>::load(&tile.gamma, 2 * m + c).mul(scale);
            let v0 = <R::V<I>>::load(&tile.v, row * m + c);
            let v1 = <R::V<I>>::load(&tile.v, (row + 1) * m + c);
            flat = [flat[0].sub(x.mul(v0)), flat[1].sub(x.mul(v1)), x.madd(v0, flat[2]), x.madd(v1, flat[3])];
            let along = [gx.mul(v0), gx.mul(v1), fx.mul(v0), fx.mul(v1)];
            by_y = [along[0].mul(y), along[1].mul(y), along[2].mul(y), along[3].mul(y)];
            by_z = [along[0].mul(z), along[1].mul(z), along[2].mul(z), along[3].mul(z)];
            by_y = Lanes::transpose_quads(by_y);
            by_z = Lanes::transpose_quads(by_z);
        }
        let flat = Lanes::transpose_quads(flat);
        let weights = [gy.mul(gz), fy.mul(gz), gy.mul(fz), fy.mul(fz)];
        for place in 0..4 {
            for (i, row) in rows.iter_mut().enumerate() {
                let mut add = weights[i].splat_in_quads(place).mul(flat[place]);
                if SLOPE {
                    let y = if i & 2 == 2 { fz } else { gz }.splat_in_quads(place).mul(by_y[place]);
                    let z = if i & 1 == 1 { fy } else { gy }.splat_in_quads(place).mul(by_z[place]);
                    add = if i & 1 == 1 { add.add(y) } else { add.sub(y) };
                    add = if i & 2 == 2 { add.add(z) } else { add.sub(z) };
                }
                add.store_quads(&mut row[4 * p..], place, 4);
            }
        }
    }
}
