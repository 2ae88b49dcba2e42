//! The colour network on a tile's central lanes, its loss and its gradients. Lane-major: `[lane][feature]`.
//!
//! View direction and code are the same for all samples of a ray: what the first layer makes of them is done once a ray
//! and is, for its samples, a bias.

use crate::gemm::{
    Add, Columns, Rows, Store, Target, dot, load_row, product, product_of_rows, store_row, sum,
};
use crate::harmonics::{self, harmonics};
use crate::lanes::Lanes;
use crate::pass::cross;
use crate::real::{Isa, Real};
use crate::tile::{Model, PANEL, Panel, PanelScratch, RAYS, Scratch, Tile, TileGradient, loss};
use std::ops::Range;

/// Colour network on the central lanes: blends each ray's colours, and leaves the gradient by its inputs in
/// `d_color_in` and that by the view direction in the ray's twist.
#[inline(always)]
pub(crate) fn color_pass<R: Real, I: Isa>(
    model: &Model<'_, R>,
    tile: &Tile<R>,
    dir: &[[R; 3]; RAYS],
    s: &mut Scratch<R>,
    out: &mut TileGradient<R>,
    grad: &mut [R],
) {
    let n = model.networks;
    let from = tile.lanes - tile.central;
    let mut bands = [([R::ZERO; harmonics::COUNT], [[R::ZERO; 3]; harmonics::COUNT]); RAYS];
    for r in 0..RAYS {
        bands[r] = harmonics(dir[r]);
        view_in(model, r, &bands[r].0, n.codes.of(tile.frame[r]), s);
    }
    view_forward::<R, I>(model, RAYS, s);
    for panel in Panel::central(tile.lanes, tile.central) {
        color_features::<R, I>(model, panel, from, s);
        color_forward::<R, I>(model, panel, from, RAYS, s);
    }
    color_loss(tile, s, &mut out.losses[loss::COLOR]);
    s.panel.d_view.fill(R::ZERO);
    for panel in Panel::central(tile.lanes, tile.central) {
        color_backward::<R, I>(model, panel, from, s, grad);
    }
    view_backward::<R, I>(model, s, grad);
    for r in 0..RAYS {
        let row = &s.panel.d_view_in[r * n.view_inputs()..][n.features % 8..];
        let (by_bands, by_code) = row.split_at(harmonics::COUNT);
        for (g, d) in grad[n.codes.of(tile.frame[r])].iter_mut().zip(by_code) {
            *g += *d;
        }
        let mut by_dir = [R::ZERO; 3];
        for k in 0..harmonics::COUNT {
            for a in 0..3 {
                by_dir[a] += by_bands[k] * bands[r].1[k][a];
            }
        }
        let torque = cross(dir[r], by_dir);
        for a in 0..3 {
            out.twist[r][3 + a] += torque[a];
        }
    }
}

/// Sets what the colour network sees beside the geometry features in row `row` of `view_in`. The columns are those of the
/// first layer from the last multiple of 8 among the features on, so that whole vectors of its weights belong to them.
#[inline(always)]
pub(crate) fn view_in<R: Real>(
    model: &Model<'_, R>,
    row: usize,
    bands: &[R; harmonics::COUNT],
    code: Range<usize>,
    s: &mut Scratch<R>,
) {
    let width = model.networks.view_inputs();
    let to = &mut s.panel.view_in[row * width..][model.networks.features % 8..];
    let (to_bands, to_code) = to.split_at_mut(harmonics::COUNT);
    to_bands.copy_from_slice(bands);
    to_code[..code.len()].copy_from_slice(&model.weights[code]);
}

/// What the first colour layer makes of `rows` rows of `view_in` and its bias.
#[inline(always)]
pub(crate) fn view_forward<R: Real, I: Isa>(model: &Model<'_, R>, rows: usize, s: &mut Scratch<R>) {
    let (n, c0) = (model.networks, model.networks.color[0]);
    let (width, h) = (n.view_inputs(), c0.outputs);
    let first = n.flipped().0.color[0].start;
    product_of_rows::<R, I>(
        (rows, h, width),
        (&s.panel.view_in, width),
        (&model.flipped[first + (c0.inputs - width) * h..], h),
        &mut Layer::<R, false> { bias: &model.weights[c0.bias()], rows: 1, y: &mut s.panel.view, ld: h },
    );
}

/// From the gradient by what [`view_forward`] made of the rays to those of the weights and by `view_in`.
#[inline(always)]
fn view_backward<R: Real, I: Isa>(model: &Model<'_, R>, s: &mut Scratch<R>, grad: &mut [R]) {
    let (n, c0) = (model.networks, model.networks.color[0]);
    let (width, h) = (n.view_inputs(), c0.outputs);
    let start = c0.weights().start + c0.inputs - width;
    let PanelScratch { view_in, d_view, d_view_in, .. } = &mut s.panel;
    for row in d_view.chunks_exact(h) {
        for (g, d) in grad[c0.bias()].iter_mut().zip(row) {
            *g += *d;
        }
    }
    product::<R, I>(
        (h, width, RAYS),
        Columns(d_view, h),
        (view_in, width),
        &mut Add { c: &mut grad[start..], ld: c0.inputs },
    );
    product_of_rows::<R, I>(
        (RAYS, width, h),
        (d_view, h),
        (&model.weights[start..], c0.inputs),
        &mut Store { c: d_view_in, ld: width },
    );
}

