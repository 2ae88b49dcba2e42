//! The lists of dispatches: one training step, and queries of blocks of points.

use super::buffers::{Buffers, Sizes};
use super::device::{Dispatch, Gpu, WORKGROUP};
use super::kernels::Kernel;
use super::layout::{Placed, WeightLayout};
use super::upload::Upload;
use crate::config::FieldConfig;
use crate::grid::Level;
use crate::round::Round;

/// Most lattices: the length of the kernels' tables of them.
pub(crate) const MAX_LEVELS: usize = 16;
/// Most workgroups along the first axis of a dispatch that is folded into two.
const FOLD: u32 = 1 << 15;

// Flags of the layer kernels.
const BIAS: u32 = 1;
const RELU: u32 = 2;
const GATE: u32 = 4;
const ADD: u32 = 8;

/// Rows of a matrix in a buffer: lanes from one row to the next, and the lane of the first column.
#[derive(Clone, Copy)]
struct Rows<'a> {
    buffer: &'a wgpu::Buffer,
    stride: u32,
    from: u32,
}

/// Which rows of a layer's matrix take part, and where their weights and biases are.
#[derive(Clone, Copy)]
struct Part {
    inputs: u32,
    outputs: u32,
    weights: u32,
    bias: u32,
}

impl From<Placed> for Part {
    fn from(p: Placed) -> Self {
        Self { inputs: p.inputs, outputs: p.outputs, weights: p.weights, bias: p.bias }
    }
}

impl Part {
    fn rows(self, from: u32, outputs: u32) -> Self {
        Self { outputs, weights: self.weights + from * self.inputs, bias: self.bias + from, ..self }
    }
}

/// What the kernels' parameters are made of.
pub(crate) struct Plan<'a> {
    pub(crate) gpu: &'a Gpu,
    pub(crate) round: &'a Round,
    pub(crate) sizes: &'a Sizes,
    pub(crate) weights: &'a WeightLayout,
    pub(crate) levels: &'a [Level],
    pub(crate) buffers: &'a Buffers,
    pub(crate) upload: &'a Upload,
    pub(crate) truncation: f32,
}

/// A list of dispatches in the making.
struct Recorder<'a> {
    plan: &'a Plan<'a>,
    list: Vec<Dispatch>,
}

impl<'a> Plan<'a> {
    fn recorder(&'a self) -> Recorder<'a> {
        Recorder { plan: self, list: Vec::new() }
    }

    fn config(&self) -> &FieldConfig {
        &self.round.config
    }

    fn has_eikonal(&self) -> bool {
        self.config().weights.eikonal > 0.0 && self.config().eikonal_every > 0
    }

    /// A step up to and without the updates.
    pub(crate) fn gradients(&'a self, color: bool) -> Vec<Dispatch> {
        let mut r = self.recorder();
        r.sampling();
        r.forward();
        if color {
            r.color();
        }
        r.geometry_backward(color);
        if self.has_eikonal() {
            r.eikonal();
        }
        r.scatter(color);
        r.list
    }

    /// The updates at the end of a step.
    pub(crate) fn updates(&'a self) -> Vec<Dispatch> {
        let mut r = self.recorder();
        r.updates();
        r.list
    }

    /// Distances (and slopes) of a block of as many points as there are central lanes.
    pub(crate) fn query(&'a self, slopes: bool) -> Vec<Dispatch> {
        let (s, b) = (self.sizes, self.buffers);
        let mut r = self.recorder();
        let c = s.central_lanes();
        let block = |buffer| Rows { buffer, stride: c, from: 0 };
        let [first, last] = self.weights.geometry.map(Part::from);
        r.encode(&b.query_encoding, c, false);
        r.linear(first, c, block(&b.query_encoding), block(&b.hidden), BIAS | RELU, None);
        r.linear(last.rows(0, 1), c, block(&b.hidden), block(&b.sdf), BIAS, None);
        if slopes {
            r.by_feature(block(&b.hidden));
            r.slopes(c, 0, true);
        }
        r.list
    }

    /// Colours (before the sigmoid) of the points of the last query.
    pub(crate) fn query_color(&'a self) -> Vec<Dispatch> {
        let mut r = self.recorder();
        let hidden = Rows { buffer: &self.buffers.hidden, stride: self.sizes.central_lanes(), from: 0 };
        r.color_forward(hidden, false);
        r.list
    }
}

impl<'a> Recorder<'a> {
    fn add(&mut self, kernel: Kernel, params: &[u32], buffers: &[&wgpu::Buffer], size: [u32; 3]) {
        // A uniform buffer's size is a multiple of 16.
        let mut params = params.to_vec();
        params.resize(params.len().next_multiple_of(4), 0);
        let group = self.plan.gpu.bind(kernel, &params, buffers);
        self.list.push(Dispatch { kernel, group, size });
    }

