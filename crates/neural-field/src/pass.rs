//! Forward and backward pass over one tile, from positions to gradients, fused: nothing leaves the cache between.
//!
//! Generic over the scalar: `f32` trains, `f64` checks these very gradients.

use crate::clock::Stage;
use crate::color::color_pass;
use crate::eikonal::eikonal_pass;
use crate::gemm::{
    Add, Columns, Rows, Store, Target, load, load_row, product, store_row, sum, to_columns, to_rows,
};
use crate::grid::Encode;
use crate::lanes::Lanes;
use crate::real::{Isa, Kernel, Real};
use crate::tile::{Model, PANEL, Panel, RAYS, RayPose, Scratch, Tile, TileGradient, loss};

/// Forward and backward pass over one tile. Adds to `grad` (flat network weights), overwrites `out`.
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
        scratch.sums.clear();
        scratch.clock.start();
        for panel in Panel::all(lanes, tile.central) {
            encode::<R, I, true>(model, (&out.pos, lanes), panel, scratch);
        }
        scratch.clock.lap(Stage::Encode);
        for panel in Panel::all(lanes, tile.central) {
            hidden_layer::<R, I>(model, panel, scratch);
        }
        sdf_losses(tile, scratch, &mut out.losses);
        scratch.clock.lap(Stage::Geometry);
        if tile.has_color {
            color_pass::<R, I>(model, tile, &dir, scratch, out, grad);
            scratch.clock.lap(Stage::Color);
        }
        for panel in Panel::all(lanes, tile.central) {
            geometry_backward::<R, I>(model, tile, panel, scratch, out, grad);
        }
        finish_geometry(model, tile, scratch, grad);
        if tile.has_eikonal {
            scratch.clock.lap(Stage::Backward);
            eikonal_pass::<R, I>(model, tile, scratch, out, grad);
            scratch.clock.lap(Stage::Eikonal);
        }
        pose_gradient(tile, scratch, out);
        scratch.clock.lap(Stage::Backward);
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

/// From a panel's encoding to its hidden layer and distances.
#[inline(always)]
pub(crate) fn hidden_layer<R: Real, I: Isa>(model: &Model<'_, R>, panel: Panel, s: &mut Scratch<R>) {
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
            hidden: &mut s.hidden[panel.of(h)],
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

/// Gradients of a panel's geometry network: of its weights, in `grad` and the tile's sums, of its encoding, and by
/// position.
#[inline(always)]
fn geometry_backward<R: Real, I: Isa>(
    model: &Model<'_, R>,
    tile: &Tile<R>,
    panel: Panel,
    s: &mut Scratch<R>,
    out: &mut TileGradient<R>,
    grad: &mut [R],
) {
    let (n, width) = (model.networks, panel.width);
    let [first, last] = n.geometry;
    let (e, h) = (first.inputs, first.outputs);
    // The features' share, on the central lanes only.
    let from = tile.lanes - tile.central;
    let features = if tile.has_color && panel.start >= from { n.features } else { 0 };
    if features > 0 {
        let stride = n.color_stride();
        let rows = &s.d_color_in[panel.lanes(from, stride)];
        to_columns::<R, I>((rows, stride), (n.padded_features(), width), (&mut s.panel.d_features, PANEL));
        product::<R, I>(
            (h, n.padded_features(), width),
            Rows::<R, PANEL>(&s.hidden[panel.of(h)]),
            (rows, stride),
            &mut Add { c: &mut s.sums.features, ld: n.padded_features() },
        );
    }
    let w_last = &model.weights[last.weights()];
    product::<R, I>(
        (h, width, features),
        Columns(&w_last[h..], h),
        (&s.panel.d_features, PANEL),
        &mut HiddenGradient {
            head: &w_last[..h],
            d_sdf: &s.d_sdf[panel.lanes(0, 1)],
            hidden: &s.hidden[panel.of(h)],
            d_hidden: &mut s.panel.d_hidden,
            bias_sums: &mut s.sums.bias,
            head_sums: &mut s.sums.head,
        },
    );
    to_rows::<R, I>((&s.enc[panel.of(e)], PANEL), (e, width), (&mut s.panel.rows, e));
    product::<R, I>(
        (h, e, width),
        Rows::<R, PANEL>(&s.panel.d_hidden),
        (&s.panel.rows, e),
        &mut Add { c: &mut grad[first.weights()], ld: e },
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
    bias_sums: &'a mut [R],
    head_sums: &'a mut [R],
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
        let d_sdf: [V; N] = load_row(self.d_sdf, j);
        for (r, sums) in sums.iter().enumerate() {
            let at = (i + r) * PANEL + j;
            let hidden: [V; N] = load_row(self.hidden, at);
            let (mut d, mut bias, mut head) = (*sums, V::splat(R::ZERO), V::splat(R::ZERO));
            for v in 0..N {
                d[v] = hidden[v].gate(d[v]);
                bias = bias.add(d[v]);
                head = hidden[v].madd(d_sdf[v], head);
            }
            store_row(&d, self.d_hidden, at);
            add_eights(self.bias_sums, i + r, bias);
            add_eights(self.head_sums, i + r, head);
        }
    }
}

/// Adds a vector to the `unit`-th eight partial sums.
#[inline(always)]
fn add_eights<R: Real, V: Lanes<R>>(sums: &mut [R], unit: usize, v: V) {
    V::Eight::load(sums, 8 * unit).add(v.eight()).store(sums, 8 * unit);
}

/// Adds the sums over a tile's panels to the gradient of the geometry network.
#[inline(always)]
fn finish_geometry<R: Real>(model: &Model<'_, R>, tile: &Tile<R>, s: &mut Scratch<R>, grad: &mut [R]) {
    let n = model.networks;
    let [first, last] = n.geometry;
    let (h, padded) = (first.outputs, n.padded_features());
    for (g, sums) in grad[first.bias()].iter_mut().zip(s.sums.bias.chunks_exact(8)) {
        *g += sum(sums);
    }
    let g_last = &mut grad[last.weights()];
    for (g, sums) in g_last[..h].iter_mut().zip(s.sums.head.chunks_exact(8)) {
        *g += sum(sums);
    }
    if tile.has_color {
        for (f, row) in g_last[h..].chunks_exact_mut(h).enumerate() {
            for (g, sums) in row.iter_mut().zip(s.sums.features.chunks_exact(padded)) {
                *g += sums[f];
            }
        }
        let bias = &mut grad[last.bias()][1..];
        for row in s.d_color_in[..n.color_stride() * tile.central].chunks_exact(n.color_stride()) {
            for (g, d) in bias.iter_mut().zip(row) {
                *g += *d;
            }
        }
    }
    grad[last.bias().start] += sum(&s.d_sdf[..tile.lanes]);
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
