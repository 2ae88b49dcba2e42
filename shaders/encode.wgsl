// One invocation a lane: its place in the unit cube and the features of all lattices there.

struct Params {
    levels: array<vec4<u32>, 16>,
    count: u32,
    lanes: u32,
    // Lanes from one feature or axis to the next.
    stride: u32,
    surface_rays: u32,
    ring_rays: u32,
    ring_lanes: u32,
    // 1: places come from rays and samples; 0: they are given.
    from_rays: u32,
    unused: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> table: array<vec2<f32>>;
@group(0) @binding(2) var<storage, read> rays: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> samples: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> places: array<f32>;
@group(0) @binding(5) var<storage, read_write> encoding: array<f32>;

fn ray_of(lane: u32) -> u32 {
    if (lane < params.ring_lanes) {
        return params.surface_rays + lane % params.ring_rays;
    }
    return (lane - params.ring_lanes) % params.surface_rays;
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let lane = linear_id(id, groups);
    if (lane >= params.lanes) {
        return;
    }
    var p: vec3<f32>;
    if (params.from_rays == 1u) {
        let ray = 3u * ray_of(lane);
        p = 0.5 + rays[ray].xyz + rays[ray + 1u].xyz * samples[lane].x;
        places[lane] = p.x;
        places[params.stride + lane] = p.y;
        places[2u * params.stride + lane] = p.z;
    } else {
        p = vec3<f32>(places[lane], places[params.stride + lane], places[2u * params.stride + lane]);
    }
    for (var l = 0u; l < params.count; l++) {
        let level = params.levels[l];
        let cell = cell_around(level, p);
        let value = interpolate(level, cell_features(cell), cell.frac).value;
        encoding[2u * l * params.stride + lane] = value.x;
        encoding[(2u * l + 1u) * params.stride + lane] = value.y;
    }
}
