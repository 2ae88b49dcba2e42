// Gradient of a layer's weights, dW = dy x^T, and bias, the row sums of dy: a workgroup takes 32 outputs, 32 inputs
// and one of the chunks of lanes, and has the chunk's copy of the gradient for itself: no atomics, a fixed order.

struct Params {
    lanes: u32,
    inputs: u32,
    outputs: u32,
    weights_at: u32,
    bias_at: u32,
    dy_stride: u32,
    dy_from: u32,
    x_stride: u32,
    x_from: u32,
    // Numbers in a copy of the gradient.
    copy: u32,
    chunk_lanes: u32,
    // 1: has a bias, 8: add to what is there.
    flags: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> dy: array<f32>;
@group(0) @binding(2) var<storage, read> x: array<f32>;
@group(0) @binding(3) var<storage, read_write> gradient: array<f32>;

const DEPTH: u32 = 16u;
// One more than the depth keeps a column's rows in different memory banks.
const PITCH: u32 = 17u;

var<workgroup> left: array<f32, 544>;
var<workgroup> right: array<f32, 544>;

fn put(at: u32, value: f32) {
    if ((params.flags & 8u) != 0u) {
        gradient[at] += value;
    } else {
        gradient[at] = value;
    }
}

@compute @workgroup_size(8, 8)
fn main(
    @builtin(local_invocation_index) me: u32,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(workgroup_id) group: vec3<u32>,
) {
    let first_output = 32u * group.y;
    let first_input = 32u * group.x;
    let begin = min(group.z * params.chunk_lanes, params.lanes);
    let end = min(begin + params.chunk_lanes, params.lanes);
    var sum: array<vec4<f32>, 4>;
    var bias = vec4<f32>(0.0);
    for (var i = 0u; i < 4u; i++) {
        sum[i] = vec4<f32>(0.0);
    }
    for (var first = begin; first < end; first += DEPTH) {
        for (var e = me; e < 32u * DEPTH; e += WORKGROUP) {
            let row = e / DEPTH;
            let lane = first + e % DEPTH;
            let to = row * PITCH + e % DEPTH;
            left[to] = 0.0;
            right[to] = 0.0;
            if (lane < end && first_output + row < params.outputs) {
                left[to] = dy[(first_output + row) * params.dy_stride + params.dy_from + lane];
            }
            if (lane < end && first_input + row < params.inputs) {
                right[to] = x[(first_input + row) * params.x_stride + params.x_from + lane];
            }
        }
        workgroupBarrier();
        for (var k = 0u; k < DEPTH; k++) {
            let l = vec4<f32>(
                left[(4u * local.y) * PITCH + k],
                left[(4u * local.y + 1u) * PITCH + k],
                left[(4u * local.y + 2u) * PITCH + k],
                left[(4u * local.y + 3u) * PITCH + k],
            );
            let r = vec4<f32>(
                right[(4u * local.x) * PITCH + k],
                right[(4u * local.x + 1u) * PITCH + k],
                right[(4u * local.x + 2u) * PITCH + k],
                right[(4u * local.x + 3u) * PITCH + k],
            );
            sum[0] += l.x * r;
            sum[1] += l.y * r;
            sum[2] += l.z * r;
            sum[3] += l.w * r;
            bias += l;
        }
        workgroupBarrier();
    }
    let copy = group.z * params.copy;
    for (var j = 0u; j < 4u; j++) {
        let output = first_output + 4u * local.y + j;
        if (output >= params.outputs) {
            break;
        }
        for (var i = 0u; i < 4u; i++) {
            let input = first_input + 4u * local.x + i;
            if (input < params.inputs) {
                put(copy + params.weights_at + output * params.inputs + input, sum[j][i]);
            }
        }
        if ((params.flags & 1u) != 0u && group.x == 0u && local.x == 0u) {
            put(copy + params.bias_at + output, bias[j]);
        }
    }
}
