// One invocation a frame: adds up what its rays exert on its pose, in order, and updates the pose's parameters.

struct Params {
    frames: u32,
    surface_rays: u32,
    ring_rays: u32,
    surface_frames: u32,
    ring_frames: u32,
    bound_translation: f32,
    bound_rotation: f32,
    unused: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> schedule: Schedule;
// Per frame its place among the frames with surface rays and among those with ring rays; past the end if in none.
@group(0) @binding(2) var<storage, read> slots: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read> twists: array<f32>;
@group(0) @binding(4) var<storage, read_write> theta: array<f32>;
@group(0) @binding(5) var<storage, read_write> moments: array<vec2<f32>>;
// Gradient by the parameters, for whoever wants to look at it.
@group(0) @binding(6) var<storage, read_write> gradient: array<f32>;

struct Twist {
    force: vec3<f32>,
    torque: vec3<f32>,
}

// Sum over the rays that fell to the frame at `slot` of `frames` in this step.
fn sum_rays(first: u32, rays: u32, slot: u32, frames: u32) -> Twist {
    var sum: Twist;
    if (slot >= frames) {
        return sum;
    }
    let total = params.surface_rays + params.ring_rays;
    let step = schedule.steps[schedule.cursor].number;
    let base = ((step % frames) * (rays % frames)) % frames;
    for (var r = (slot + frames - base) % frames; r < rays; r += frames) {
        let at = first + r;
        sum.force += vec3<f32>(twists[at], twists[total + at], twists[2u * total + at]);
        sum.torque += vec3<f32>(twists[3u * total + at], twists[4u * total + at], twists[5u * total + at]);
    }
    return sum;
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let f = id.x;
    if (f >= params.frames) {
        return;
    }
    let surface = sum_rays(0u, params.surface_rays, slots[f].x, params.surface_frames);
    let ring = sum_rays(params.surface_rays, params.ring_rays, slots[f].y, params.ring_frames);
    let force = surface.force + ring.force;
    let torque = surface.torque + ring.torque;
    let at = 6u * f;
    let a = bounded3(vec3<f32>(theta[at], theta[at + 1u], theta[at + 2u]));
    let b = bounded3(vec3<f32>(theta[at + 3u], theta[at + 4u], theta[at + 5u]));
    let rho = params.bound_translation * a;
    let phi = params.bound_rotation * b;
    let c = series(dot(phi, phi));
    // The transpose of the left Jacobian turns the other way.
    let by_rho = turn(phi, force, -c.cosine, c.second);
    let by_phi = coupling_transposed(rho, phi, c, force) + turn(phi, torque, -c.cosine, c.second);
    let first = params.bound_translation * (1.0 - a * a) * by_rho;
    let second = params.bound_rotation * (1.0 - b * b) * by_phi;
    var g = array<f32, 6>(first.x, first.y, first.z, second.x, second.y, second.z);
    var finite = true;
    for (var i = 0u; i < 6u; i++) {
        gradient[at + i] = g[i];
        finite = finite && abs(g[i]) < 1e30;
    }
    let step = schedule.steps[schedule.cursor];
    if (!finite || step.pose_rate <= 0.0) {
        return;
    }
    for (var i = 0u; i < 6u; i++) {
        let old = moments[at + i];
        let m = vec2<f32>(0.9 * old.x + 0.1 * g[i], 0.999 * old.y + 0.001 * g[i] * g[i]);
        moments[at + i] = m;
        theta[at + i] -= step.pose_rate * m.x / (sqrt(m.y * step.pose_root) + 1e-15);
    }
}
