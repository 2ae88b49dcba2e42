//! From the gradients of a tile's encoding to those of a lattice's vertices.

use crate::grid::{Cells, FEATURES, GROUP, Level};
use crate::lanes::Lanes;
use crate::real::{Isa, Kernel, Real};
use crate::tile::{RAYS, TileGradient, VECTOR};

/// Numbers of a cell: four rows along x (see [`Level::strides`]) with the features of two vertices each.
const CELL: usize = 4 * 2 * FEATURES;

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
}

/// Adds a tile's gradients to vertices of the lattice number `l`.
///
/// Neighbouring samples of a ray often lie in the same cell: their gradients are added up before they go to memory.
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
        let (reach, dense) = (Reach::<R, I>::new(level, to), level.hash_mask.is_none());
        let mut points = Points::new();
        let mut runs = [Run { start: None, cell: [0; 3], sums: [R::ZERO; CELL] }; RAYS];
        for start in (0..lanes).step_by(VECTOR) {
            let eikonal = tile.has_eikonal && start >= from;
            let mut bits = if eikonal { u32::MAX >> (32 - VECTOR) } else { nonzero::<R, I>(tile, l, start) };
            if bits == 0 {
                continue;
            }
            let cells = level.locate::<R, I>(&tile.pos, lanes, start);
            bits &= if dense { reach.some(&cells) } else { !0 };
            if bits == 0 {
                continue;
            }
            if eikonal {
                points.fill::<I, true>(level, l, tile, start, &cells);
            } else {
                points.fill::<I, false>(level, l, tile, start, &cells);
            }
            while bits != 0 {
                let p = bits.trailing_zeros() as usize;
                bits &= bits - 1;
                let run = &mut runs[p % RAYS];
                if !dense || run.start != Some(cells.base[p]) {
                    run.flush(level, to);
                    *run = Run { start: Some(cells.base[p]), cell: cells.cell(p), sums: [R::ZERO; CELL] };
                }
                if eikonal {
                    points.add::<I, true>(p, &mut run.sums);
                } else {
                    points.add::<I, false>(p, &mut run.sums);
                }
            }
        }
        for run in &mut runs {
            run.flush(level, to);
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

/// Which cells of a dense lattice have some of a part's vertices, by where they start in the table. All these places are
/// at most 2^25 and even, hence exact.
struct Reach<R: Real, I: Isa> {
    first: R::V<I>,
    end: R::V<I>,
    /// How far a cell's features reach.
    cell: R::V<I>,
}

impl<R: Real, I: Isa> Reach<R, I> {
    #[inline(always)]
    fn new(level: &Level, part: &Vertices<'_, R>) -> Self {
        let first = FEATURES * part.first;
        Self {
            first: <R::V<I>>::splat(R::of_int(first as i32)),
            end: <R::V<I>>::splat(R::of_int((first + part.grad.len()) as i32)),
            cell: <R::V<I>>::splat(R::of_int(level.reach() as i32)),
        }
    }

    /// A bit per cell.
    #[inline(always)]
    fn some(&self, cells: &Cells<R>) -> u32 {
        let mut some = 0;
        for p in (0..VECTOR).step_by(<R::V<I>>::N) {
            let from = <R::V<I>>::load(&cells.start, p);
            some |= (from.less(self.end) & self.first.less(from.add(self.cell))) << p;
        }
        some
    }
}

/// The gradients of a cell's vertices, from samples of one ray.
#[derive(Clone, Copy)]
struct Run<R> {
    /// Where the cell's features start in the table of a dense lattice; `None` before the first sample.
    start: Option<u32>,
    /// The cell, in a hashed lattice.
    cell: [u32; 3],
    sums: [R; CELL],
}

impl<R: Real> Run<R> {
    /// Adds them to the vertices.
    #[inline(always)]
    fn flush(&self, level: &Level, to: &mut Vertices<'_, R>) {
        let Some(start) = self.start else { return };
        let (start, first) = (start as usize, FEATURES * to.first);
        let whole = start >= first && start + level.reach() <= first + to.grad.len();
        let mut vertices = [[0; 2]; 4];
        match level.hash_mask {
            None if whole => {
                for (row, stride) in level.strides().into_iter().enumerate() {
                    let at = start - first + FEATURES * stride;
                    let add = <R::Quad>::load(&self.sums, 2 * FEATURES * row);
                    <R::Quad>::load(to.grad, at).add(add).store(to.grad, at);
                    to.touched[at / (GROUP * FEATURES)] = 1;
                    to.touched[(at + FEATURES) / (GROUP * FEATURES)] = 1;
                }
                return;
            }
            None => {
                for (vertex, stride) in vertices.iter_mut().zip(level.strides()) {
                    let at = start / FEATURES + stride;
                    *vertex = [at, at + 1];
                }
            }
            Some(mask) => vertices = level.hashed(mask, self.cell),
        }
        for (add, vertex) in self.sums.chunks_exact(FEATURES).zip(vertices.as_flattened()) {
            to.add(*vertex, add);
        }
    }
}

/// Gradients around a vector of points as products: of what each row of a cell gets with what each number in it gets,
/// `[point][row or number]`.
struct Points<R> {
    rows: [R; 4 * VECTOR],
    numbers: [R; 4 * VECTOR],
    /// Of the derivatives by y and z, which are products of others.
    slope_rows: [[R; 4 * VECTOR]; 2],
    slope_numbers: [[R; 4 * VECTOR]; 2],
}

impl<R: Real> Points<R> {
    fn new() -> Self {
        let zeros = [R::ZERO; 4 * VECTOR];
        Self { rows: zeros, numbers: zeros, slope_rows: [zeros; 2], slope_numbers: [zeros; 2] }
    }

    /// By the features' gradients, and if `SLOPE` by those of their derivatives, `v[feature] * gamma[axis]`.
    #[inline(always)]
    fn fill<I: Isa, const SLOPE: bool>(
        &mut self,
        level: &Level,
        l: usize,
        tile: &TileGradient<R>,
        start: usize,
        cells: &Cells<R>,
    ) {
        let (lanes, row) = (tile.lanes, FEATURES * l);
        let (zero, one) = (<R::V<I>>::splat(R::ZERO), <R::V<I>>::splat(R::ONE));
        for p in (0..VECTOR).step_by(<R::V<I>>::N) {
            let v0 = <R::V<I>>::load(&tile.enc, row * lanes + start + p);
            let v1 = <R::V<I>>::load(&tile.enc, (row + 1) * lanes + start + p);
            let fx = <R::V<I>>::load(&cells.frac[0], p);
            let fy = <R::V<I>>::load(&cells.frac[1], p);
            let fz = <R::V<I>>::load(&cells.frac[2], p);
            let (gx, gy, gz) = (one.sub(fx), one.sub(fy), one.sub(fz));
            let mut numbers = [gx.mul(v0), gx.mul(v1), fx.mul(v0), fx.mul(v1)];
            if SLOPE {
                let (m, c) = (tile.central, start + p + tile.central - lanes);
                let scale = <R::V<I>>::splat(R::of(level.scale));
                let x = <R::V<I>>::load(&tile.gamma, c).mul(scale);
                let y = <R::V<I>>::load(&tile.gamma, m + c).mul(scale);
                let z = <R::V<I>>::load(&tile.gamma, 2 * m + c).mul(scale);
                let v0 = <R::V<I>>::load(&tile.v, row * m + c);
                let v1 = <R::V<I>>::load(&tile.v, (row + 1) * m + c);
                numbers[0] = numbers[0].sub(x.mul(v0));
                numbers[1] = numbers[1].sub(x.mul(v1));
                numbers[2] = x.madd(v0, numbers[2]);
                numbers[3] = x.madd(v1, numbers[3]);
                let along = [gx.mul(v0), gx.mul(v1), fx.mul(v0), fx.mul(v1)];
                let (mut by_y, mut by_z) = (along, along);
                for i in 0..4 {
                    by_y[i] = along[i].mul(y);
                    by_z[i] = along[i].mul(z);
                }
                let [y_rows, z_rows] = &mut self.slope_rows;
                let [y_numbers, z_numbers] = &mut self.slope_numbers;
                by_point([zero.sub(gz), gz, zero.sub(fz), fz], y_rows, p);
                by_point(by_y, y_numbers, p);
                by_point([zero.sub(gy), zero.sub(fy), gy, fy], z_rows, p);
                by_point(by_z, z_numbers, p);
            }
            by_point([gy.mul(gz), fy.mul(gz), gy.mul(fz), fy.mul(fz)], &mut self.rows, p);
            by_point(numbers, &mut self.numbers, p);
        }
    }

    /// Adds a point's gradients.
    #[inline(always)]
    fn add<I: Isa, const SLOPE: bool>(&self, p: usize, sums: &mut [R; CELL]) {
        for v in (0..CELL).step_by(<R::V<I>>::N) {
            let row = 4 * p + v / 4;
            let mut sum = <R::V<I>>::load(sums, v);
            let numbers = <R::V<I>>::repeat(&self.numbers, 4 * p);
            sum = <R::V<I>>::spread(&self.rows, row).madd(numbers, sum);
            if SLOPE {
                for (rows, numbers) in self.slope_rows.iter().zip(&self.slope_numbers) {
                    let numbers = <R::V<I>>::repeat(numbers, 4 * p);
                    sum = <R::V<I>>::spread(rows, row).madd(numbers, sum);
                }
            }
            sum.store(sums, v);
        }
    }
}

/// Writes four numbers for each point of a vector next to each other.
#[inline(always)]
fn by_point<R: Real, V: Lanes<R>>(v: [V; 4], to: &mut [R; 4 * VECTOR], p: usize) {
    for (place, quad) in V::transpose_quads(v).into_iter().enumerate() {
        quad.store_quads(&mut to[4 * p..], place, 4);
    }
}
