//! The samples without colour: forward and backward in one go, panel by panel, while the panel is in the first-level cache.
//!
//! With m the active units (1 or 0) and w2 their weights in the distance s, `ds/denc = W1^T (m w2)`, and all that the
//! weights' gradients need of the samples is `Q = sum m (dL/ds [enc, 1])^T`, as for the eikonal term; see
//! [`finish_masked`](crate::eikonal::finish_masked). So neither the hidden layer nor its gradient is kept.

use crate::clock::Stage;
use crate::gemm::{Add, Columns, Pairs, Target, load_row, product, store_row, to_pairs};
use crate::lanes::Lanes;
use crate::pass::{sdf_losses, through_jacobian};
use crate::real::{Isa, Real};
use crate::tile::{Model, PANEL, Panel, Scratch, Tile, TileGradient, VECTOR};

/// Losses of an encoded panel, with the gradients of its encoding and by position, and what the weights' need. The panel's
/// gradients are set to zero where no sample of it has one. `slope_weights` must have run.
#[inline(always)]
pub(crate) fn free_panel<R: Real, I: Isa>(
    model: &Model<'_, R>,
    tile: &Tile<R>,
    panel: Panel,
    s: &mut Scratch<R>,
    out: &mut TileGradient<R>,
) {
    let n = model.networks;
    let (e, h, width) = (n.encoding(), n.hidden(), panel.width);
    active_units::<R, I>(model, panel, s);
    if !sdf_losses::<R, I>(tile, panel, s, &mut out.losses) {
        for row in out.enc.chunks_exact_mut(tile.lanes) {
            row[panel.lanes(0, 1)].fill(R::ZERO);
        }
        for row in s.d_pos.chunks_exact_mut(tile.lanes) {
            row[panel.lanes(0, 1)].fill(R::ZERO);
        }
        return;
    }
    s.clock.count(Stage::Geometry, width);
    let d_sdf = &s.d_sdf[panel.lanes(0, 1)];
    product::<R, I>(
        (e, width, h),
        Columns(&s.slope_weights, e),
        (&s.panel.active, PANEL),
        &mut Scaled { scale: d_sdf, c: &mut out.enc[panel.start..], ld: tile.lanes },
    );
    through_jacobian::<R, I>(
        (&s.jac[panel.of(3 * e)], width),
        model.grid.width(),
        (&out.enc[panel.start..], tile.lanes),
        (&mut s.d_pos[panel.start..], tile.lanes),
    );
    scale_rows::<R, I>(&s.enc[panel.of(e)], d_sdf, &mut s.panel.columns);
    to_pairs::<R, I>((&s.panel.columns, PANEL), (e, width), &mut s.panel.rows);
    product::<R, I>(
        (h, 2 * e, width / 2),
        Pairs::<R, PANEL>(&s.panel.active),
        (&s.panel.rows, 2 * e),
        &mut Add { c: &mut s.sums.masked, ld: 2 * e },
    );
    add_products::<R, I>(&s.panel.active, d_sdf, &mut s.sums.masked_bias);
}

/// A panel's active units, 1 or 0, and its distances.
#[inline(always)]
pub(crate) fn active_units<R: Real, I: Isa>(model: &Model<'_, R>, panel: Panel, s: &mut Scratch<R>) {
    let n = model.networks;
    let ([first, last], (flipped, _)) = (n.geometry, n.flipped());
    let (e, h) = (first.inputs, first.outputs);
    let sdf = &mut s.sdf[panel.lanes(0, 1)];
    sdf.fill(model.weights[last.bias().start]);
    product::<R, I>(
        (h, panel.width, e),
        Columns(&model.flipped[flipped.hidden], h),
        (&s.enc[panel.of(e)], PANEL),
        &mut Active {
            bias: &model.weights[first.bias()],
            head: &model.weights[last.weights()][..h],
            active: &mut s.panel.active,
            sdf,
        },
    );
}

/// The hidden layer's active units, and what the layer adds to the distance.
struct Active<'a, R> {
    bias: &'a [R],
    head: &'a [R],
    active: &'a mut [R],
    sdf: &'a mut [R],
}

