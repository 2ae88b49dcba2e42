// Real spherical harmonics of bands 0 to 2 (harmonics.rs).

const HARMONICS: u32 = 9u;
const K1: f32 = 0.48860251190292;
const K2: f32 = 1.09254843059208;
const K20: f32 = 0.31539156525252;
const K22: f32 = 0.54627421529604;

fn harmonics(d: vec3<f32>) -> array<f32, 9> {
    return array<f32, 9>(
        0.282094791773878,
        -(K1 * d.y),
        K1 * d.z,
        -(K1 * d.x),
        K2 * d.x * d.y,
        -(K2 * d.y * d.z),
        K20 * (3.0 * d.z * d.z - 1.0),
        -(K2 * d.x * d.z),
        K22 * (d.x * d.x - d.y * d.y),
    );
}

// Their derivatives by the components of `d`.
fn harmonic_slopes(d: vec3<f32>) -> array<vec3<f32>, 9> {
    return array<vec3<f32>, 9>(
        vec3<f32>(0.0),
        vec3<f32>(0.0, -K1, 0.0),
        vec3<f32>(0.0, 0.0, K1),
        vec3<f32>(-K1, 0.0, 0.0),
        vec3<f32>(K2 * d.y, K2 * d.x, 0.0),
        vec3<f32>(0.0, -(K2 * d.z), -(K2 * d.y)),
        vec3<f32>(0.0, 0.0, 6.0 * K20 * d.z),
        vec3<f32>(-(K2 * d.z), 0.0, -(K2 * d.x)),
        vec3<f32>(2.0 * K22 * d.x, -(2.0 * K22 * d.y), 0.0),
    );
}
