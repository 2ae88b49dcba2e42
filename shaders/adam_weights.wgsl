// One invocation a weight of the networks: adds up the chunks' gradients in order, then Adam (Kingma and Ba 2015).

struct Params {
    weights: u32,
    chunks: u32,
    unused_a: u32,
    unused_b: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> schedule: Schedule;
@group(0) @binding(2) var<storage, read> gradient: array<f32>;
@group(0) @binding(3) var<storage, read_write> moments: array<vec2<f32>>;
@group(0) @binding(4) var<storage, read_write> weights: array<f32>;

const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = id.x;
    if (i >= params.weights) {
        return;
    }
    var g = 0.0;
    for (var c = 0u; c < params.chunks; c++) {
        g += gradient[c * params.weights + i];
    }
    let step = schedule.steps[schedule.cursor];
    let old = moments[i];
    let m = vec2<f32>(BETA1 * old.x + (1.0 - BETA1) * g, BETA2 * old.y + (1.0 - BETA2) * g * g);
    moments[i] = m;
    weights[i] -= step.rate * m.x / (sqrt(m.y * step.root) + 1e-15);
}
