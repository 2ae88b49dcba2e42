//! Forward and backward pass over one tile, from positions to gradients, fused: nothing leaves the cache between.
//!
//! Generic over the scalar: `f32` trains, `f64` checks these very gradients.

use crate::clock::Stage;
use crate::color::color_pass;
use crate::eikonal::{eikonal_pass, finish_masked, slope_weights};
use crate::free::{add_products, add_rows, free_panel};
use crate::gemm::{
    Add, Columns, Pairs, Rows, Store, Target, load, load_row, product, store_row, sum, to_columns, to_pairs,
};
use crate::grid::Encode;
use crate::lanes::Lanes;
use crate::real::{Isa, Kernel, Real};
use crate::tile::{Model, PANEL, Panel, RAYS, RayPose, Scratch, Tile, TileGradient, VECTOR, loss};

/// Forward and backward pass over one tile. Adds to `grad` (flat network weights), overwrites `out`. Part of the gradient
/// stays in `scratch` until [`FinishTiles`].
pub(crate) struct RunTile<'a, R> {
    pub(crate) model: &'a Model<'a, R>,
    pub(crate) poses: &'a [RayPose<R>],
    pub(crate) tile: &'a Tile<R>,
    pub(crate) scratch: &'a mut Scratch<R>,
    pub(crate) out: &'a mut TileGradient<R>,
    pub(crate) grad: &'a mut [R],
}

impl<R: Real> Kernel for RunTile<'_, R> {
    #[inline(always)]
    fn run<I: Isa>(self) {
        let Self { model, poses, tile, scratch, out, grad } = self;
        let lanes = tile.lanes;
        out.frame = tile.frame;
        out.has_eikonal = tile.has_eikonal;
        out.losses = [R::ZERO; loss::COUNT];
        out.twist = [[R::ZERO; 6]; RAYS];
        let (origin, dir) = object_rays(poses, tile);
        place(&origin, &dir, tile, &mut out.pos);
        for panel in Panel::all(lanes, tile.central) {
            encode::<R, I, true>(model, (&out.pos, lanes), panel, scratch);
        }
        scratch.clock.lap(Stage::Encode);
        slope_weights(model, &mut scratch.slope_weights);
        for panel in Panel::free(lanes, tile.central) {
            free_panel::<R, I>(model, tile, panel, scratch, out);
        }
        for panel in Panel::central(lanes, tile.central) {
            hidden_layer::<R, I>(model, panel, lanes - tile.central, scratch);
            sdf_losses::<R, I>(tile, panel, scratch, &mut out.losses);
        }
        scratch.clock.lap(Stage::Geometry);
        if tile.has_color {
            color_pass::<R, I>(model, tile, &dir, scratch, out, grad);
            scratch.clock.lap(Stage::Color);
        }
        for panel in Panel::central(lanes, tile.central) {
            geometry_backward::<R, I>(model, tile, panel, scratch, out);
        }
        if tile.has_eikonal {
            scratch.clock.lap(Stage::Geometry);
            eikonal_pass::<R, I>(model, tile, scratch, out);
            scratch.clock.lap(Stage::Eikonal);
        }
        add_last_bias(model, tile, scratch, grad);
        scratch.clock.lap(Stage::Geometry);
        pose_gradient(tile, scratch, out);
        scratch.clock.lap(Stage::Pose);
    }
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

/// Encoding of a panel of the points `pos[axis * lanes + lane]`, with its derivatives if `SLOPES`.
#[inline(always)]
pub(crate) fn encode<R: Real, I: Isa, const SLOPES: bool>(
    model: &Model<'_, R>,
    pos: (&[R], usize),
    panel: Panel,
    s: &mut Scratch<R>,
) {
    let e = model.networks.encoding();
    let (enc, jac) = (&mut s.enc[panel.of(e)], &mut s.jac[panel.of(3 * e)]);
    I::call(Encode::<R, SLOPES> { grid: model.grid, pos, panel, enc, jac });
}