/// A panel's geometry features, to `color_in`, of which the first lane is `from`, with zeros beside them.
#[inline(always)]
pub(crate) fn color_features<R: Real, I: Isa>(
    model: &Model<'_, R>,
    panel: Panel,
    from: usize,
    s: &mut Scratch<R>,
) {
    let n = model.networks;
    let (last, padded) = (n.geometry[1], n.padded_features());
    s.panel.feature_bias[..n.features].copy_from_slice(&model.weights[last.bias()][1..]);
    product::<R, I>(
        (panel.width, padded, last.inputs),
        Columns(&s.hidden[panel.among_central(from, last.inputs)], PANEL),
        (&model.flipped[n.flipped().0.features], padded),
        &mut Layer::<R, false> {
            bias: &s.panel.feature_bias,
            rows: 1,
            y: &mut s.color_in[panel.lanes(from, padded)],
            ld: padded,
        },
    );
}

/// From a panel of `color_in`, whose lane `l` belongs to row `l % rows` of [`view_forward`], to `rgb` (after the sigmoid).
#[inline(always)]
pub(crate) fn color_forward<R: Real, I: Isa>(
    model: &Model<'_, R>,
    panel: Panel,
    from: usize,
    rows: usize,
    s: &mut Scratch<R>,
) {
    let (n, w) = (model.networks, model.weights);
    let ([_, c1, c2], [flipped0, flipped1]) = (n.color, n.flipped().0.color);
    let (h, stride) = (c1.inputs, n.padded_features());
    let units = panel.lanes(from, h);
    product_of_rows::<R, I>(
        (panel.width, h, n.features),
        (&s.color_in[panel.lanes(from, stride)], stride),
        (&model.flipped[flipped0], h),
        &mut Layer::<R, true> { bias: &s.panel.view, rows, y: &mut s.color_a[units.clone()], ld: h },
    );
    product_of_rows::<R, I>(
        (panel.width, h, h),
        (&s.color_a[units.clone()], h),
        (&model.flipped[flipped1], h),
        &mut Layer::<R, true> { bias: &w[c1.bias()], rows: 1, y: &mut s.color_b[units.clone()], ld: h },
    );
    let (weights, bias) = (&w[c2.weights()], &w[c2.bias()]);
    let rgb = &mut s.rgb[panel.among_central(from, 3)];
    for (l, row) in s.color_b[units].chunks_exact(h).enumerate() {
        for c in 0..3 {
            rgb[c * PANEL + l] = bias[c] + dot::<R, I>(row, &weights[c * h..][..h]);
        }
    }
    for v in rgb {
        *v = R::ONE / (R::ONE + (-*v).exp());
    }
}

/// A layer of a panel, with a ReLU if `RELU`; lane `l` has row `l % rows` of the bias.
struct Layer<'a, R, const RELU: bool> {
    bias: &'a [R],
    rows: usize,
    y: &'a mut [R],
    ld: usize,
}

impl<R: Real, const RELU: bool> Target<R> for Layer<'_, R, RELU> {
    #[inline(always)]
    fn start<V: Lanes<R>, const N: usize>(&self, (i, j): (usize, usize)) -> [V; N] {
        load_row(self.bias, i % self.rows * self.ld + j)
    }

    #[inline(always)]
    fn finish<V: Lanes<R>, const N: usize>(&mut self, (i, j): (usize, usize), sums: &[[V; N]]) {
        for (r, sums) in sums.iter().enumerate() {
            let mut y = *sums;
            if RELU {
                for y in &mut y {
                    *y = y.positive();
                }
            }
            store_row(&y, self.y, (i + r) * self.ld + j);
        }
    }
}

/// Squared error of the blended colour; turns `rgb` into the gradient before the sigmoid.
#[inline(always)]
fn color_loss<R: Real>(tile: &Tile<R>, s: &mut Scratch<R>, total: &mut R) {
    let two = R::of(2.0);
    let from = tile.lanes - tile.central;
    for c in 0..3 {
        let mut error = [R::ZERO; RAYS];
        for panel in Panel::central(tile.lanes, tile.central) {
            let row = &s.rgb[panel.among_central(from, 3)][c * PANEL..];
            let bell = &tile.bell[panel.lanes(from, 1)];
            for (v, b) in row.chunks_exact(RAYS).zip(bell.chunks_exact(RAYS)) {
                for r in 0..RAYS {
                    error[r] += v[r] * b[r];
                }
            }
        }
        for r in 0..RAYS {
            error[r] = error[r] - tile.color[r][c];
            *total += tile.w_color[r] * error[r] * error[r];
            error[r] = two * tile.w_color[r] * error[r];
        }
        for panel in Panel::central(tile.lanes, tile.central) {
            let row = &mut s.rgb[panel.among_central(from, 3)][c * PANEL..];
            let bell = &tile.bell[panel.lanes(from, 1)];
            for (v, b) in row.chunks_exact_mut(RAYS).zip(bell.chunks_exact(RAYS)) {
                for r in 0..RAYS {
                    v[r] = error[r] * b[r] * v[r] * (R::ONE - v[r]);
                }
            }
        }
    }
}

