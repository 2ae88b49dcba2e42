//! The colour network on a tile's central lanes, its loss and its gradients. Lane-major: `[lane][feature]`.

use crate::gemm::{
    Add, Columns, Rows, Store, Target, dot, load, load_row, product, product_of_rows, store_row, sum,
};
use crate::harmonics::{self, harmonics};
use crate::lanes::Lanes;
use crate::pass::cross;
use crate::real::{Isa, Real};
use crate::tile::{Model, PANEL, Panel, RAYS, Scratch, Tile, TileGradient, loss};

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
    let (n, w) = (model.networks, model.weights);
    let (stride, from) = (n.color_stride(), tile.lanes - tile.central);
    let mut bands = [([R::ZERO; harmonics::COUNT], [[R::ZERO; 3]; harmonics::COUNT]); RAYS];
    for r in 0..RAYS {
        bands[r] = harmonics(dir[r]);
    }
    for panel in Panel::central(tile.lanes, tile.central) {
        color_features::<R, I>(model, panel, from, s);
        for (l, row) in s.color_in[panel.lanes(from, stride)].chunks_exact_mut(stride).enumerate() {
            let r = l % RAYS;
            let (bands_in, code) = row[n.features..].split_at_mut(harmonics::COUNT);
            bands_in.copy_from_slice(&bands[r].0);
            let codes = &w[n.codes.of(tile.frame[r])];
            code[..codes.len()].copy_from_slice(codes);
        }
        color_forward::<R, I>(model, panel, from, s);
    }
    color_loss(tile, s, &mut out.losses[loss::COLOR]);
    for panel in Panel::central(tile.lanes, tile.central) {
        color_backward::<R, I>(model, panel, from, s, grad);
    }

    let mut totals = [[R::ZERO; harmonics::COUNT]; RAYS];
    for (l, row) in s.d_color_in[..stride * tile.central].chunks_exact(stride).enumerate() {
        let from_bands: [R; harmonics::COUNT] = load(row, n.features);
        for k in 0..harmonics::COUNT {
            totals[l % RAYS][k] += from_bands[k];
        }
        let code = &row[n.features + harmonics::COUNT..];
        for (g, d) in grad[n.codes.of(tile.frame[l % RAYS])].iter_mut().zip(code) {
            *g += *d;
        }
    }
    for r in 0..RAYS {
        let mut by_dir = [R::ZERO; 3];
        for k in 0..harmonics::COUNT {
            for a in 0..3 {
                by_dir[a] += totals[r][k] * bands[r].1[k][a];
            }
        }
        let torque = cross(dir[r], by_dir);
        for a in 0..3 {
            out.twist[r][3 + a] += torque[a];
        }
    }
}

/// A panel's geometry features, to `color_in`, of which the first lane is `from`. Overwrites what is beside them.
#[inline(always)]
pub(crate) fn color_features<R: Real, I: Isa>(
    model: &Model<'_, R>,
    panel: Panel,
    from: usize,
    s: &mut Scratch<R>,
) {
    let n = model.networks;
    let (last, padded, stride) = (n.geometry[1], n.padded_features(), n.color_stride());
    product::<R, I>(
        (panel.width, padded, last.inputs),
        Columns(&s.hidden[panel.among_central(from, last.inputs)], PANEL),
        (&model.flipped[n.flipped().0.features], padded),
        &mut Layer::<R, false> {
            // What follows the biases in the flat weights goes to the padding.
            bias: &model.weights[last.bias().start + 1..],
            y: &mut s.color_in[panel.lanes(from, stride)],
            ld: stride,
        },
    );
}

/// From a panel of `color_in` to `rgb` (after the sigmoid).
#[inline(always)]
pub(crate) fn color_forward<R: Real, I: Isa>(
    model: &Model<'_, R>,
    panel: Panel,
    from: usize,
    s: &mut Scratch<R>,
) {
    let (n, w) = (model.networks, model.weights);
    let ([c0, c1, c2], [flipped0, flipped1]) = (n.color, n.flipped().0.color);
    let (inputs, h, stride) = (c0.inputs, c0.outputs, n.color_stride());
    let units = panel.lanes(from, h);
    product_of_rows::<R, I>(
        (panel.width, h, inputs),
        (&s.color_in[panel.lanes(from, stride)], stride),
        (&model.flipped[flipped0], h),
        &mut Layer::<R, true> { bias: &w[c0.bias()], y: &mut s.color_a[units.clone()], ld: h },
    );
    product_of_rows::<R, I>(
        (panel.width, h, h),
        (&s.color_a[units.clone()], h),
        (&model.flipped[flipped1], h),
        &mut Layer::<R, true> { bias: &w[c1.bias()], y: &mut s.color_b[units.clone()], ld: h },
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

/// A layer of a panel, with a ReLU if `RELU`.
struct Layer<'a, R, const RELU: bool> {
    bias: &'a [R],
    y: &'a mut [R],
    ld: usize,
}

impl<R: Real, const RELU: bool> Target<R> for Layer<'_, R, RELU> {
    #[inline(always)]
    fn start<V: Lanes<R>, const N: usize>(&self, (_, j): (usize, usize)) -> [V; N] {
        load_row(self.bias, j)
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
    let (w, [c0, c1, c2]) = (model.weights, model.networks.color);
    let (inputs, h, width) = (c0.inputs, c0.outputs, panel.width);
    let stride = model.networks.color_stride();
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
        &mut Masked { y: a, d: d_a, ld: h, bias: &mut grad[c0.bias()] },
    );
    product::<R, I>(
        (h, inputs, width),
        Columns(d_a, h),
        (&s.color_in[panel.lanes(from, stride)], stride),
        &mut Add { c: &mut grad[c0.weights()], ld: inputs },
    );
    product_of_rows::<R, I>(
        (width, inputs, h),
        (d_a, h),
        (&w[c0.weights()], inputs),
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