/// From a panel's encoding to its hidden layer and distances; `from` is the first of the central lanes.
#[inline(always)]
pub(crate) fn hidden_layer<R: Real, I: Isa>(
    model: &Model<'_, R>,
    panel: Panel,
    from: usize,
    s: &mut Scratch<R>,
) {
    let n = model.networks;
    let ([first, last], (flipped, _)) = (n.geometry, n.flipped());
    let (e, h, width) = (first.inputs, first.outputs, panel.width);
    let sdf = &mut s.sdf[panel.lanes(0, 1)];
    sdf.fill(model.weights[last.bias().start]);
    product::<R, I>(
        (h, width, e),
        Columns(&model.flipped[flipped.hidden], h),
        (&s.enc[panel.of(e)], PANEL),
        &mut Hidden {
            bias: &model.weights[first.bias()],
            head: &model.weights[last.weights()][..h],
            hidden: &mut s.hidden[panel.among_central(from, h)],
            sdf,
        },
    );
}

/// The hidden layer after its ReLU, and what it adds to the distance.
struct Hidden<'a, R> {
    bias: &'a [R],
    head: &'a [R],
    hidden: &'a mut [R],
    sdf: &'a mut [R],
}

impl<R: Real> Target<R> for Hidden<'_, R> {
    #[inline(always)]
    fn start<V: Lanes<R>, const N: usize>(&self, (i, _): (usize, usize)) -> [V; N] {
        [V::splat(self.bias[i]); N]
    }

    #[inline(always)]
    fn finish<V: Lanes<R>, const N: usize>(&mut self, (i, j): (usize, usize), sums: &[[V; N]]) {
        let mut sdf: [V; N] = load_row(self.sdf, j);
        for (r, (sums, head)) in sums.iter().zip(&self.head[i..]).enumerate() {
            let (mut y, head) = (*sums, V::splat(*head));
            for v in 0..N {
                y[v] = y[v].positive();
                sdf[v] = head.madd(y[v], sdf[v]);
            }
            store_row(&y, self.hidden, (i + r) * PANEL + j);
        }
        store_row(&sdf, self.sdf, j);
    }
}

/// Losses of a panel on the signed distance in truncation units: one-sided free space, L2 at the surface. Says whether any
/// sample has a gradient.
#[inline(always)]
pub(crate) fn sdf_losses<R: Real, I: Isa>(
    tile: &Tile<R>,
    panel: Panel,
    s: &mut Scratch<R>,
    losses: &mut [R; loss::COUNT],
) -> bool {
    let (zero, two) = (<R::V<I>>::splat(R::ZERO), <R::V<I>>::splat(R::of(2.0)));
    let (mut sums, mut any) = ([zero; 3], 0);
    for l in panel.lanes(0, 1).step_by(<R::V<I>>::N) {
        let w_surface = <R::V<I>>::load(&tile.w_surface, l);
        let w_empty = <R::V<I>>::load(&tile.w_empty, l);
        let w_uncertain = <R::V<I>>::load(&tile.w_uncertain, l);
        let surface = <R::V<I>>::load(&s.sdf, l).sub(<R::V<I>>::load(&tile.target, l));
        let below = zero.sub(surface).positive();
        let (lifted, pulled) = (w_uncertain.mul(below), w_surface.mul(surface));
        sums[loss::UNCERTAIN] = lifted.madd(below, sums[loss::UNCERTAIN]);
        sums[loss::EMPTY] = w_empty.madd(below, sums[loss::EMPTY]);
        sums[loss::SURFACE] = pulled.madd(surface, sums[loss::SURFACE]);
        let d = two.mul(pulled.sub(lifted)).sub(below.gate(w_empty));
        d.store(&mut s.d_sdf, l);
        any |= d.less(zero) | zero.less(d);
    }
    for (loss, sum) in losses.iter_mut().zip(sums) {
        *loss += sum.total();
    }
    any != 0
}

