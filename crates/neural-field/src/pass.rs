//! Forward and backward pass over one tile, from positions to gradients, fused: nothing leaves the cache between.
//!
//! Generic over the scalar: `f32` trains, `f64` checks these very gradients.

use crate::clock::Stage;
use crate::color::color_pass;
use crate::eikonal::eikonal_pass;
use crate::gemm::{dot, gemm_add, sum, transpose};
use crate::mlp::Layer;
use crate::real::Real;
use crate::tile::{Model, RAYS, RayPose, Scratch, Tile, TileGradient, loss};

/// Forward and backward pass over one tile. Adds to `grad` (flat network weights), overwrites `out`.
#[inline(always)]
pub(crate) fn run_tile<R: Real, const FMA: bool>(
    model: &Model<'_, R>,
    poses: &[RayPose<R>],
    tile: &Tile<R>,
    scratch: &mut Scratch<R>,
    out: &mut TileGradient<R>,
    grad: &mut [R],
) {
    out.frame = tile.frame;
    out.has_eikonal = tile.has_eikonal;
    out.losses = [R::ZERO; loss::COUNT];
    out.twist = [[R::ZERO; 6]; RAYS];
    let (origin, dir) = object_rays(poses, tile);
    place(&origin, &dir, tile, &mut out.pos);
    geometry_forward::<R, FMA>(model, tile.lanes, &out.pos, scratch);
    sdf_losses(tile, scratch, &mut out.losses);
    if tile.has_color {
        scratch.clock.lap(Stage::Geometry);
        color_pass::<R, FMA>(model, tile, &dir, scratch, out, grad);
        scratch.clock.lap(Stage::Color);
    }
    geometry_backward::<R, FMA>(model, tile, scratch, out, grad);
    position_gradient(tile.lanes, model.grid.width(), scratch, &out.enc);
    if tile.has_eikonal {
        scratch.clock.lap(Stage::Backward);
        eikonal_pass::<R, FMA>(model, tile, scratch, out, grad);
        scratch.clock.lap(Stage::Eikonal);
    }
    pose_gradient(tile, scratch, out);
    scratch.clock.lap(Stage::Backward);
}

/// Ray origins and directions about the volume's centre, in edges.
#[inline(always)]
fn object_rays<R: Real>(poses: &[RayPose<R>], tile: &Tile<R>) -> ([[R; 3]; RAYS], [[R; 3]; RAYS]) {
    let mut origin = [[R::ZERO; 3]; RAYS];
    let mut dir = [[R::ZERO; 3]; RAYS];
    for r in 0..RAYS {
        let pose = &poses[tile.frame[r]];
        let d = tile.dir[r];
        origin[r] = pose.translation;
        dir[r] = pose.rotation.map(|row| row[0] * d[0] + row[1] * d[1] + row[2] * d[2]);
    }
    (origin, dir)
}

#[inline(always)]
fn place<R: Real>(origin: &[[R; 3]; RAYS], dir: &[[R; 3]; RAYS], tile: &Tile<R>, pos: &mut [R]) {
    for (a, row) in pos.chunks_exact_mut(tile.lanes).enumerate() {
        for (p4, t4) in row.chunks_exact_mut(RAYS).zip(tile.t.chunks_exact(RAYS)) {
            for r in 0..RAYS {
                p4[r] = R::of(0.5) + origin[r][a] + dir[r][a] * t4[r];
            }
        }
    }
}

/// Encoding, hidden layer and signed distance of `lanes` points.
#[inline(always)]
pub(crate) fn geometry_forward<R: Real, const FMA: bool>(
    model: &Model<'_, R>,
    lanes: usize,
    pos: &[R],
    s: &mut Scratch<R>,
) {
    let n = model.networks;
    s.clock.start();
    model.grid.encode(pos, lanes, &mut s.enc, &mut s.jac);
    // The padding must be zero, and a tile of another size may have left something there.
    s.enc[model.grid.width() * lanes..n.encoding() * lanes].fill(R::ZERO);
    s.clock.lap(Stage::Encode);
    layer_forward::<R, FMA>(&n.geometry[0], model.weights, (&s.enc, lanes), (&mut s.hidden, lanes), true);
    let [_, last] = n.geometry;
    s.sdf[..lanes].fill(model.weights[last.bias().start]);
    let row = &model.weights[last.weights()][..last.inputs];
    gemm_add::<R, FMA, false>(
        (1, lanes, last.inputs),
        (row, last.inputs),
        (&s.hidden, lanes),
        (&mut s.sdf, lanes),
    );
}

#[inline(always)]
pub(crate) fn layer_forward<R: Real, const FMA: bool>(
    layer: &Layer,
    weights: &[R],
    (x, ldx): (&[R], usize),
    (y, lanes): (&mut [R], usize),
    relu: bool,
) {
    for (row, b) in y.chunks_exact_mut(lanes).zip(&weights[layer.bias()]) {
        row.fill(*b);
    }
    let w = (&weights[layer.weights()], layer.inputs);
    gemm_add::<R, FMA, false>((layer.outputs, lanes, layer.inputs), w, (x, ldx), (&mut *y, lanes));
    if relu {
        for v in &mut y[..layer.outputs * lanes] {
            *v = v.positive();
        }
    }
}

