// Four central lanes of one hidden unit an invocation: the unit's weight in the distance where it is active, else 0.

struct Params {
    lanes: u32,
    hidden_stride: u32,
    hidden_from: u32,
    weights_at: u32,
    stride: u32,
    unused_a: u32,
    unused_b: u32,
    unused_c: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> weights: array<f32>;
@group(0) @binding(2) var<storage, read> hidden: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> active_weights: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let quad = id.x;
    if (4u * quad >= params.lanes) {
        return;
    }
    let unit = id.y;
    let h = hidden[(unit * params.hidden_stride + params.hidden_from) / 4u + quad];
    let w = vec4<f32>(weights[params.weights_at + unit]);
    active_weights[unit * params.stride / 4u + quad] = select(vec4<f32>(0.0), w, h > vec4<f32>(0.0));
}
