//! Convolutions with bias, an optional addition and ReLU.

use super::map::Map;
use super::simd;
use super::tile::{OUTPUTS, Strip};
use rayon::prelude::*;

/// What follows a convolution.
#[derive(Clone, Copy)]
pub(crate) enum After<'a> {
    /// Nothing.
    Linear,
    /// Negative values become 0.
    Relu,
    /// A map of the same size is added, then negative values become 0 (the end of a residual block).
    AddRelu(&'a Map),
}

/// A 2-D convolution, weights packed for [`simd::strip`].
///
/// Kernels of 1x1 without padding, 3x3 and 4x4 with one pixel of zeros around; stride 1 or 2 (4x4: only 2).
#[derive(Clone, Debug)]
pub(crate) struct Conv {
    inputs: usize,
    outputs: usize,
    /// Inputs of a group.
    group_inputs: usize,
    kernel: usize,
    stride: usize,
    blocks: Vec<Block>,
}

/// Up to [`OUTPUTS`] outputs of one group.
#[derive(Clone, Debug)]
struct Block {
    first_input: usize,
    outputs: usize,
    bias: [f32; OUTPUTS],
    /// For each input of the group and each tap.
    weights: Vec<[f32; OUTPUTS]>,
}

impl Conv {
    /// A convolution with `weight` of shape `[outputs, inputs of a group, kernel, kernel]` and `bias` of `[outputs]`.
    /// `None` for a shape that is not supported.
    pub(crate) fn new(
        inputs: usize,
        shape: [usize; 4],
        weight: &[f32],
        bias: &[f32],
        stride: usize,
    ) -> Option<Self> {
        let [outputs, group_inputs, kernel, width] = shape;
        let taps = kernel * kernel;
        let supported = matches!((kernel, stride), (1, 1) | (3, 1 | 2) | (4, 2)) && kernel == width;
        if !supported || outputs == 0 || group_inputs == 0 || !inputs.is_multiple_of(group_inputs) {
            return None;
        }
        let groups = inputs / group_inputs;
        if !outputs.is_multiple_of(groups)
            || weight.len() != outputs * group_inputs * taps
            || bias.len() != outputs
        {
            return None;
        }
        let group_outputs = outputs / groups;
        let mut blocks = Vec::new();
        for group in 0..groups {
            for first in (0..group_outputs).step_by(OUTPUTS) {
                let count = OUTPUTS.min(group_outputs - first);
                let first = group * group_outputs + first;
                let mut block = Block {
                    first_input: group * group_inputs,
                    outputs: count,
                    bias: [0.0; OUTPUTS],
                    weights: vec![[0.0; OUTPUTS]; group_inputs * taps],
                };
                block.bias[..count].copy_from_slice(&bias[first..first + count]);
                for o in 0..count {
                    let from = &weight[(first + o) * group_inputs * taps..];
                    for (to, from) in block.weights.iter_mut().zip(from) {
                        to[o] = *from;
                    }
                }
                blocks.push(block);
            }
        }
        Some(Self { inputs, outputs, group_inputs, kernel, stride, blocks })
    }

    /// Channels of the result.
    pub(crate) fn outputs(&self) -> usize {
        self.outputs
    }

