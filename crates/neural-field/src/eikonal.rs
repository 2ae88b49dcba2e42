//! The eikonal term on a tile's central lanes, with exact second derivatives.

use crate::gemm::{Add, Columns, Pairs, Store, product, sum, to_pairs};
use crate::grid::FEATURES;
use crate::lanes::Lanes;
use crate::pass::through_jacobian;
use crate::real::{Isa, Real};
use crate::tile::{Model, PANEL, Panel, Scratch, Tile, TileGradient, TileSums, VECTOR, loss};

/// `w (|grad s| - 1)^2` on the central lanes, with its exact gradient.
///
/// The slope of the distance is `g_i = sum_f v_f de_f/dp_i` with `v = W1^T (m w2)`, m the active units. With
/// `gamma = dL/dg`, the gradient by `v` is the derivative `q` of the encoding along `gamma`, that by `de_f/dp_i` is
/// `v_f gamma_i`. What both layers' gradients need of all samples is `Q = sum m q^T`; see [`finish_masked`].
#[inline(always)]
pub(crate) fn eikonal_pass<R: Real, I: Isa>(
    model: &Model<'_, R>,
    tile: &Tile<R>,
    s: &mut Scratch<R>,
    out: &mut TileGradient<R>,
) {
    let (n, from) = (model.networks, tile.lanes - tile.central);
    let (h, e) = (n.hidden(), n.encoding());
    for panel in Panel::central(tile.lanes, tile.central) {
        slope_factors::<R, I>(model, panel, from, s, (&mut out.v[panel.start - from..], tile.central));
        along_slope::<R, I>(model, tile, panel, s, out);
        product::<R, I>(
            (h, 2 * e, panel.width / 2),
            Pairs::<R, PANEL>(&s.panel.active),
            (&s.panel.rows, 2 * e),
            &mut Add { c: &mut s.sums.masked, ld: 2 * e },
        );
    }
    eikonal_position::<R, I>(model, tile, s, out);
}

/// The first layer with its units' weights in the distance: `w2[unit] * W1[unit][encoding]`.
#[inline(always)]
pub(crate) fn slope_weights<R: Real>(model: &Model<'_, R>, to: &mut [R]) {
    let [first, last] = model.networks.geometry;
    let rows = model.weights[first.weights()].chunks_exact(first.inputs);
    for ((to, row), w2) in to.chunks_exact_mut(first.inputs).zip(rows).zip(&model.weights[last.weights()]) {
        for (to, w1) in to.iter_mut().zip(row) {
            *to = *w2 * *w1;
        }
    }
}

/// Gradient of a panel's distances by their encoding, to `v[feature * stride + lane]`, and the active units;
/// [`slope_weights`] must have run.
#[inline(always)]
pub(crate) fn slope_factors<R: Real, I: Isa>(
    model: &Model<'_, R>,
    panel: Panel,
    from: usize,
    s: &mut Scratch<R>,
    (v, stride): (&mut [R], usize),
) {
    let (h, e) = (model.networks.hidden(), model.networks.encoding());
    for (m, y) in s.panel.active.iter_mut().zip(&s.hidden[panel.among_central(from, h)]) {
        *m = y.gate(R::ONE);
    }
    product::<R, I>(
        (e, panel.width, h),
        Columns(&s.slope_weights, e),
        (&s.panel.active, PANEL),
        &mut Store { c: v, ld: stride },
    );
}