    /// Workgroups for as many invocations, folded into two dimensions.
    fn fold(invocations: u32) -> [u32; 3] {
        let groups = invocations.div_ceil(WORKGROUP).max(1);
        let x = groups.min(FOLD);
        [x, groups.div_ceil(x), 1]
    }

    fn levels(&self) -> Vec<u32> {
        let mut words = Vec::with_capacity(4 * MAX_LEVELS + 12);
        let mut first = 0;
        for level in self.plan.levels {
            let scale = level.scale as f32;
            words.extend([level.vertices, first, level.hash_mask.unwrap_or(0), scale.to_bits()]);
            first += level.len as u32;
        }
        words.resize(4 * MAX_LEVELS, 0);
        words
    }

    fn bounds(&self) -> [u32; 2] {
        let b = &self.plan.round.corrections.bounds;
        [(b[0] as f32).to_bits(), (b[3] as f32).to_bits()]
    }

    fn lanes<'b>(&self, buffer: &'b wgpu::Buffer) -> Rows<'b> {
        Rows { buffer, stride: self.plan.sizes.lanes(), from: 0 }
    }

    /// The central columns of a buffer with all lanes.
    fn central_of<'b>(&self, buffer: &'b wgpu::Buffer) -> Rows<'b> {
        Rows { buffer, stride: self.plan.sizes.lanes(), from: self.plan.sizes.central_from() }
    }

    /// A buffer with central lanes only.
    fn central<'b>(&self, buffer: &'b wgpu::Buffer) -> Rows<'b> {
        Rows { buffer, stride: self.plan.sizes.central_lanes(), from: 0 }
    }

    fn linear(
        &mut self,
        part: Part,
        lanes: u32,
        x: Rows<'_>,
        y: Rows<'_>,
        flags: u32,
        gate: Option<Rows<'_>>,
    ) {
        let g = gate.unwrap_or(x);
        let flags = if gate.is_some() { flags | GATE } else { flags };
        let params = [
            lanes,
            part.inputs,
            part.outputs,
            part.weights,
            part.bias,
            x.stride,
            x.from,
            y.stride,
            y.from,
            g.stride,
            g.from,
            flags,
        ];
        let buffers = [&self.plan.buffers.weights, x.buffer, g.buffer, y.buffer];
        let size = [(lanes / 4).div_ceil(WORKGROUP), part.outputs.div_ceil(8), 1];
        self.add(Kernel::Linear, &params, &buffers, size);
    }

    fn linear_back(
        &mut self,
        part: Part,
        lanes: u32,
        dy: Rows<'_>,
        dx: Rows<'_>,
        flags: u32,
        gate: Option<Rows<'_>>,
    ) {
        let g = gate.unwrap_or(dy);
        let flags = if gate.is_some() { flags | GATE } else { flags };
        let params = [
            lanes,
            part.inputs,
            part.outputs,
            part.weights,
            dy.stride,
            dy.from,
            dx.stride,
            dx.from,
            g.stride,
            g.from,
            flags,
        ];
        let buffers = [&self.plan.buffers.weights, dy.buffer, g.buffer, dx.buffer];
        let size = [(lanes / 4).div_ceil(WORKGROUP), part.inputs / 8, 1];
        self.add(Kernel::LinearBack, &params, &buffers, size);
    }

    fn weight_gradient(&mut self, part: Part, lanes: u32, dy: Rows<'_>, x: Rows<'_>, flags: u32) {
        let chunks = self.plan.sizes.chunks;
        let params = [
            lanes,
            part.inputs,
            part.outputs,
            part.weights,
            part.bias,
            dy.stride,
            dy.from,
            x.stride,
            x.from,
            self.plan.weights.len,
            lanes.div_ceil(chunks),
            flags,
        ];
        let buffers = [dy.buffer, x.buffer, &self.plan.buffers.weight_gradient];
        let size = [part.inputs.div_ceil(32).max(1), part.outputs.div_ceil(32), chunks];
        self.add(Kernel::WeightGradient, &params, &buffers, size);
    }

    fn sampling(&mut self) {
        let plan = self.plan;
        let (s, b, c) = (plan.sizes, plan.buffers, plan.config());
        let [translation, rotation] = self.bounds();
        self.add(
            Kernel::Poses,
            &[s.frames, translation, rotation],
            &[&b.initial_poses, &b.theta, &b.poses],
            Self::fold(s.frames),
        );
        let (sampler, u) = (&plan.round.sampler, plan.upload);
        let volume = sampler.volume();
        let counts = sampler.counts;
        let (rays, free) = (s.surface_rays as f32, s.free as f32);
        let ring_samples = s.ring_rays as f32 * free;
        let w = &c.weights;
        let mut params: Vec<u32> = u.origin.iter().map(|v| v.to_bits()).collect();
        params.extend(u.dims.iter().chain(&[0]).chain(&u.bricks).chain(&[0]));
        params.extend(volume.center.iter().chain(&[volume.edge]).map(|v| (*v as f32).to_bits()));
        params.extend([c.seed as u32, (c.seed >> 32) as u32, s.surface_rays, s.ring_rays]);
        params.extend([sampler.surface_frames.len() as u32, sampler.ring_frames.len() as u32]);
        params.extend([s.free, s.rows - s.free, s.central, counts.central_from(c.behind) as u32]);
        let falloff_rate = if c.surface_falloff > 0.0 { (1.0 / c.surface_falloff) as f32 } else { 0.0 };
        let numbers = [
            c.truncation as f32,
            c.behind as f32,
            falloff_rate,
            c.color_sharpness as f32,
            c.first_frame_weight as f32,
            w.surface as f32 / (rays * (s.rows - s.free) as f32),
            w.empty as f32 / (rays * free),
            w.color as f32 / (3.0 * rays),
            w.eikonal as f32 * c.eikonal_every as f32 / (rays * s.central as f32),
            w.empty as f32 / ring_samples,
            w.uncertain as f32 / ring_samples,
            c.free_distance as f32,
            c.epsilon as f32,
        ];
        params.extend(numbers.map(f32::to_bits));
        self.add(
            Kernel::Sample,
            &params,
            &[&b.schedule, &b.poses, &b.frames, &b.candidates, &b.occupancy, &b.rays, &b.samples, &b.central],
            Self::fold(s.rays()),
        );
    }

    /// From places, those of the rays' samples or given ones, to features.
    fn encode(&mut self, encoding: &wgpu::Buffer, lanes: u32, from_rays: bool) {
        let (s, b) = (self.plan.sizes, self.plan.buffers);
        let mut params = self.levels();
        params.extend([self.plan.levels.len() as u32, lanes, lanes, s.surface_rays, s.ring_rays]);
        params.extend([s.ring_lanes(), u32::from(from_rays)]);
        self.add(
            Kernel::Encode,
            &params,
            &[&b.table, &b.rays, &b.samples, &b.places, encoding],
            Self::fold(lanes),
        );
    }

    fn forward(&mut self) {
        let (s, b) = (self.plan.sizes, self.plan.buffers);
        let [first, last] = self.plan.weights.geometry.map(Part::from);
        let n = s.lanes();
        self.encode(&b.encoding, n, true);
        self.linear(first, n, self.lanes(&b.encoding), self.lanes(&b.hidden), BIAS | RELU, None);
        self.linear(last.rows(0, 1), n, self.lanes(&b.hidden), self.lanes(&b.sdf), BIAS, None);
        self.add(
            Kernel::SdfLoss,
            &[s.surface_rays, s.ring_rays, s.free, s.rows],
            &[&b.samples, &b.sdf, &b.d_sdf, &b.ray_losses],
            Self::fold(s.rays()),
        );
    }

    /// From the hidden layer to the colour before the sigmoid.
    fn color_forward(&mut self, hidden: Rows<'_>, from_rays: bool) {
        let (s, b) = (self.plan.sizes, self.plan.buffers);
        let c = s.central_lanes();
        let features = Part::from(self.plan.weights.geometry[1]).rows(1, s.features);
        let [c0, c1, c2] = self.plan.weights.color.map(Part::from);
        self.linear(features, c, hidden, self.central(&b.color_in), BIAS, None);
        self.add(
            Kernel::ColorInput,
            &[c, c, s.features, s.surface_rays, u32::from(from_rays)],
            &[&b.rays, &b.directions, &b.color_in],
            Self::fold(c),
        );
        self.linear(c0, c, self.central(&b.color_in), self.central(&b.color_a), BIAS | RELU, None);
        self.linear(c1, c, self.central(&b.color_a), self.central(&b.color_b), BIAS | RELU, None);
        self.linear(c2, c, self.central(&b.color_b), self.central(&b.rgb), BIAS, None);
    }

    fn color(&mut self) {
        let (s, b) = (self.plan.sizes, self.plan.buffers);
        let c = s.central_lanes();
        self.color_forward(self.central_of(&b.hidden), true);
        self.add(
            Kernel::ColorLoss,
            &[s.surface_rays, s.ring_rays, s.central],
            &[&b.rays, &b.central, &b.rgb, &b.ray_losses],
            Self::fold(s.surface_rays),
        );
        let [c0, c1, c2] = self.plan.weights.color.map(Part::from);
        let (in_, d_in) = (self.central(&b.color_in), self.central(&b.d_color_in));
        let (a, d_a) = (self.central(&b.color_a), self.central(&b.d_color_a));
        let (b_, d_b, rgb) = (self.central(&b.color_b), self.central(&b.d_color_b), self.central(&b.rgb));
        self.weight_gradient(c2, c, rgb, b_, BIAS);
        self.linear_back(c2, c, rgb, d_b, 0, Some(b_));
        self.weight_gradient(c1, c, d_b, a, BIAS);
        self.linear_back(c1, c, d_b, d_a, 0, Some(a));
        self.weight_gradient(c0, c, d_a, in_, BIAS);
        self.linear_back(c0, c, d_a, d_in, 0, None);
    }

    fn geometry_backward(&mut self, color: bool) {
        let (s, b) = (self.plan.sizes, self.plan.buffers);
        let (n, c) = (s.lanes(), s.central_lanes());
        let [first, last] = self.plan.weights.geometry.map(Part::from);
        let (hidden, d_hidden) = (self.lanes(&b.hidden), self.lanes(&b.d_hidden));
        let sdf = last.rows(0, 1);
        self.linear_back(sdf, n, self.lanes(&b.d_sdf), d_hidden, 0, Some(hidden));
        self.weight_gradient(sdf, n, self.lanes(&b.d_sdf), hidden, BIAS);
        if color {
            let features = last.rows(1, s.features);
            let (central, d_features) = (self.central_of(&b.hidden), self.central(&b.d_color_in));
            self.weight_gradient(features, c, d_features, central, BIAS);
            self.linear_back(features, c, d_features, self.central_of(&b.d_hidden), ADD, Some(central));
        }
        self.weight_gradient(first, n, d_hidden, self.lanes(&b.encoding), BIAS);
        self.linear_back(first, n, d_hidden, self.lanes(&b.d_encoding), 0, None);
    }

    /// The distance's gradient by the encoding on the central lanes.
    fn by_feature(&mut self, hidden: Rows<'_>) {
        let (s, b) = (self.plan.sizes, self.plan.buffers);
        let c = s.central_lanes();
        let [first, last] = self.plan.weights.geometry.map(Part::from);
        self.add(
            Kernel::ActiveUnits,
            &[c, hidden.stride, hidden.from, last.weights, c],
            &[&b.weights, hidden.buffer, &b.active],
            [(c / 4).div_ceil(WORKGROUP), s.hidden, 1],
        );
        self.linear_back(first, c, self.central(&b.active), self.central(&b.by_feature), 0, None);
    }

    /// Slopes of the distance, and unless only they are wanted the eikonal loss.
    fn slopes(&mut self, place_stride: u32, place_from: u32, only: bool) {
        let (s, b) = (self.plan.sizes, self.plan.buffers);
        let c = s.central_lanes();
        let mut params = self.levels();
        params.extend([self.plan.levels.len() as u32, c, c, place_stride, place_from, s.surface_rays]);
        let every = self.plan.config().eikonal_every.max(1) as u32;
        params.extend([every, u32::from(only), self.plan.truncation.to_bits()]);
        self.add(
            Kernel::Eikonal,
            &params,
            &[&b.schedule, &b.table, &b.places, &b.by_feature, &b.central, &b.gamma, &b.q, &b.lane_losses],
            Self::fold(c),
        );
    }

    fn eikonal(&mut self) {
        let (s, b) = (self.plan.sizes, self.plan.buffers);
        let c = s.central_lanes();
        let [first, last] = self.plan.weights.geometry.map(Part::from);
        let hidden = self.central_of(&b.hidden);
        self.by_feature(hidden);
        self.slopes(s.lanes(), s.central_from(), false);
        let (active, q, units) = (self.central(&b.active), self.central(&b.q), self.central(&b.units));
        self.weight_gradient(first, c, active, q, ADD);
        self.linear(first, c, q, units, 0, Some(hidden));
        // The row sums of W1 q over the active units are the gradient of the distance's weights.
        let sums = Part { inputs: 0, outputs: s.hidden, weights: 0, bias: last.weights };
        self.weight_gradient(sums, c, units, q, BIAS | ADD);
    }

    fn scatter(&mut self, color: bool) {
        let (s, b) = (self.plan.sizes, self.plan.buffers);
        let eikonal = self.plan.has_eikonal();
        let mut params = self.levels();
        params.extend([self.plan.levels.len() as u32, s.lanes(), s.central_from(), s.central_lanes()]);
        params.push(u32::from(eikonal));
        self.add(
            Kernel::Scatter,
            &params,
            &[
                &b.table,
                &b.places,
                &b.d_encoding,
                &b.gamma,
                &b.by_feature,
                &b.table_gradient,
                &b.touched,
                &b.d_places,
            ],
            Self::fold(s.lanes()),
        );
        let flags = u32::from(color) + 2 * u32::from(eikonal);
        self.add(
            Kernel::RayTwist,
            &[s.surface_rays, s.ring_rays, s.free, s.rows, s.central, s.features, s.lanes(), flags],
            &[&b.rays, &b.places, &b.d_places, &b.d_color_in, &b.lane_losses, &b.ray_losses, &b.twists],
            Self::fold(s.rays()),
        );
    }

    fn updates(&mut self) {
        let plan = self.plan;
        let (s, b, sampler) = (plan.sizes, plan.buffers, &plan.round.sampler);
        let [translation, rotation] = self.bounds();
        let (surface, ring) = (sampler.surface_frames.len() as u32, sampler.ring_frames.len() as u32);
        self.add(
            Kernel::AdamPoses,
            &[s.frames, s.surface_rays, s.ring_rays, surface, ring, translation, rotation],
            &[&b.schedule, &b.slots, &b.twists, &b.theta, &b.theta_moments, &b.theta_gradient],
            Self::fold(s.frames),
        );
        let weights = plan.weights.len;
        self.add(
            Kernel::AdamWeights,
            &[weights, s.chunks],
            &[&b.schedule, &b.weight_gradient, &b.weight_moments, &b.weights],
            [weights.div_ceil(WORKGROUP), 1, 1],
        );
        let groups = s.vertices / crate::grid::GROUP as u32;
        self.add(
            Kernel::AdamGrid,
            &[groups],
            &[&b.schedule, &b.touched, &b.table_gradient, &b.first_moments, &b.second_moments, &b.table],
            Self::fold(groups),
        );
        self.add(Kernel::Finish, &[s.rays()], &[&b.schedule, &b.ray_losses, &b.losses], [1, 1, 1]);
    }
}
