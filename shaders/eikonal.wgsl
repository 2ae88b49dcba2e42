// One invocation a central lane: the slope of the distance, the eikonal loss, and what its gradient needs (eikonal.rs):
// gamma, the gradient by the slope, and q, the encoding's derivative along gamma.

struct Params {
    levels: array<vec4<u32>, 16>,
    count: u32,
    lanes: u32,
    stride: u32,
    place_stride: u32,
    place_from: u32,
    surface_rays: u32,
    // The term runs on every n-th group of four rays.
    every: u32,
    // 1: only the slope is wanted, in the place of gamma.
    slope_only: u32,
    // Truncation distance in edges.
    truncation: f32,
    unused_a: u32,
    unused_b: u32,
    unused_c: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> schedule: Schedule;
@group(0) @binding(2) var<storage, read> table: array<vec2<f32>>;
@group(0) @binding(3) var<storage, read> places: array<f32>;
// Gradient of the distance by the encoding, [feature][lane].
@group(0) @binding(4) var<storage, read> by_feature: array<f32>;
@group(0) @binding(5) var<storage, read> central: array<vec2<f32>>;
// The fourth number says whether the term runs on the lane; with `slope_only` none is used.
@group(0) @binding(6) var<storage, read_write> gamma: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> q: array<f32>;
@group(0) @binding(8) var<storage, read_write> lane_losses: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let lane = linear_id(id, groups);
    if (lane >= params.lanes) {
        return;
    }
    let at = params.place_from + lane;
    let p = vec3<f32>(places[at], places[params.place_stride + at], places[2u * params.place_stride + at]);
    var slope = vec3<f32>(0.0);
    for (var l = 0u; l < params.count; l++) {
        let level = params.levels[l];
        let cell = cell_around(level, p);
        let d = interpolate(level, cell_features(cell), cell.frac);
        let v = vec2<f32>(
            by_feature[2u * l * params.stride + lane],
            by_feature[(2u * l + 1u) * params.stride + lane],
        );
        slope += vec3<f32>(dot(v, d.by_x), dot(v, d.by_y), dot(v, d.by_z));
    }
    if (params.slope_only == 1u) {
        gamma[lane] = vec4<f32>(slope, 0.0);
        return;
    }
    let group = (lane % params.surface_rays) / 4u;
    let runs = (group + schedule.steps[schedule.cursor].number) % params.every == 0u;
    let weight = select(0.0, central[lane].y, runs);
    let norm = sqrt(dot(slope, slope));
    let error = params.truncation * norm - 1.0;
    var g = vec3<f32>(0.0);
    if (norm > 0.0) {
        g = (2.0 * weight * error * params.truncation / norm) * slope;
    }
    lane_losses[lane] = weight * error * error;
    gamma[lane] = vec4<f32>(g, select(0.0, 1.0, runs));
    for (var l = 0u; l < params.count; l++) {
        let level = params.levels[l];
        let cell = cell_around(level, p);
        let d = interpolate(level, cell_features(cell), cell.frac);
        let along = g.x * d.by_x + g.y * d.by_y + g.z * d.by_z;
        q[2u * l * params.stride + lane] = along.x;
        q[(2u * l + 1u) * params.stride + lane] = along.y;
    }
}