    /// The convolution of `map`, whose channels must be the inputs. Spread over the threads of the current rayon pool;
    /// the result does not depend on their number.
    pub(crate) fn run(&self, map: &Map, after: After<'_>) -> Map {
        debug_assert_eq!(map.channels(), self.inputs);
        // Of nothing (no keypoint was found) nothing is left.
        let shrink = |n: usize| {
            let padded = n + 2 * usize::from(self.kernel > 1);
            padded.checked_sub(self.kernel).map_or(0, |rest| rest / self.stride + 1)
        };
        let mut out = Map::zeros(self.outputs, shrink(map.width()), shrink(map.height()));
        let (stride, plane) = (out.stride(), out.plane());
        let phases = (self.stride == 2).then(|| phases(map, &out));
        let input = phases.as_ref().unwrap_or(map).data();
        let planes_per_input = if self.stride == 2 { 4 } else { 1 };
        let offsets = self.offsets(stride, plane);

        let (add, relu) = match after {
            After::Linear => (None, false),
            After::Relu => (None, true),
            After::AddRelu(other) => (Some(other), true),
        };
        debug_assert!(add.is_none_or(|a| a.channels() == self.outputs && a.plane() == plane));
        let tasks = self.tasks(&mut out);
        let compute = |mut task: Task<'_>| {
            let at = task.first_output * plane + task.start;
            let strip = Strip {
                input: &input[task.block.first_input * planes_per_input * plane + task.start - stride - 1..],
                offsets: &offsets,
                weights: &task.block.weights,
                bias: task.block.bias,
                add: add.map(|other| (&other.data()[at..], plane)),
                relu,
            };
            simd::strip(&strip, &mut task.lines);
        };
        if rayon::current_num_threads() > 1 {
            tasks.into_par_iter().for_each(compute);
        } else {
            tasks.into_iter().for_each(compute);
        }
        out.clear_margin();
        out
    }

    /// Distances of the inputs of a pixel from the pixel above and left of it, for the inputs of one group.
    fn offsets(&self, stride: usize, plane: usize) -> Vec<usize> {
        let taps = (0..self.kernel).flat_map(|y| (0..self.kernel).map(move |x| (y, x)));
        let of_tap = |(y, x): (usize, usize)| match (self.kernel, self.stride) {
            (1, _) => stride + 1,
            (_, 1) => y * stride + x,
            _ => ((y % 2) * 2 + x % 2) * plane + (y / 2) * stride + x / 2,
        };
        let taps: Vec<usize> = taps.map(of_tap).collect();
        let input = if self.stride == 2 { 4 * plane } else { plane };
        (0..self.group_inputs).flat_map(|i| taps.iter().map(move |t| i * input + t)).collect()
    }

    /// Cuts the output into independent pieces of work.
    fn tasks<'a>(&'a self, out: &'a mut Map) -> Vec<Task<'a>> {
        // Long enough that handing out a task costs nothing beside it.
        const SHORTEST: usize = 1024;
        let (stride, plane, height) = (out.stride(), out.plane(), out.height());
        let (first, end) = (stride + 1, (height + 1) * stride - 1);
        let strips = (2 * rayon::current_num_threads()).div_ceil(self.blocks.len());
        let length = (end - first).div_ceil(strips).max(SHORTEST);
        let mut tasks = Vec::new();
        let mut planes = out.data_mut().chunks_exact_mut(plane);
        let mut first_output = 0;
        for block in &self.blocks {
            let before = tasks.len();
            tasks.extend((first..end).step_by(length).map(|start| Task {
                block,
                first_output,
                start,
                lines: Vec::with_capacity(block.outputs),
            }));
            for channel in planes.by_ref().take(block.outputs) {
                for (task, line) in tasks[before..].iter_mut().zip(channel[first..end].chunks_mut(length)) {
                    task.lines.push(line);
                }
            }
            first_output += block.outputs;
        }
        tasks
    }
}

/// A run of pixels of the outputs of a block.
struct Task<'a> {
    block: &'a Block,
    first_output: usize,
    /// First pixel, from the start of the channel.
    start: usize,
    lines: Vec<&'a mut [f32]>,
}

