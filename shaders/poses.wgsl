// One invocation a frame: the corrected pose in edges of the volume about its centre, exp(xi) T.

struct Params {
    frames: u32,
    bound_translation: f32,
    bound_rotation: f32,
    unused: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
// Per frame the columns of the rotation and the translation, as given.
@group(0) @binding(1) var<storage, read> initial: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> theta: array<f32>;
@group(0) @binding(3) var<storage, read_write> poses: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let f = id.x;
    if (f >= params.frames) {
        return;
    }
    let at = 6u * f;
    let rho = params.bound_translation * bounded3(vec3<f32>(theta[at], theta[at + 1u], theta[at + 2u]));
    let phi = params.bound_rotation * bounded3(vec3<f32>(theta[at + 3u], theta[at + 4u], theta[at + 5u]));
    let c = series(dot(phi, phi));
    for (var column = 0u; column < 4u; column++) {
        var v = turn(phi, initial[4u * f + column].xyz, c.sine, c.cosine);
        if (column == 3u) {
            v += turn(phi, rho, c.cosine, c.second);
        }
        poses[4u * f + column] = vec4<f32>(v, 0.0);
    }
}
