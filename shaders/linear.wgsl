// A layer of a network, y = W x + b: four lanes and eight outputs an invocation.

struct Params {
    lanes: u32,
    inputs: u32,
    outputs: u32,
    // In numbers; `weights_at` is a multiple of 4.
    weights_at: u32,
    bias_at: u32,
    // Lanes from one row to the next and lane of the first column, multiples of 4.
    x_stride: u32,
    x_from: u32,
    y_stride: u32,
    y_from: u32,
    gate_stride: u32,
    gate_from: u32,
    // 1: add the bias, 2: no negative outputs, 4: zero where the gate is not positive.
    flags: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> weights: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> x: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> gate: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> y: array<vec4<f32>>;

const BLOCK: u32 = 8u;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let quad = id.x;
    if (4u * quad >= params.lanes) {
        return;
    }
    let first = id.y * BLOCK;
    let inputs = params.inputs / 4u;
    var row: array<u32, 8>;
    var sum: array<vec4<f32>, 8>;
    for (var o = 0u; o < BLOCK; o++) {
        // Rows past the end are computed twice and not written.
        let output = min(first + o, params.outputs - 1u);
        row[o] = params.weights_at / 4u + output * inputs;
        sum[o] = vec4<f32>(0.0);
        if ((params.flags & 1u) != 0u) {
            let b = params.bias_at + output;
            sum[o] = vec4<f32>(weights[b / 4u][b % 4u]);
        }
    }
    let stride = params.x_stride / 4u;
    var at = params.x_from / 4u + quad;
    for (var i = 0u; i < inputs; i++) {
        let x0 = x[at];
        let x1 = x[at + stride];
        let x2 = x[at + 2u * stride];
        let x3 = x[at + 3u * stride];
        at += 4u * stride;
        for (var o = 0u; o < BLOCK; o++) {
            let w = weights[row[o] + i];
            sum[o] += w.x * x0 + w.y * x1 + w.z * x2 + w.w * x3;
        }
    }
    for (var o = 0u; o < BLOCK; o++) {
        let output = first + o;
        if (output >= params.outputs) {
            break;
        }
        var value = sum[o];
        if ((params.flags & 2u) != 0u) {
            value = max(value, vec4<f32>(0.0));
        }
        if ((params.flags & 4u) != 0u) {
            let g = gate[(output * params.gate_stride + params.gate_from) / 4u + quad];
            value = select(vec4<f32>(0.0), value, g > vec4<f32>(0.0));
        }
        y[(output * params.y_stride + params.y_from) / 4u + quad] = value;
    }
}
