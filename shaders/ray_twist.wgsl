// One invocation a ray: force and torque about the volume's centre that its samples exert on its pose.

struct Params {
    surface_rays: u32,
    ring_rays: u32,
    free: u32,
    rows: u32,
    central: u32,
    features: u32,
    lanes: u32,
    // 1: colour is on, 2: the eikonal term is on.
    flags: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> rays: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> places: array<f32>;
@group(0) @binding(3) var<storage, read> d_places: array<f32>;
@group(0) @binding(4) var<storage, read> d_color_in: array<f32>;
@group(0) @binding(5) var<storage, read> lane_losses: array<f32>;
@group(0) @binding(6) var<storage, read_write> ray_losses: array<f32>;
// Six rows of all rays, force first.
@group(0) @binding(7) var<storage, read_write> twists: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let ray = id.x;
    let total = params.surface_rays + params.ring_rays;
    if (ray >= total) {
        return;
    }
    let n = params.lanes;
    let ring = ray >= params.surface_rays;
    let first = select(params.ring_rays * params.free + ray, ray - params.surface_rays, ring);
    let stride = select(params.surface_rays, params.ring_rays, ring);
    let rows = select(params.rows, params.free, ring);
    var force = vec3<f32>(0.0);
    var torque = vec3<f32>(0.0);
    for (var k = 0u; k < rows; k++) {
        let lane = first + k * stride;
        let p = vec3<f32>(places[lane], places[n + lane], places[2u * n + lane]) - 0.5;
        let d = vec3<f32>(d_places[lane], d_places[n + lane], d_places[2u * n + lane]);
        force += d;
        torque += cross(p, d);
    }
    if (!ring && (params.flags & 1u) != 0u) {
        let dir = rays[3u * ray + 1u].xyz;
        var slopes = harmonic_slopes(dir);
        var by_dir = vec3<f32>(0.0);
        for (var h = 0u; h < HARMONICS; h++) {
            let row = (params.features + h) * params.surface_rays * params.central;
            var sum = 0.0;
            for (var k = 0u; k < params.central; k++) {
                sum += d_color_in[row + k * params.surface_rays + ray];
            }
            by_dir += sum * slopes[h];
        }
        torque += cross(dir, by_dir);
    }
    if (!ring && (params.flags & 2u) != 0u) {
        var sum = 0.0;
        for (var k = 0u; k < params.central; k++) {
            sum += lane_losses[k * params.surface_rays + ray];
        }
        ray_losses[4u * total + ray] = sum;
    }
    twists[ray] = force.x;
    twists[total + ray] = force.y;
    twists[2u * total + ray] = force.z;
    twists[3u * total + ray] = torque.x;
    twists[4u * total + ray] = torque.y;
    twists[5u * total + ray] = torque.z;
}