/// From the gradient by a panel's `rgb` to those of the weights and by `color_in`.
#[inline(always)]
fn color_backward<R: Real, I: Isa>(
    model: &Model<'_, R>,
    panel: Panel,
    from: usize,
    s: &mut Scratch<R>,
    grad: &mut [R],
) {
    let (n, w, [c0, c1, c2]) = (model.networks, model.weights, model.networks.color);
    let (h, width, stride) = (c0.outputs, panel.width, n.padded_features());
    let (a, b) = (&s.color_a[panel.lanes(from, h)], &s.color_b[panel.lanes(from, h)]);
    let (d_a, d_b) = (&mut s.panel.d_color_a, &mut s.panel.d_color_b);
    let d_rgb = &s.rgb[panel.among_central(from, 3)];
    for (row, g) in d_rgb.chunks_exact(PANEL).zip(&mut grad[c2.bias()]) {
        *g += sum(&row[..width]);
    }
    product::<R, I>(
        (3, h, width),
        Rows::<R, PANEL>(d_rgb),
        (b, h),
        &mut Add { c: &mut grad[c2.weights()], ld: h },
    );
    product::<R, I>(
        (width, h, 3),
        Columns(d_rgb, PANEL),
        (&w[c2.weights()], h),
        &mut Masked { y: b, d: d_b, ld: h, bias: &mut grad[c1.bias()] },
    );
    product::<R, I>((h, h, width), Columns(d_b, h), (a, h), &mut Add { c: &mut grad[c1.weights()], ld: h });
    product_of_rows::<R, I>(
        (width, h, h),
        (d_b, h),
        (&w[c1.weights()], h),
        &mut FirstMasked { y: a, d: d_a, ld: h, view: &mut s.panel.d_view },
    );
    product::<R, I>(
        (h, stride, width),
        Columns(d_a, h),
        (&s.color_in[panel.lanes(from, stride)], stride),
        &mut Add { c: &mut grad[c0.weights()], ld: c0.inputs },
    );
    product_of_rows::<R, I>(
        (width, stride, h),
        (d_a, h),
        (&w[c0.weights()], c0.inputs),
        &mut Store { c: &mut s.d_color_in[panel.lanes(from, stride)], ld: stride },
    );
}

/// Gradient before a ReLU whose output is `y`, and its sum over the lanes.
struct Masked<'a, R> {
    y: &'a [R],
    d: &'a mut [R],
    ld: usize,
    bias: &'a mut [R],
}

impl<R: Real> Target<R> for Masked<'_, R> {
    #[inline(always)]
    fn start<V: Lanes<R>, const N: usize>(&self, _: (usize, usize)) -> [V; N] {
        [V::splat(R::ZERO); N]
    }

    #[inline(always)]
    fn finish<V: Lanes<R>, const N: usize>(&mut self, (i, j): (usize, usize), sums: &[[V; N]]) {
        let mut bias: [V; N] = load_row(self.bias, j);
        for (r, sums) in sums.iter().enumerate() {
            let at = (i + r) * self.ld + j;
            let mut d: [V; N] = load_row(self.y, at);
            for v in 0..N {
                d[v] = d[v].gate(sums[v]);
                bias[v] = bias[v].add(d[v]);
            }
            store_row(&d, self.d, at);
        }
        store_row(&bias, self.bias, j);
    }
}

/// The same with a sum for each ray.
struct FirstMasked<'a, R> {
    y: &'a [R],
    d: &'a mut [R],
    ld: usize,
    view: &'a mut [R],
}

impl<R: Real> Target<R> for FirstMasked<'_, R> {
    #[inline(always)]
    fn start<V: Lanes<R>, const N: usize>(&self, _: (usize, usize)) -> [V; N] {
        [V::splat(R::ZERO); N]
    }

    #[inline(always)]
    fn finish<V: Lanes<R>, const N: usize>(&mut self, (i, j): (usize, usize), sums: &[[V; N]]) {
        for (r, sums) in sums.iter().enumerate() {
            let (at, ray) = ((i + r) * self.ld + j, (i + r) % RAYS * self.ld + j);
            let (mut d, mut view): ([V; N], [V; N]) = (load_row(self.y, at), load_row(self.view, ray));
            for v in 0..N {
                d[v] = d[v].gate(sums[v]);
                view[v] = view[v].add(d[v]);
            }
            store_row(&d, self.d, at);
            store_row(&view, self.view, ray);
        }
    }
}