/// Gradients of a central panel's geometry network: of its weights, in the tile's sums, of its encoding, and by position.
#[inline(always)]
fn geometry_backward<R: Real, I: Isa>(
    model: &Model<'_, R>,
    tile: &Tile<R>,
    panel: Panel,
    s: &mut Scratch<R>,
    out: &mut TileGradient<R>,
) {
    let (n, width) = (model.networks, panel.width);
    let [first, last] = n.geometry;
    let (e, h) = (first.inputs, first.outputs);
    let from = tile.lanes - tile.central;
    let hidden = &s.hidden[panel.among_central(from, h)];
    let features = if tile.has_color { n.features } else { 0 };
    if features > 0 {
        let stride = n.padded_features();
        let rows = &s.d_color_in[panel.lanes(from, stride)];
        to_columns::<R, I>((rows, stride), (stride, width), (&mut s.panel.d_features, PANEL));
        product::<R, I>(
            (h, stride, width),
            Rows::<R, PANEL>(hidden),
            (rows, stride),
            &mut Add { c: &mut s.sums.features, ld: stride },
        );
    }
    let w_last = &model.weights[last.weights()];
    let d_sdf = &s.d_sdf[panel.lanes(0, 1)];
    product::<R, I>(
        (h, width, features),
        Columns(&w_last[h..], h),
        (&s.panel.d_features, PANEL),
        &mut HiddenGradient { head: &w_last[..h], d_sdf, hidden, d_hidden: &mut s.panel.d_hidden },
    );
    add_rows::<R, I>(&s.panel.d_hidden, width, &mut s.sums.bias);
    add_products::<R, I>(hidden, d_sdf, &mut s.sums.head);
    to_pairs::<R, I>((&s.enc[panel.of(e)], PANEL), (e, width), &mut s.panel.rows);
    product::<R, I>(
        (h, 2 * e, width / 2),
        Pairs::<R, PANEL>(&s.panel.d_hidden),
        (&s.panel.rows, 2 * e),
        &mut Add { c: &mut s.sums.first, ld: 2 * e },
    );
    product::<R, I>(
        (e, width, h),
        Columns(&model.weights[first.weights()], e),
        (&s.panel.d_hidden, PANEL),
        &mut Store { c: &mut out.enc[panel.start..], ld: tile.lanes },
    );
    through_jacobian::<R, I>(
        (&s.jac[panel.of(3 * e)], width),
        model.grid.width(),
        (&out.enc[panel.start..], tile.lanes),
        (&mut s.d_pos[panel.start..], tile.lanes),
    );
}

/// The hidden layer's gradient before its ReLU, from that of the distance and (in the product) of the features.
struct HiddenGradient<'a, R> {
    head: &'a [R],
    d_sdf: &'a [R],
    hidden: &'a [R],
    d_hidden: &'a mut [R],
}

impl<R: Real> Target<R> for HiddenGradient<'_, R> {
    #[inline(always)]
    fn start<V: Lanes<R>, const N: usize>(&self, (i, j): (usize, usize)) -> [V; N] {
        let (head, mut sums) = (V::splat(self.head[i]), load_row::<R, V, N>(self.d_sdf, j));
        for sum in &mut sums {
            *sum = head.mul(*sum);
        }
        sums
    }

    #[inline(always)]
    fn finish<V: Lanes<R>, const N: usize>(&mut self, (i, j): (usize, usize), sums: &[[V; N]]) {
        let rows = i * PANEL..(i + sums.len()) * PANEL;
        let hidden = self.hidden[rows.clone()].chunks_exact(PANEL);
        for ((sums, hidden), d) in sums.iter().zip(hidden).zip(self.d_hidden[rows].chunks_exact_mut(PANEL)) {
            let mut y: [V; N] = load_row(hidden, j);
            for v in 0..N {
                y[v] = y[v].gate(sums[v]);
            }
            store_row(&y, d, j);
        }
    }
}

/// The gradients of the last geometry biases.
#[inline(always)]
fn add_last_bias<R: Real>(model: &Model<'_, R>, tile: &Tile<R>, s: &Scratch<R>, grad: &mut [R]) {
    let n = model.networks;
    let (bias, features) = grad[n.geometry[1].bias()].split_at_mut(1);
    bias[0] += sum(&s.d_sdf[..tile.lanes]);
    if tile.has_color {
        let stride = n.padded_features();
        for row in s.d_color_in[..stride * tile.central].chunks_exact(stride) {
            for (g, d) in features.iter_mut().zip(row) {
                *g += *d;
            }
        }
    }
}