impl<R: Real> Target<R> for Active<'_, R> {
    #[inline(always)]
    fn start<V: Lanes<R>, const N: usize>(&self, (i, _): (usize, usize)) -> [V; N] {
        [V::splat(self.bias[i]); N]
    }

    #[inline(always)]
    fn finish<V: Lanes<R>, const N: usize>(&mut self, (i, j): (usize, usize), sums: &[[V; N]]) {
        let one = V::splat(R::ONE);
        let head = &self.head[i..][..sums.len()];
        // Two chains of additions: one alone would be waited for.
        let mut sdf: [[V; N]; 2] = [load_row(self.sdf, j), [V::splat(R::ZERO); N]];
        for (r, sums) in sums.iter().enumerate() {
            let head = V::splat(head[r]);
            for v in 0..N {
                sdf[r % 2][v] = head.madd(sums[v].positive(), sdf[r % 2][v]);
            }
        }
        for v in 0..N {
            sdf[0][v] = sdf[0][v].add(sdf[1][v]);
        }
        store_row(&sdf[0], self.sdf, j);
        let active = &mut self.active[i * PANEL..][..sums.len() * PANEL];
        for (sums, active) in sums.iter().zip(active.chunks_exact_mut(PANEL)) {
            let mut m = *sums;
            for m in &mut m {
                *m = m.gate(one);
            }
            store_row(&m, active, j);
        }
    }
}

/// `C = A * B` times a number for each column, with row stride `ld`.
struct Scaled<'a, R> {
    scale: &'a [R],
    c: &'a mut [R],
    ld: usize,
}

impl<R: Real> Target<R> for Scaled<'_, R> {
    #[inline(always)]
    fn start<V: Lanes<R>, const N: usize>(&self, _: (usize, usize)) -> [V; N] {
        [V::splat(R::ZERO); N]
    }

    #[inline(always)]
    fn finish<V: Lanes<R>, const N: usize>(&mut self, (i, j): (usize, usize), sums: &[[V; N]]) {
        let scale: [V; N] = load_row(self.scale, j);
        for (r, sums) in sums.iter().enumerate() {
            let mut y = *sums;
            for v in 0..N {
                y[v] = y[v].mul(scale[v]);
            }
            store_row(&y, self.c, (i + r) * self.ld + j);
        }
    }
}

/// Multiplies a panel's rows with `scale`, number by number.
#[inline(always)]
fn scale_rows<R: Real, I: Isa>(x: &[R], scale: &[R], out: &mut [R]) {
    for (x, out) in x.chunks_exact(PANEL).zip(out.chunks_exact_mut(PANEL)) {
        for p in (0..scale.len()).step_by(<R::V<I>>::N) {
            <R::V<I>>::load(x, p).mul(<R::V<I>>::load(scale, p)).store(out, p);
        }
    }
}

/// Adds each row's products with `y`, number by number, to [`VECTOR`] partial sums.
#[inline(always)]
pub(crate) fn add_products<R: Real, I: Isa>(x: &[R], y: &[R], sums: &mut [R]) {
    for (x, sums) in x.chunks_exact(PANEL).zip(sums.chunks_exact_mut(VECTOR)) {
        for p in (0..VECTOR).step_by(<R::V<I>>::N) {
            let mut sum = <R::V<I>>::load(sums, p);
            for from in (p..y.len()).step_by(VECTOR) {
                sum = <R::V<I>>::load(x, from).madd(<R::V<I>>::load(y, from), sum);
            }
            sum.store(sums, p);
        }
    }
}

/// Adds each row's numbers to [`VECTOR`] partial sums.
#[inline(always)]
pub(crate) fn add_rows<R: Real, I: Isa>(x: &[R], width: usize, sums: &mut [R]) {
    for (x, sums) in x.chunks_exact(PANEL).zip(sums.chunks_exact_mut(VECTOR)) {
        for p in (0..VECTOR).step_by(<R::V<I>>::N) {
            let mut sum = <R::V<I>>::load(sums, p);
            for from in (p..width).step_by(VECTOR) {
                sum = sum.add(<R::V<I>>::load(x, from));
            }
            sum.store(sums, p);
        }
    }
}
