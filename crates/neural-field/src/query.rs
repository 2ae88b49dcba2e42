//! Evaluation of a trained field at arbitrary points, in blocks of lanes.

use crate::color::color_forward;
use crate::gemm::gemm_add;
use crate::harmonics::{self, harmonics};
use crate::pass::{geometry_forward, position_gradient};
use crate::real::Real;
use crate::tile::{Model, Scratch};

/// Distances, and on request slopes (per edge of the cube), of `lanes` points in `pos[axis][lane]`.
#[inline(always)]
pub(crate) fn query<R: Real, const FMA: bool>(
    model: &Model<'_, R>,
    lanes: usize,
    pos: &[R],
    s: &mut Scratch<R>,
    slopes: bool,
) {
    geometry_forward::<R, FMA>(model, lanes, pos, s);
    if !slopes {
        return;
    }
    let [first, last] = model.networks.geometry;
    let w2 = &model.weights[last.weights()][..first.outputs];
    for ((m, y), w) in s.d_hidden.chunks_exact_mut(lanes).zip(s.hidden.chunks_exact(lanes)).zip(w2) {
        for (m, y) in m.iter_mut().zip(y) {
            *m = y.gate(*w);
        }
    }
    s.q[..first.inputs * lanes].fill(R::ZERO);
    let w1 = (&model.weights[first.weights()], first.inputs);
    gemm_add::<R, FMA, true>(
        (first.inputs, lanes, first.outputs),
        w1,
        (&s.d_hidden, lanes),
        (&mut s.q, lanes),
    );
    let v = std::mem::take(&mut s.q);
    position_gradient(lanes, model.grid.width(), s, &v);
    s.q = v;
}

/// Colours of `lanes` points seen along the unit directions `dirs[lane]`; [`query`] must have run on them.
#[inline(always)]
pub(crate) fn query_color<R: Real, const FMA: bool>(
    model: &Model<'_, R>,
    lanes: usize,
    dirs: &[[R; 3]],
    s: &mut Scratch<R>,
) {
    let (n, w) = (model.networks, model.weights);
    let last = n.geometry[1];
    for (row, b) in s.color_in.chunks_exact_mut(lanes).zip(&w[last.bias()][1..]) {
        row.fill(*b);
    }
    gemm_add::<R, FMA, false>(
        (n.features, lanes, last.inputs),
        (&w[last.weights()][last.inputs..], last.inputs),
        (&s.hidden, lanes),
        (&mut s.color_in, lanes),
    );
    for (l, d) in dirs.iter().take(lanes).enumerate() {
        for (k, v) in harmonics(*d).0.into_iter().enumerate() {
            s.color_in[(n.features + k) * lanes + l] = v;
        }
    }
    for (k, code) in w[n.codes.neutral()].iter().enumerate() {
        s.color_in[(n.features + harmonics::COUNT + k) * lanes..][..lanes].fill(*code);
    }
    color_forward::<R, FMA>(n, w, lanes, s);
}
