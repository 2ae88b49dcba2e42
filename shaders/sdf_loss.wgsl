// One invocation a ray: losses on the signed distance (truncation units) of its samples, and their gradients.

struct Params {
    surface_rays: u32,
    ring_rays: u32,
    free: u32,
    rows: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> samples: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> sdf: array<f32>;
@group(0) @binding(3) var<storage, read_write> d_sdf: array<f32>;
// Per loss (uncertain, empty, surface, colour, eikonal) a row of all rays.
@group(0) @binding(4) var<storage, read_write> ray_losses: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let ray = id.x;
    let rays = params.surface_rays + params.ring_rays;
    if (ray >= rays) {
        return;
    }
    let ring = ray >= params.surface_rays;
    let first = select(params.ring_rays * params.free + ray, ray - params.surface_rays, ring);
    let stride = select(params.surface_rays, params.ring_rays, ring);
    let rows = select(params.rows, params.free, ring);
    var losses = vec3<f32>(0.0);
    for (var k = 0u; k < rows; k++) {
        let lane = first + k * stride;
        let s = sdf[lane];
        let sample = samples[lane];
        let off = s - sample.y;
        let below = max(-off, 0.0);
        var slope = select(0.0, -sample.w, below > 0.0);
        losses.y += sample.w * below;
        if (ring) {
            losses.x += sample.z * below * below;
            slope -= 2.0 * sample.z * below;
        } else {
            losses.z += sample.z * off * off;
            slope += 2.0 * sample.z * off;
        }
        d_sdf[lane] = slope;
    }
    ray_losses[ray] = losses.x;
    ray_losses[rays + ray] = losses.y;
    ray_losses[2u * rays + ray] = losses.z;
    ray_losses[3u * rays + ray] = 0.0;
    ray_losses[4u * rays + ray] = 0.0;
}