/// Losses on the signed distance in truncation units: one-sided free space, L2 at the surface.
#[inline(always)]
fn sdf_losses<R: Real>(tile: &Tile<R>, s: &mut Scratch<R>, losses: &mut [R; loss::COUNT]) {
    let two = R::of(2.0);
    let mut sums = [R::ZERO; 3];
    for l in 0..tile.lanes {
        let sdf = s.sdf[l];
        let surface = sdf - tile.target[l];
        let below = (-surface).positive();
        sums[loss::UNCERTAIN] += tile.w_uncertain[l] * below * below;
        sums[loss::EMPTY] += tile.w_empty[l] * below;
        sums[loss::SURFACE] += tile.w_surface[l] * surface * surface;
        let step = if below > R::ZERO { tile.w_empty[l] } else { R::ZERO };
        s.d_sdf[l] = two * (tile.w_surface[l] * surface - tile.w_uncertain[l] * below) - step;
    }
    losses[..3].copy_from_slice(&sums);
}

/// Given the gradient `dy` of a layer's outputs and its input `x`: adds the weight and bias gradients, overwrites
/// `dx` with the gradient of the input.
#[inline(always)]
pub(crate) fn layer_backward<R: Real, const FMA: bool>(
    layer: &Layer,
    weights: &[R],
    (dy, x): (&[R], &[R]),
    dx: &mut [R],
    lanes: usize,
    transposed: &mut [R],
    grad: &mut [R],
) {
    let (m, k) = (layer.outputs, layer.inputs);
    transpose(x, lanes, k, lanes, transposed);
    gemm_add::<R, FMA, false>((m, k, lanes), (dy, lanes), (transposed, k), (&mut grad[layer.weights()], k));
    for (row, b) in dy.chunks_exact(lanes).zip(&mut grad[layer.bias()]) {
        *b += sum(row);
    }
    dx[..k * lanes].fill(R::ZERO);
    gemm_add::<R, FMA, true>((k, lanes, m), (&weights[layer.weights()], k), (dy, lanes), (dx, lanes));
}

/// Zeroes the gradient where the ReLU's output is zero.
#[inline(always)]
pub(crate) fn mask<R: Real>(d: &mut [R], y: &[R]) {
    for (d, y) in d.iter_mut().zip(y) {
        *d = y.gate(*d);
    }
}

#[inline(always)]
fn geometry_backward<R: Real, const FMA: bool>(
    model: &Model<'_, R>,
    tile: &Tile<R>,
    s: &mut Scratch<R>,
    out: &mut TileGradient<R>,
    grad: &mut [R],
) {
    let (n, lanes, central) = (model.networks, tile.lanes, tile.central);
    let [first, last] = n.geometry;
    let (k, from) = (last.inputs, lanes - central);
    let w_last = &model.weights[last.weights()];
    for ((dh, h), w) in s.d_hidden.chunks_exact_mut(lanes).zip(s.hidden.chunks_exact(lanes)).zip(&w_last[..k])
    {
        for ((d, h), ds) in dh.iter_mut().zip(h).zip(&s.d_sdf[..lanes]) {
            *d = h.gate(*w * *ds);
        }
    }
    let g_last = &mut grad[last.weights()];
    for (g, h) in g_last[..k].iter_mut().zip(s.hidden.chunks_exact(lanes)) {
        *g += dot::<R, FMA>(h, &s.d_sdf[..lanes]);
    }
    if tile.has_color {
        // The features' share, on the central lanes only.
        let d_features = &s.d_color_in[..n.features * central];
        transpose(&s.hidden[from..], lanes, k, central, &mut s.transposed);
        gemm_add::<R, FMA, false>(
            (n.features, k, central),
            (d_features, central),
            (&s.transposed, k),
            (&mut g_last[k..], k),
        );
        s.masked[..k * central].fill(R::ZERO);
        gemm_add::<R, FMA, true>(
            (k, central, n.features),
            (&w_last[k..], k),
            (d_features, central),
            (&mut s.masked, central),
        );
        for (j, add) in s.masked.chunks_exact(central).take(k).enumerate() {
            let at = j * lanes + from;
            for ((d, h), a) in
                s.d_hidden[at..at + central].iter_mut().zip(&s.hidden[at..at + central]).zip(add)
            {
                *d += h.gate(*a);
            }
        }
        for (row, b) in d_features.chunks_exact(central).zip(&mut grad[last.bias()][1..]) {
            *b += sum(row);
        }
    }
    grad[last.bias().start] += sum(&s.d_sdf[..lanes]);
    layer_backward::<R, FMA>(
        &first,
        model.weights,
        (&s.d_hidden[..first.outputs * lanes], &s.enc),
        &mut out.enc,
        lanes,
        &mut s.transposed,
        grad,
    );
}

/// Gradient by position: the encoding's gradient through its Jacobian.
#[inline(always)]
pub(crate) fn position_gradient<R: Real>(lanes: usize, width: usize, s: &mut Scratch<R>, d_enc: &[R]) {
    for (a, row) in s.d_pos.chunks_exact_mut(lanes).take(3).enumerate() {
        row.fill(R::ZERO);
        for f in 0..width {
            let (d, j) = (&d_enc[f * lanes..][..lanes], &s.jac[(f * 3 + a) * lanes..][..lanes]);
            for ((p, d), j) in row.iter_mut().zip(d).zip(j) {
                *p += *d * *j;
            }
        }
    }
}

/// Force and torque about the volume's centre that the samples exert on their ray's pose.
#[inline(always)]
fn pose_gradient<R: Real>(tile: &Tile<R>, s: &Scratch<R>, out: &mut TileGradient<R>) {
    let n = tile.lanes;
    for l in 0..n {
        let p = [0, 1, 2].map(|a| out.pos[a * n + l] - R::of(0.5));
        let d = [0, 1, 2].map(|a| s.d_pos[a * n + l]);
        let torque = cross(p, d);
        let twist = &mut out.twist[l % RAYS];
        for a in 0..3 {
            twist[a] += d[a];
            twist[3 + a] += torque[a];
        }
    }
}

#[inline(always)]
pub(crate) fn cross<R: Real>(a: [R; 3], b: [R; 3]) -> [R; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}
