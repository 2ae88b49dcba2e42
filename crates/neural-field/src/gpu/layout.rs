//! The networks' weights as the kernels want them: every layer starts at a multiple of four numbers.

use crate::mlp::{Layer, Networks};

/// A layer's place in the device's vector of weights.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Placed {
    layer: Layer,
    pub(crate) inputs: u32,
    pub(crate) outputs: u32,
    pub(crate) weights: u32,
    pub(crate) bias: u32,
}

/// All layers.
#[derive(Clone, Copy, Debug)]
pub(crate) struct WeightLayout {
    pub(crate) geometry: [Placed; 2],
    pub(crate) color: [Placed; 3],
    /// Numbers in all, with gaps; a multiple of four.
    pub(crate) len: u32,
}

impl WeightLayout {
    pub(crate) fn new(networks: &Networks) -> Self {
        let mut len = 0;
        let mut place = |layer: Layer| {
            let (inputs, outputs) = (layer.inputs as u32, layer.outputs as u32);
            let placed = Placed { layer, inputs, outputs, weights: len, bias: len + inputs * outputs };
            len = (placed.bias + outputs).next_multiple_of(4);
            placed
        };
        Self { geometry: networks.geometry.map(&mut place), color: networks.color.map(&mut place), len }
    }

    fn layers(&self) -> impl Iterator<Item = &Placed> {
        self.geometry.iter().chain(&self.color)
    }

    /// From the CPU's flat vector to the device's.
    pub(crate) fn for_device(&self, flat: &[f32]) -> Vec<f32> {
        let mut out = vec![0.0; self.len as usize];
        for l in self.layers() {
            let (from, to) = (l.layer.weights().start..l.layer.bias().end, l.weights as usize);
            out[to..to + from.len()].copy_from_slice(&flat[from]);
        }
        out
    }

    /// And back.
    pub(crate) fn of_device(&self, device: &[f32], flat: &mut [f32]) {
        for l in self.layers() {
            let (to, from) = (l.layer.weights().start..l.layer.bias().end, l.weights as usize);
            let len = to.len();
            flat[to].copy_from_slice(&device[from..from + len]);
        }
    }
}
