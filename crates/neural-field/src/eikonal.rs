//! The eikonal term on a tile's central lanes, with exact second derivatives.

use crate::gemm::{gemm_add, sum, transpose};
use crate::grid::FEATURES;
use crate::pass::mask;
use crate::real::Real;
use crate::tile::{Model, Scratch, Tile, TileGradient, loss};

/// `w (|grad s| - 1)^2` on the central lanes, with its exact gradient.
///
/// The slope of the distance is `g_i = sum_f v_f de_f/dp_i` with `v = W1^T (mask w2)`. With `gamma = dL/dg`, the
/// gradient by `v` is the derivative `q` of the encoding along `gamma`, that by `de_f/dp_i` is `v_f gamma_i`: one
/// forward and one backward product, not three, and no second derivative of the ReLU.
#[inline(always)]
pub(crate) fn eikonal_pass<R: Real, const FMA: bool>(
    model: &Model<'_, R>,
    tile: &Tile<R>,
    s: &mut Scratch<R>,
    out: &mut TileGradient<R>,
    grad: &mut [R],
) {
    let (n, lanes, central) = (model.networks, tile.lanes, tile.central);
    let from = lanes - central;
    let [first, last] = n.geometry;
    let (h, e, width) = (first.outputs, first.inputs, model.grid.width());
    let w1 = &model.weights[first.weights()];
    let w2 = &model.weights[last.weights()][..h];
    for (j, row) in s.masked.chunks_exact_mut(central).take(h).enumerate() {
        for (m, y) in row.iter_mut().zip(&s.hidden[j * lanes + from..][..central]) {
            *m = y.gate(w2[j]);
        }
    }
    out.v.fill(R::ZERO);
    gemm_add::<R, FMA, true>((e, central, h), (w1, e), (&s.masked, central), (&mut out.v, central));

    s.q.fill(R::ZERO);
    for l in 0..central {
        let slope: [R; 3] = std::array::from_fn(|a| {
            (0..width)
                .fold(R::ZERO, |acc, f| acc + out.v[f * central + l] * s.jac[(f * 3 + a) * lanes + from + l])
        });
        let norm = (slope[0] * slope[0] + slope[1] * slope[1] + slope[2] * slope[2]).sqrt();
        let k = model.truncation;
        let error = k * norm - R::ONE;
        out.losses[loss::EIKONAL] += tile.w_eikonal[l] * error * error;
        let scale = if norm > R::ZERO { R::of(2.0) * tile.w_eikonal[l] * error * k / norm } else { R::ZERO };
        for a in 0..3 {
            out.gamma[a * central + l] = scale * slope[a];
        }
        for f in 0..width {
            s.q[f * central + l] =
                (0..3).fold(R::ZERO, |acc, a| acc + scale * slope[a] * s.jac[(f * 3 + a) * lanes + from + l]);
        }
    }
    transpose(&s.q, central, e, central, &mut s.transposed);
    gemm_add::<R, FMA, false>(
        (h, e, central),
        (&s.masked, central),
        (&s.transposed, e),
        (&mut grad[first.weights()], e),
    );
    // u = W1 q, of which the active units belong to w2's gradient.
    s.d_hidden[..h * central].fill(R::ZERO);
    gemm_add::<R, FMA, false>((h, central, e), (w1, e), (&s.q, central), (&mut s.d_hidden, central));
    let g2 = &mut grad[last.weights()][..h];
    for (j, u) in s.d_hidden.chunks_exact_mut(central).take(h).enumerate() {
        let active = &s.hidden[j * lanes + from..][..central];
        mask(u, active);
        g2[j] += sum(u);
    }
    eikonal_position(model, tile, s, out);
}

/// The eikonal term's gradient by position: mixed second derivatives of the trilinear encoding.
#[inline(always)]
fn eikonal_position<R: Real>(
    model: &Model<'_, R>,
    tile: &Tile<R>,
    s: &mut Scratch<R>,
    out: &TileGradient<R>,
) {
    let (lanes, central) = (tile.lanes, tile.central);
    for (l, (level, table)) in model.grid.levels.iter().zip(&model.grid.tables).enumerate() {
        for c in 0..central {
            let lane = lanes - central + c;
            let p = [0, 1, 2].map(|a| out.pos[a * lanes + lane]);
            let g = [0, 1, 2].map(|a| out.gamma[a * central + c]);
            let mixed = level.mixed(table, p);
            for f in 0..FEATURES {
                let v = out.v[(FEATURES * l + f) * central + c];
                let [xy, xz, yz] = mixed[f];
                s.d_pos[lane] += v * (g[1] * xy + g[2] * xz);
                s.d_pos[lanes + lane] += v * (g[0] * xy + g[2] * yz);
                s.d_pos[2 * lanes + lane] += v * (g[0] * xz + g[1] * yz);
            }
        }
    }
}