/// The four images of even and odd rows and columns of each channel, margin included, as maps of the size of `out`.
fn phases(map: &Map, out: &Map) -> Map {
    let (stride, plane) = (out.stride(), out.plane());
    let mut phases = Map::zeros(4 * map.channels(), out.width(), out.height());
    let width = map.stride();
    let channels = map.data().chunks_exact(map.plane()).take(map.channels());
    for (channel, to) in channels.zip(phases.data_mut().chunks_exact_mut(4 * plane)) {
        for (y, row) in channel.chunks_exact(width).enumerate() {
            let (even, odd) = to[(y % 2) * 2 * plane..][..2 * plane].split_at_mut(plane);
            let line = (y / 2) * stride;
            if line + stride > plane {
                continue;
            }
            let (even, odd) = (&mut even[line..line + stride], &mut odd[line..line + stride]);
            for ((pair, e), o) in row.chunks_exact(2).zip(even.iter_mut()).zip(odd) {
                *e = pair[0];
                *o = pair[1];
            }
            if let ([last], Some(e)) = (row.chunks_exact(2).remainder(), even.get_mut(width / 2)) {
                *e = *last;
            }
        }
    }
    phases
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    /// The definition, in 64 bits.
    fn naive(
        map: &Map,
        shape: [usize; 4],
        weight: &[f32],
        bias: &[f32],
        stride: usize,
        add: Option<&Map>,
    ) -> Vec<f64> {
        let [outputs, inputs, kernel, _] = shape;
        let pad = usize::from(kernel > 1);
        let small = |n: usize| (n + 2 * pad - kernel) / stride + 1;
        let (width, height) = (small(map.width()), small(map.height()));
        let group = outputs / (map.channels() / inputs);
        let mut out = Vec::new();
        for (o, y, x) in
            (0..outputs).flat_map(|o| (0..height).flat_map(move |y| (0..width).map(move |x| (o, y, x))))
        {
            let mut sum = f64::from(bias[o]) + add.map_or(0.0, |a| f64::from(a.at(o, x, y)));
            for (i, ky, kx) in (0..inputs)
                .flat_map(|i| (0..kernel).flat_map(move |ky| (0..kernel).map(move |kx| (i, ky, kx))))
            {
                let (v, u) = ((y * stride + ky).wrapping_sub(pad), (x * stride + kx).wrapping_sub(pad));
                if v < map.height() && u < map.width() {
                    let w = weight[((o * inputs + i) * kernel + ky) * kernel + kx];
                    sum += f64::from(w) * f64::from(map.at(o / group * inputs + i, u, v));
                }
            }
            out.push(sum);
        }
        out
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(60))]
        #[test]
        fn a_convolution_is_what_its_definition_says(
            kind in 0_usize..4, groups in 1_usize..4, inputs in 1_usize..6, outputs in 1_usize..7,
            width in 2_usize..40, height in 2_usize..12, after in 0_usize..3, seed in 0_u64..1000,
        ) {
            let (kernel, stride) = [(1, 1), (3, 1), (3, 2), (4, 2)][kind];
            let shape = [groups * outputs, inputs, kernel, kernel];
            let mut rng = Pcg64Mcg::seed_from_u64(seed);
            let mut random = |n: usize| (0..n).map(|_| rng.random_range(-1.0_f32..1.0)).collect::<Vec<f32>>();
            let weight = random(shape.iter().product());
            let bias = random(shape[0]);
            let values = random(groups * inputs * width * height);
            let map = Map::from_fn(groups * inputs, width, height, |c, x, y| values[(c * height + y) * width + x]);
            let conv = Conv::new(groups * inputs, shape, &weight, &bias, stride).unwrap();
            let plain = conv.run(&map, After::Linear);
            let other = Map::from_fn(shape[0], plain.width(), plain.height(), |c, x, y| ((c + 3 * x + y) % 5) as f32 - 2.0);
            let (got, add, relu) = match after {
                0 => (plain, None, false),
                1 => (conv.run(&map, After::Relu), None, true),
                _ => (conv.run(&map, After::AddRelu(&other)), Some(&other), true),
            };
            let want = naive(&map, shape, &weight, &bias, stride, add);
            let dense = got.to_dense();
            prop_assert_eq!(dense.len(), want.len());
            for (g, w) in dense.iter().zip(want) {
                let w = if relu { w.max(0.0) } else { w };
                prop_assert!((f64::from(*g) - w).abs() < 1e-4, "{} instead of {}", g, w);
            }
            // The margin stays zero: the next layer relies on it.
            let inside: f32 = dense.iter().map(|v| v.abs()).sum();
            let all: f32 = got.data().iter().map(|v| v.abs()).sum();
            prop_assert!((inside - all).abs() <= 1e-4 * all.max(1.0));
        }
    }

    #[test]
    fn both_instruction_sets_agree() {
        let mut rng = Pcg64Mcg::seed_from_u64(5);
        let mut random = |n: usize| (0..n).map(|_| rng.random_range(-1.0_f32..1.0)).collect::<Vec<f32>>();
        let (input, add) = (random(400), random(400));
        let offsets: Vec<usize> = (0..50).map(|i| 7 * i % 320).collect();
        let weights: Vec<[f32; OUTPUTS]> = random(200).as_chunks().0.to_vec();
        let strip = Strip {
            input: &input,
            offsets: &offsets,
            weights: &weights,
            bias: [0.5, -0.5, 0.0, 1.0],
            add: Some((&add, 60)),
            relu: true,
        };
        for len in [1, 15, 16, 17, 37] {
            let run = |f: &dyn Fn(&Strip<'_>, &mut [&mut [f32]])| {
                let mut out = vec![0.0; 3 * len];
                let mut lines: Vec<&mut [f32]> = out.chunks_exact_mut(len).collect();
                f(&strip, &mut lines);
                out
            };
            let (fast, portable) = (run(&simd::strip), run(&simd::portable_strip));
            assert!(fast.iter().any(|v| *v > 0.0));
            assert!(fast.iter().zip(&portable).all(|(a, b)| (a - b).abs() < 1e-4));
        }
    }

    #[test]
    fn shapes_that_do_not_fit_are_refused() {
        let conv = |inputs, shape: [usize; 4], stride| {
            Conv::new(inputs, shape, &vec![0.0; shape.iter().product()], &vec![0.0; shape[0]], stride)
        };
        assert!(conv(4, [8, 4, 3, 3], 1).is_some() && conv(4, [8, 2, 3, 3], 2).is_some());
        for (inputs, shape, stride) in [
            (4, [8, 3, 3, 3], 1),
            (4, [7, 2, 3, 3], 1),
            (4, [8, 4, 3, 1], 1),
            (4, [8, 4, 5, 5], 1),
            (4, [8, 4, 4, 4], 1),
            (4, [0, 4, 3, 3], 1),
            (4, [8, 0, 3, 3], 1),
        ] {
            assert!(conv(inputs, shape, stride).is_none(), "{inputs} {shape:?} {stride}");
        }
    }
}
