// One invocation a group of eight vertices: Adam on their sixteen features if one of them had a gradient in this step.

struct Params {
    groups: u32,
    unused_a: u32,
    unused_b: u32,
    unused_c: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> schedule: Schedule;
@group(0) @binding(2) var<storage, read_write> touched: array<u32>;
@group(0) @binding(3) var<storage, read_write> gradient: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> first_moments: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> second_moments: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> table: array<vec4<f32>>;

const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let group = linear_id(id, groups);
    if (group >= params.groups || touched[group] == 0u) {
        return;
    }
    touched[group] = 0u;
    let step = schedule.steps[schedule.cursor];
    for (var i = 4u * group; i < 4u * group + 4u; i++) {
        let g = gradient[i];
        let m = BETA1 * first_moments[i] + (1.0 - BETA1) * g;
        let v = BETA2 * second_moments[i] + (1.0 - BETA2) * g * g;
        first_moments[i] = m;
        second_moments[i] = v;
        table[i] -= step.rate * m / (sqrt(v * step.root) + 1e-15);
        gradient[i] = vec4<f32>(0.0);
    }
}
