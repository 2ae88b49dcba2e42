// Gradient of a layer's input from that of its output, dx = W^T dy: four lanes and eight inputs an invocation.

struct Params {
    lanes: u32,
    inputs: u32,
    outputs: u32,
    weights_at: u32,
    dy_stride: u32,
    dy_from: u32,
    dx_stride: u32,
    dx_from: u32,
    gate_stride: u32,
    gate_from: u32,
    // 4: zero where the gate is not positive, 8: add to what is there.
    flags: u32,
    unused: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> weights: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> dy: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> gate: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> dx: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let quad = id.x;
    if (4u * quad >= params.lanes) {
        return;
    }
    var sum: array<vec4<f32>, 8>;
    for (var i = 0u; i < 8u; i++) {
        sum[i] = vec4<f32>(0.0);
    }
    var column = params.weights_at / 4u + 2u * id.y;
    var at = params.dy_from / 4u + quad;
    for (var j = 0u; j < params.outputs; j++) {
        let d = dy[at];
        let a = weights[column];
        let b = weights[column + 1u];
        at += params.dy_stride / 4u;
        column += params.inputs / 4u;
        sum[0] += a.x * d;
        sum[1] += a.y * d;
        sum[2] += a.z * d;
        sum[3] += a.w * d;
        sum[4] += b.x * d;
        sum[5] += b.y * d;
        sum[6] += b.z * d;
        sum[7] += b.w * d;
    }
    for (var i = 0u; i < 8u; i++) {
        let input = 8u * id.y + i;
        var value = sum[i];
        if ((params.flags & 4u) != 0u) {
            let g = gate[(input * params.gate_stride + params.gate_from) / 4u + quad];
            value = select(vec4<f32>(0.0), value, g > vec4<f32>(0.0));
        }
        let to = (input * params.dx_stride + params.dx_from) / 4u + quad;
        if ((params.flags & 8u) != 0u) {
            value += dx[to];
        }
        dx[to] = value;
    }
}