/// Losses of a panel, their gradient by the slopes, and the encoding's derivative along that.
#[inline(always)]
fn along_slope<R: Real, I: Isa>(
    model: &Model<'_, R>,
    tile: &Tile<R>,
    panel: Panel,
    s: &mut Scratch<R>,
    out: &mut TileGradient<R>,
) {
    let (e, features, width) = (model.networks.encoding(), model.grid.width(), panel.width);
    let (central, at) = (tile.central, panel.start + tile.central - tile.lanes);
    let jac = &s.jac[panel.of(3 * e)];
    let gamma = &mut s.panel.slope;
    through_jacobian::<R, I>((jac, width), features, (&out.v[at..], central), (gamma, PANEL));
    let k = <R::V<I>>::splat(model.truncation);
    let [zero, one, two] = [0.0, 1.0, 2.0].map(|v| <R::V<I>>::splat(R::of(v)));
    let mut total = zero;
    for start in (0..width).step_by(<R::V<I>>::N) {
        let w = <R::V<I>>::load(&tile.w_eikonal, at + start);
        let (x, y) = (<R::V<I>>::load(gamma, start), <R::V<I>>::load(gamma, PANEL + start));
        let z = <R::V<I>>::load(gamma, 2 * PANEL + start);
        let square = x.mul(x).add(y.mul(y)).add(z.mul(z));
        let norm = square.sqrt();
        let error = k.mul(norm).sub(one);
        total = w.mul(error).madd(error, total);
        // Zero where there is no slope.
        let scale = square.gate(two.mul(w).mul(error).mul(k).div(norm));
        for (a, slope) in [x, y, z].into_iter().enumerate() {
            let g = scale.mul(slope);
            g.store(gamma, a * PANEL + start);
            g.store(&mut out.gamma, a * central + at + start);
        }
        for f in 0..features {
            let mut q = zero;
            for a in 0..3 {
                let g = <R::V<I>>::load(gamma, a * PANEL + start);
                q = g.madd(<R::V<I>>::load(jac, (f * 3 + a) * PANEL + start), q);
            }
            q.store(&mut s.panel.columns, f * PANEL + start);
        }
    }
    out.losses[loss::EIKONAL] += total.total();
    // What is beside the features must be zero.
    s.panel.columns[features * PANEL..].fill(R::ZERO);
    to_pairs::<R, I>((&s.panel.columns, PANEL), (e, width), &mut s.panel.rows);
}

/// Weight gradients from `Q[unit][encoding]`: `w2 Q` row by row for W1, for w2 the products of the rows of W1 and Q; with
/// the bias as one more weight.
#[inline(always)]
pub(crate) fn finish_masked<R: Real>(model: &Model<'_, R>, sums: &TileSums<R>, grad: &mut [R]) {
    let [first, last] = model.networks.geometry;
    let e = first.inputs;
    let (w1, b1) = (&model.weights[first.weights()], &model.weights[first.bias()]);
    let w2 = &model.weights[last.weights()];
    let bias_sums = sums.masked_bias.chunks_exact(VECTOR);
    for (j, (q, bias)) in sums.masked.chunks_exact(2 * e).zip(bias_sums).enumerate() {
        let (row, bias) = (e * j..e * (j + 1), sum(bias));
        let mut by_w2 = b1[j] * bias;
        for ((g, w), q) in grad[first.weights()][row.clone()].iter_mut().zip(&w1[row]).zip(q.chunks_exact(2))
        {
            let q = q[0] + q[1];
            *g += w2[j] * q;
            by_w2 += *w * q;
        }
        grad[first.bias()][j] += w2[j] * bias;
        grad[last.weights()][j] += by_w2;
    }
}

/// The eikonal term's gradient by position: mixed second derivatives of the trilinear encoding.
#[inline(always)]
fn eikonal_position<R: Real, I: Isa>(
    model: &Model<'_, R>,
    tile: &Tile<R>,
    s: &mut Scratch<R>,
    out: &TileGradient<R>,
) {
    let (lanes, central) = (tile.lanes, tile.central);
    let mut mixed = [R::ZERO; 3 * FEATURES * VECTOR];
    for start in (0..central).step_by(VECTOR) {
        let lane = lanes - central + start;
        for (l, (level, table)) in model.grid.levels.iter().zip(&model.grid.tables).enumerate() {
            level.mixed::<R, I>(table, &level.locate::<R, I>(&out.pos, lanes, lane), &mut mixed);
            for p in (0..VECTOR).step_by(<R::V<I>>::N) {
                let gx = <R::V<I>>::load(&out.gamma, start + p);
                let gy = <R::V<I>>::load(&out.gamma, central + start + p);
                let gz = <R::V<I>>::load(&out.gamma, 2 * central + start + p);
                for f in 0..FEATURES {
                    let v = <R::V<I>>::load(&out.v, (FEATURES * l + f) * central + start + p);
                    let xy = <R::V<I>>::load(&mixed, 3 * f * VECTOR + p);
                    let xz = <R::V<I>>::load(&mixed, (3 * f + 1) * VECTOR + p);
                    let yz = <R::V<I>>::load(&mixed, (3 * f + 2) * VECTOR + p);
                    let add =
                        [gy.mul(xy).add(gz.mul(xz)), gx.mul(xy).add(gz.mul(yz)), gx.mul(xz).add(gy.mul(yz))];
                    for (a, add) in add.into_iter().enumerate() {
                        let at = a * lanes + lane + p;
                        v.madd(add, <R::V<I>>::load(&s.d_pos, at)).store(&mut s.d_pos, at);
                    }
                }
            }
        }
    }
}
