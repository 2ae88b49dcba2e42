//! The inner loop of all convolutions and of matching: a few outputs for a run of neighbouring pixels.

/// Outputs computed together: each loaded input is used this many times.
pub(crate) const OUTPUTS: usize = 4;
/// The most pixels computed together; inputs must be readable this far past their end.
pub(crate) const LANES: usize = 16;

/// Values that fill a vector register of the widest instruction set in use.
const WIDE: usize = 8;

/// A strip of the output: up to [`OUTPUTS`] channels of the same run of pixels.
pub(crate) struct Strip<'a> {
    /// The inputs, from the one that belongs to the first pixel and offset 0.
    pub(crate) input: &'a [f32],
    /// Distances of the inputs of a pixel.
    pub(crate) offsets: &'a [usize],
    /// Weights of these inputs, for each output.
    pub(crate) weights: &'a [[f32; OUTPUTS]],
    /// Start of the sums.
    pub(crate) bias: [f32; OUTPUTS],
    /// Added to the sums if there is one: the same run of pixels of the channels of another map, which are this far
    /// apart.
    pub(crate) add: Option<(&'a [f32], usize)>,
    /// Whether negative results become 0.
    pub(crate) relu: bool,
}

/// Inputs summed in one go: eight channels of a 3x3 kernel. Three rows of these stay in the nearest cache while the strip
/// is walked along, and so do their weights; the sums wait in the output in between.
const GO: usize = 72;

/// Computes a strip; `out` has a slice for each output, all of the same length. `N` registers of [`WIDE`] pixels.
#[inline(always)]
pub(super) fn strip<const N: usize, const FMA: bool>(strip: &Strip<'_>, out: &mut [&mut [f32]]) {
    let len = out.first().map_or(0, |o| o.len());
    let goes = strip.offsets.len().div_ceil(GO);
    for (go, (offsets, weights)) in strip.offsets.chunks(GO).zip(strip.weights.chunks(GO)).enumerate() {
        for start in (0..len).step_by(N * WIDE) {
            let mut sums = strip.bias.map(|b| [[b; WIDE]; N]);
            if go > 0 {
                for (line, sum) in out.iter().zip(&mut sums) {
                    let from = &line[start..];
                    sum.as_flattened_mut().iter_mut().zip(from).for_each(|(s, v)| *s = *v);
                }
            }
            accumulate::<N, FMA>(&strip.input[start..], offsets, weights, &mut sums);
            if go + 1 == goes {
                finish(strip, start, &mut sums);
            }
            for (line, sum) in out.iter_mut().zip(&sums) {
                line[start..].iter_mut().zip(sum.as_flattened()).for_each(|(v, s)| *v = *s);
            }
        }
    }
}

/// What follows the sums: the addition and ReLU.
#[inline(always)]
fn finish<const N: usize>(strip: &Strip<'_>, start: usize, sums: &mut [[[f32; WIDE]; N]; OUTPUTS]) {
    for (o, sum) in sums.iter_mut().enumerate() {
        let sum = sum.as_flattened_mut();
        if let Some((other, step)) = strip.add {
            let other = other.get(o * step + start..).unwrap_or(&[]);
            sum.iter_mut().zip(other).for_each(|(s, a)| *s += a);
        }
        if strip.relu {
            sum.iter_mut().for_each(|s| *s = s.max(0.0));
        }
    }
}

/// Adds the inputs times the weights to the sums of all outputs for `N * WIDE` pixels, which are kept in registers.
#[inline(always)]
fn accumulate<const N: usize, const FMA: bool>(
    input: &[f32],
    offsets: &[usize],
    weights: &[[f32; OUTPUTS]],
    out: &mut [[[f32; WIDE]; N]; OUTPUTS],
) {
    let mut sums = *out;
    for (&offset, w) in offsets.iter().zip(weights) {
        let x = &input[offset..offset + N * WIDE];
        for n in 0..N {
            for o in 0..OUTPUTS {
                for l in 0..WIDE {
                    let s = &mut sums[o][n][l];
                    *s = if FMA { w[o].mul_add(x[n * WIDE + l], *s) } else { *s + w[o] * x[n * WIDE + l] };
                }
            }
        }
    }
    *out = sums;
}
