// One invocation a central lane: the harmonics of its view direction, below the geometry features.

struct Params {
    lanes: u32,
    stride: u32,
    features: u32,
    surface_rays: u32,
    // 1: directions are those of the rays; 0: they are given per lane.
    from_rays: u32,
    unused_a: u32,
    unused_b: u32,
    unused_c: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> rays: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> directions: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> color_in: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let lane = linear_id(id, groups);
    if (lane >= params.lanes) {
        return;
    }
    var dir = directions[lane].xyz;
    if (params.from_rays == 1u) {
        dir = rays[3u * (lane % params.surface_rays) + 1u].xyz;
    }
    var bands = harmonics(dir);
    for (var k = 0u; k < HARMONICS; k++) {
        color_in[(params.features + k) * params.stride + lane] = bands[k];
    }
}
