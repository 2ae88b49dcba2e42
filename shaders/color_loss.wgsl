// One invocation a surface ray: blends the colours of its central samples, their loss, and in place of the network's
// outputs (before the sigmoid) their gradients.

struct Params {
    surface_rays: u32,
    ring_rays: u32,
    central: u32,
    unused: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> rays: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> central: array<vec2<f32>>;
@group(0) @binding(3) var<storage, read_write> rgb: array<f32>;
@group(0) @binding(4) var<storage, read_write> ray_losses: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let ray = id.x;
    let n = params.surface_rays;
    if (ray >= n) {
        return;
    }
    let measured = rays[3u * ray + 2u];
    var total = 0.0;
    for (var channel = 0u; channel < 3u; channel++) {
        let row = channel * n * params.central;
        var blended = 0.0;
        for (var k = 0u; k < params.central; k++) {
            let at = row + k * n + ray;
            let value = 1.0 / (1.0 + exp(-rgb[at]));
            rgb[at] = value;
            blended += value * central[k * n + ray].x;
        }
        let error = blended - measured[channel];
        total += measured.w * error * error;
        for (var k = 0u; k < params.central; k++) {
            let at = row + k * n + ray;
            let value = rgb[at];
            rgb[at] = 2.0 * measured.w * error * central[k * n + ray].x * value * (1.0 - value);
        }
    }
    ray_losses[3u * (n + params.ring_rays) + ray] = total;
}