/// Adds what is in other orders than the weights, summed up over the tiles of a scratch, to the gradient `grad` of the
/// geometry network, and starts anew.
pub(crate) struct FinishTiles<'a, R> {
    pub(crate) model: &'a Model<'a, R>,
    pub(crate) scratch: &'a mut Scratch<R>,
    pub(crate) grad: &'a mut [R],
}

impl<R: Real> Kernel for FinishTiles<'_, R> {
    #[inline(always)]
    fn run<I: Isa>(self) {
        let Self { model, scratch: Scratch { sums, .. }, grad } = self;
        let [first, last] = model.networks.geometry;
        let (h, padded) = (first.outputs, model.networks.padded_features());
        finish_masked(model, sums, grad);
        for (g, pair) in grad[first.weights()].iter_mut().zip(sums.first.chunks_exact(2)) {
            *g += pair[0] + pair[1];
        }
        for (g, sums) in grad[first.bias()].iter_mut().zip(sums.bias.chunks_exact(VECTOR)) {
            *g += sum(sums);
        }
        let (by_head, by_features) = grad[last.weights()].split_at_mut(h);
        for (g, sums) in by_head.iter_mut().zip(sums.head.chunks_exact(VECTOR)) {
            *g += sum(sums);
        }
        for (f, row) in by_features.chunks_exact_mut(h).enumerate() {
            for (g, sums) in row.iter_mut().zip(sums.features.chunks_exact(padded)) {
                *g += sums[f];
            }
        }
        sums.clear();
    }
}

/// Gradients by position, `[axis][lane]`, of a panel's encoding: its gradients `[feature][lane]` through its Jacobian. All
/// slices start at the panel; a row of the Jacobian is one of a panel.
#[inline(always)]
pub(crate) fn through_jacobian<R: Real, I: Isa>(
    (jac, width): (&[R], usize),
    features: usize,
    (d_enc, stride): (&[R], usize),
    (d_pos, lanes): (&mut [R], usize),
) {
    for start in (0..width).step_by(<R::V<I>>::N) {
        let mut d_p = [<R::V<I>>::splat(R::ZERO); 3];
        for f in 0..features {
            let d = <R::V<I>>::load(d_enc, f * stride + start);
            for (a, d_p) in d_p.iter_mut().enumerate() {
                *d_p = d.madd(<R::V<I>>::load(jac, (f * 3 + a) * PANEL + start), *d_p);
            }
        }
        for (a, d_p) in d_p.iter().enumerate() {
            d_p.store(d_pos, a * lanes + start);
        }
    }
}

/// Force and torque about the volume's centre that the samples exert on their ray's pose.
#[inline(always)]
fn pose_gradient<R: Real>(tile: &Tile<R>, s: &Scratch<R>, out: &mut TileGradient<R>) {
    let n = tile.lanes;
    let mut twist = [[R::ZERO; RAYS]; 6];
    for start in (0..n).step_by(RAYS) {
        let (mut p, mut d) = ([[R::ZERO; RAYS]; 3], [[R::ZERO; RAYS]; 3]);
        for a in 0..3 {
            p[a] = load(&out.pos, a * n + start);
            d[a] = load(&s.d_pos, a * n + start);
            for r in 0..RAYS {
                p[a][r] = p[a][r] - R::of(0.5);
                twist[a][r] += d[a][r];
            }
        }
        for r in 0..RAYS {
            twist[3][r] += p[1][r] * d[2][r] - p[2][r] * d[1][r];
            twist[4][r] += p[2][r] * d[0][r] - p[0][r] * d[2][r];
            twist[5][r] += p[0][r] * d[1][r] - p[1][r] * d[0][r];
        }
    }
    for r in 0..RAYS {
        for a in 0..6 {
            out.twist[r][a] += twist[a][r];
        }
    }
}

#[inline(always)]
pub(crate) fn cross<R: Real>(a: [R; 3], b: [R; 3]) -> [R; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}
