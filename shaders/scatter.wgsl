// One invocation a lane: hands the encoding's gradient to the vertices of all lattices and to the place.

struct Params {
    levels: array<vec4<u32>, 16>,
    count: u32,
    lanes: u32,
    // First central lane and their number.
    central_from: u32,
    central: u32,
    // 1: the eikonal term is on.
    eikonal: u32,
    unused_a: u32,
    unused_b: u32,
    unused_c: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> table: array<vec2<f32>>;
@group(0) @binding(2) var<storage, read> places: array<f32>;
@group(0) @binding(3) var<storage, read> d_encoding: array<f32>;
@group(0) @binding(4) var<storage, read> gamma: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> by_feature: array<f32>;
@group(0) @binding(6) var<storage, read_write> sums: array<atomic<Word>>;
// Groups of eight vertices with a gradient in this step.
@group(0) @binding(7) var<storage, read_write> touched: array<atomic<u32>>;
@group(0) @binding(8) var<storage, read_write> d_places: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let lane = linear_id(id, groups);
    if (lane >= params.lanes) {
        return;
    }
    let n = params.lanes;
    let p = vec3<f32>(places[lane], places[n + lane], places[2u * n + lane]);
    let c = lane - min(params.central_from, lane);
    var g = vec4<f32>(0.0);
    if (params.eikonal == 1u && lane >= params.central_from) {
        g = gamma[c];
    }
    let sloped = g.w > 0.0;
    var by_place = vec3<f32>(0.0);
    for (var l = 0u; l < params.count; l++) {
        let value = vec2<f32>(d_encoding[2u * l * n + lane], d_encoding[(2u * l + 1u) * n + lane]);
        if (all(value == vec2<f32>(0.0)) && !sloped) {
            continue;
        }
        let level = params.levels[l];
        let scale = bitcast<f32>(level.w);
        let cell = cell_around(level, p);
        let features = cell_features(cell);
        let d = interpolate(level, features, cell.frac);
        by_place += vec3<f32>(dot(value, d.by_x), dot(value, d.by_y), dot(value, d.by_z));
        var v = vec2<f32>(0.0);
        if (sloped) {
            v = vec2<f32>(
                by_feature[2u * l * params.central + c],
                by_feature[(2u * l + 1u) * params.central + c],
            );
            let m = mixed_derivatives(level, features, cell.frac);
            let mixed = vec3<f32>(dot(v, m.xy), dot(v, m.xz), dot(v, m.yz));
            by_place += vec3<f32>(
                g.y * mixed.x + g.z * mixed.y,
                g.x * mixed.x + g.z * mixed.z,
                g.x * mixed.y + g.y * mixed.z,
            );
        }
        let f = cell.frac;
        let opposite = vec3<f32>(1.0) - f;
        for (var corner = 0u; corner < 8u; corner++) {
            let up = (vec3<u32>(corner) & vec3<u32>(1u, 2u, 4u)) != vec3<u32>(0u);
            let w = select(opposite, f, up);
            let sign = select(vec3<f32>(-1.0), vec3<f32>(1.0), up);
            let slope = scale
                * (g.x * sign.x * w.y * w.z + g.y * sign.y * w.x * w.z + g.z * sign.z * w.x * w.y);
            let add = w.x * w.y * w.z * value + slope * v;
            let row = cell.rows[corner >> 1u];
            let vertex = select(row.x, row.y, up.x);
            add_to_sum(2u * vertex, add.x);
            add_to_sum(2u * vertex + 1u, add.y);
            atomicStore(&touched[vertex / 8u], 1u);
        }
    }
    d_places[lane] = by_place.x;
    d_places[n + lane] = by_place.y;
    d_places[2u * n + lane] = by_place.z;
}
