//! The colour network on a tile's central lanes, its loss and its gradients.

use crate::gemm::gemm_add;
use crate::harmonics::{self, harmonics};
use crate::mlp::Networks;
use crate::pass::{cross, layer_backward, layer_forward, mask};
use crate::real::Real;
use crate::tile::{Model, RAYS, Scratch, Tile, TileGradient, loss};

/// Colour network on the central lanes: blends each ray's colours, and leaves the gradient by the geometry
/// features in `d_color_in` and that by the view direction in the ray's twist.
#[inline(always)]
pub(crate) fn color_pass<R: Real, const FMA: bool>(
    model: &Model<'_, R>,
    tile: &Tile<R>,
    dir: &[[R; 3]; RAYS],
    s: &mut Scratch<R>,
    out: &mut TileGradient<R>,
    grad: &mut [R],
) {
    let (n, lanes, w) = (model.networks, tile.central, model.weights);
    let first = tile.lanes - lanes;
    let (last, features) = (n.geometry[1], n.features);
    for (row, b) in s.color_in.chunks_exact_mut(lanes).zip(&w[last.bias()][1..]) {
        row.fill(*b);
    }
    gemm_add::<R, FMA, false>(
        (features, lanes, last.inputs),
        (&w[last.weights()][last.inputs..], last.inputs),
        (&s.hidden[first..], tile.lanes),
        (&mut s.color_in, lanes),
    );
    let bands: [_; RAYS] = std::array::from_fn(|r| harmonics(dir[r]));
    for k in 0..harmonics::COUNT {
        for (l, v) in s.color_in[(features + k) * lanes..][..lanes].iter_mut().enumerate() {
            *v = bands[l % RAYS].0[k];
        }
    }
    for k in 0..n.codes.size {
        let code: [R; RAYS] = std::array::from_fn(|r| w[n.codes.of(tile.frame[r]).start + k]);
        for (l, v) in s.color_in[(features + harmonics::COUNT + k) * lanes..][..lanes].iter_mut().enumerate()
        {
            *v = code[l % RAYS];
        }
    }
    color_forward::<R, FMA>(n, w, lanes, s);
    color_loss(tile, s, &mut out.losses[loss::COLOR]);

    let [c0, c1, c2] = n.color;
    layer_backward::<R, FMA>(&c2, w, (&s.rgb, &s.color_b), &mut s.d_color_b, lanes, &mut s.transposed, grad);
    mask(&mut s.d_color_b, &s.color_b);
    layer_backward::<R, FMA>(
        &c1,
        w,
        (&s.d_color_b, &s.color_a),
        &mut s.d_color_a,
        lanes,
        &mut s.transposed,
        grad,
    );
    mask(&mut s.d_color_a, &s.color_a);
    layer_backward::<R, FMA>(
        &c0,
        w,
        (&s.d_color_a, &s.color_in),
        &mut s.d_color_in,
        lanes,
        &mut s.transposed,
        grad,
    );

    for r in 0..RAYS {
        let total = |input: usize| {
            let row = &s.d_color_in[(features + input) * lanes..][..lanes];
            row.iter().skip(r).step_by(RAYS).fold(R::ZERO, |a, v| a + *v)
        };
        let mut by_dir = [R::ZERO; 3];
        for k in 0..harmonics::COUNT {
            let total = total(k);
            for a in 0..3 {
                by_dir[a] += total * bands[r].1[k][a];
            }
        }
        for (k, g) in grad[n.codes.of(tile.frame[r])].iter_mut().enumerate() {
            *g += total(harmonics::COUNT + k);
        }
        let torque = cross(dir[r], by_dir);
        for a in 0..3 {
            out.twist[r][3 + a] += torque[a];
        }
    }
}

/// From `color_in` to `rgb` (after the sigmoid).
#[inline(always)]
pub(crate) fn color_forward<R: Real, const FMA: bool>(
    n: &Networks,
    w: &[R],
    lanes: usize,
    s: &mut Scratch<R>,
) {
    let [c0, c1, c2] = n.color;
    layer_forward::<R, FMA>(&c0, w, (&s.color_in, lanes), (&mut s.color_a, lanes), true);
    layer_forward::<R, FMA>(&c1, w, (&s.color_a, lanes), (&mut s.color_b, lanes), true);
    layer_forward::<R, FMA>(&c2, w, (&s.color_b, lanes), (&mut s.rgb, lanes), false);
    for v in &mut s.rgb[..3 * lanes] {
        *v = R::ONE / (R::ONE + (-*v).exp());
    }
}

/// Squared error of the blended colour; turns `rgb` into the gradient before the sigmoid.
#[inline(always)]
fn color_loss<R: Real>(tile: &Tile<R>, s: &mut Scratch<R>, total: &mut R) {
    let two = R::of(2.0);
    for (c, row) in s.rgb.chunks_exact_mut(tile.central).take(3).enumerate() {
        let mut error = [R::ZERO; RAYS];
        for (v, b) in row.chunks_exact(RAYS).zip(tile.bell.chunks_exact(RAYS)) {
            for r in 0..RAYS {
                error[r] += v[r] * b[r];
            }
        }
        for r in 0..RAYS {
            error[r] = error[r] - tile.color[r][c];
            *total += tile.w_color[r] * error[r] * error[r];
        }
        for (v, b) in row.chunks_exact_mut(RAYS).zip(tile.bell.chunks_exact(RAYS)) {
            for r in 0..RAYS {
                v[r] = two * tile.w_color[r] * error[r] * b[r] * v[r] * (R::ONE - v[r]);
            }
        }
    }
}
