// One invocation a ray: draws the ray, its samples over the occupied space and around the measured depth, their
// targets and weights (sampler.rs). Lanes: first the ring rays' samples, then those of the surface rays, the
// central ones last; within a block, sample k of ray r is lane k * rays + r.

struct Params {
    // Minimum corner of the occupancy and edge of a voxel, metres.
    origin: vec4<f32>,
    // Voxels along each axis.
    dims: vec4<u32>,
    // Bricks of 4 voxels a side along each axis.
    bricks: vec4<u32>,
    // Centre and edge of the field's volume, metres.
    center: vec4<f32>,
    seed: vec2<u32>,
    surface_rays: u32,
    ring_rays: u32,
    surface_frames: u32,
    ring_frames: u32,
    free: u32,
    band: u32,
    central: u32,
    central_from: u32,
    truncation: f32,
    behind: f32,
    falloff_rate: f32,
    sharpness: f32,
    first_frame_weight: f32,
    w_surface: f32,
    w_empty: f32,
    w_color: f32,
    w_eikonal: f32,
    w_ring_empty: f32,
    w_ring_uncertain: f32,
    free_distance: f32,
    epsilon: f32,
    unused: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> schedule: Schedule;
@group(0) @binding(2) var<storage, read> poses: array<vec4<f32>>;
// Frames with surface rays, then frames with ring rays: frame, first candidate, candidates.
@group(0) @binding(3) var<storage, read> frames: array<vec4<u32>>;
// Three vectors a candidate: direction and distance (ring: limit, negative for an empty ray), colour and cosine, depth of
// the object (ring: clearance; both truncation units).
@group(0) @binding(4) var<storage, read> candidates: array<vec4<f32>>;
// A mask of 64 voxels a brick.
@group(0) @binding(5) var<storage, read> occupancy: array<vec2<u32>>;
// Three vectors a ray: origin (edges, about the centre), direction (object), colour and weight of the colour loss.
@group(0) @binding(6) var<storage, read_write> rays: array<vec4<f32>>;
// Distance (edges), target or least distance (truncation units), weight of the surface loss (ring: of the uncertain
// loss), of the empty loss.
@group(0) @binding(7) var<storage, read_write> samples: array<vec4<f32>>;
// Per central lane: share in the ray's colour, weight of the eikonal loss.
@group(0) @binding(8) var<storage, read_write> central: array<vec2<f32>>;

// A walk along a ray from voxel to voxel.
struct Walk {
    origin: vec3<f32>,
    dir: vec3<f32>,
    // The plane at coordinate k of an axis is at the parameter k * slope + offset.
    slope: vec3<f32>,
    offset: vec3<f32>,
    cell: vec3<i32>,
    t: f32,
    end: f32,
    steps: u32,
}

const FAR: f32 = 1e30;

fn begin_walk(origin: vec3<f32>, dir: vec3<f32>, end: f32) -> Walk {
    var w: Walk;
    let size = params.origin.w;
    w.origin = (origin - params.origin.xyz) / size;
    w.dir = dir / size;
    w.t = 0.0;
    w.end = min(end, FAR);
    w.steps = 4u * (params.dims.x + params.dims.y + params.dims.z) + 16u;
    for (var a = 0; a < 3; a++) {
        let extent = f32(params.dims[a]);
        if (abs(w.dir[a]) < 1e-20) {
            w.slope[a] = 0.0;
            w.offset[a] = FAR;
            if (w.origin[a] < 0.0 || w.origin[a] >= extent) {
                w.steps = 0u;
            }
        } else {
            w.slope[a] = 1.0 / w.dir[a];
            w.offset[a] = -w.origin[a] * w.slope[a];
            let far = extent * w.slope[a] + w.offset[a];
            w.t = max(w.t, min(w.offset[a], far));
            w.end = min(w.end, max(w.offset[a], far));
        }
    }
    if (!(w.t < w.end)) {
        w.steps = 0u;
    }
    w.cell = clamp(vec3<i32>(w.origin + w.t * w.dir), vec3<i32>(0), vec3<i32>(params.dims.xyz) - 1);
    return w;
}

// The next interval inside occupied voxels; from >= to when there is none left.
fn next_interval(walk: ptr<function, Walk>) -> vec2<f32> {
    var w = *walk;
    let ascends = w.dir > vec3<f32>(0.0);
    let last = vec3<i32>(params.dims.xyz) - 1;
    var inside = false;
    var start = 0.0;
    while (w.steps > 0u && w.t < w.end && all(w.cell >= vec3<i32>(0)) && all(w.cell <= last)) {
        w.steps -= 1u;
        let c = vec3<u32>(w.cell);
        let b = c >> vec3<u32>(2u);
        let mask = occupancy[(b.z * params.bricks.y + b.y) * params.bricks.x + b.x];
        let v = c & vec3<u32>(3u);
        let bit = v.x | (v.y << 2u) | (v.z << 4u);
        var occupied = ((select(mask.x, mask.y, bit >= 32u) >> (bit & 31u)) & 1u) != 0u;
        let whole = all(mask == vec2<u32>(0u)) || all(mask == vec2<u32>(0xffffffffu));
        let size = select(1, 4, whole);
        if (occupied && !inside) {
            inside = true;
            start = w.t;
        } else if (!occupied && inside) {
            inside = false;
            if (w.t > start) {
                *walk = w;
                return vec2<f32>(start, w.t);
            }
        }
        // Through the nearest of the three planes ahead into the next block.
        let low = w.cell & vec3<i32>(-size);
        let leave = low + select(vec3<i32>(0), vec3<i32>(size), ascends);
        let at = vec3<f32>(leave) * w.slope + w.offset;
        var axis = select(0, 1, at.y < at.x);
        if (at.z < at[axis]) {
            axis = 2;
        }
        w.t = max(at[axis], w.t);
        if (whole) {
            let least = select(low, w.cell, ascends);
            let most = select(w.cell, low + size - 1, ascends);
            w.cell = clamp(vec3<i32>(w.origin + w.t * w.dir), least, most);
        }
        w.cell[axis] = select(leave[axis] - 1, leave[axis], ascends[axis]);
    }
    w.steps = 0u;
    *walk = w;
    return select(vec2<f32>(0.0), vec2<f32>(start, min(w.t, w.end)), inside);
}

// Stratified samples over the occupied intervals, one after the other.
struct Strata {
    walk: Walk,
    current: vec2<f32>,
    before: f32,
    total: f32,
}

fn begin_strata(start: Walk) -> Strata {
    // Pointers into structures can't be arguments everywhere: walks are copied in and out.
    var walk = start;
    var s: Strata;
    loop {
        let interval = next_interval(&walk);
        if (interval.x >= interval.y) {
            break;
        }
        s.total += interval.y - interval.x;
    }
    walk = start;
    s.current = next_interval(&walk);
    s.walk = walk;
    return s;
}

fn next_stratum(strata: ptr<function, Strata>, share: f32) -> f32 {
    var s = *strata;
    let at = share * s.total;
    loop {
        let span = s.current.y - s.current.x;
        if (at - s.before <= span) {
            break;
        }
        var walk = s.walk;
        let next = next_interval(&walk);
        s.walk = walk;
        if (next.x >= next.y) {
            break;
        }
        s.before += span;
        s.current = next;
    }
    *strata = s;
    return clamp(s.current.x + (at - s.before), s.current.x, s.current.y);
}

fn object_ray(ray: u32, frame: u32, dir: vec3<f32>) -> vec3<f32> {
    let at = 4u * frame;
    let turned = poses[at].xyz * dir.x + poses[at + 1u].xyz * dir.y + poses[at + 2u].xyz * dir.z;
    rays[3u * ray] = vec4<f32>(poses[at + 3u].xyz, f32(frame));
    rays[3u * ray + 1u] = vec4<f32>(turned, 0.0);
    return turned;
}

fn in_cube(origin: vec3<f32>, dir: vec3<f32>, t: f32) -> bool {
    return all(abs(origin + t * dir - params.center.xyz) <= vec3<f32>(0.4999 * params.center.w));
}

fn surface_ray(r: u32) {
    let n = params.surface_rays;
    let step = schedule.steps[schedule.cursor].number;
    let slot = ((step % params.surface_frames) * (n % params.surface_frames) + r) % params.surface_frames;
    let source = frames[slot];
    var draws = Draws(vec3<u32>(params.seed.x, params.seed.y + step, 2u * r), 0u, vec4<u32>(0u));
    let candidate = 3u * (source.y + pick(&draws, source.z));
    let dir_distance = candidates[candidate];
    let color_cosine = candidates[candidate + 1u];
    let behind = min(params.behind, candidates[candidate + 2u].x);
    let d = dir_distance.w;
    let cosine = color_cosine.w;
    let edge = params.center.w;
    let weight = select(1.0, params.first_frame_weight, source.x == 0u);
    let dir = object_ray(r, source.x, dir_distance.xyz);
    let origin = rays[3u * r].xyz * edge + params.center.xyz;
    let far = d + params.behind * params.truncation;

    var strata = begin_strata(begin_walk(origin, dir, far));
    let hit = strata.total > 0.0;
    let first = params.ring_rays * params.free;
    let rows = params.free + params.band;
    let outer = rows - params.central;
    var bell_sum = 1e-10;
    for (var k = 0u; k < rows; k++) {
        let u = uniform_number(&draws);
        var row = k;
        var t = d;
        if (k < params.free) {
            let share = (f32(k) + u) / f32(params.free);
            if (hit) {
                t = next_stratum(&strata, share);
            } else {
                // The pose has moved the ray out of the occupied space: keep to the space before the surface.
                let begin = d - 3.0 * params.truncation;
                t = clamp(begin + share * (d - begin), begin, d);
            }
        } else {
            let b = k - params.free;
            let begin = d - params.truncation;
            t = clamp(begin + (f32(b) + u) * ((far - begin) / f32(params.band)), begin, far);
            if (b >= params.central_from + params.central) {
                row = k - params.central;
            } else if (b >= params.central_from) {
                row = outer + (b - params.central_from);
            }
        }
        let target_distance = (d - t) * cosine / params.truncation;
        let inside = in_cube(origin, dir, t);
        let near = inside && abs(target_distance) <= 1.0 && target_distance >= -behind - 1e-3;
        let far_from_middle = target_distance * params.falloff_rate;
        let falloff = 1.0 / (1.0 + far_from_middle * far_from_middle);
        let w_surface = cosine * cosine * weight * params.w_surface * falloff;
        samples[first + row * n + r] = vec4<f32>(
            t / edge,
            select(target_distance, params.free_distance, target_distance > 1.0),
            select(0.0, w_surface, near),
            select(0.0, weight * params.w_empty, inside && target_distance > 1.0),
        );
        if (row >= outer) {
            let e = exp(-params.sharpness * target_distance);
            let bell = select(0.0, e / ((1.0 + e) * (1.0 + e)), near);
            bell_sum += bell;
            central[(row - outer) * n + r] = vec2<f32>(bell, select(0.0, weight * params.w_eikonal, near));
        }
    }
    for (var c = 0u; c < params.central; c++) {
        central[c * n + r].x /= bell_sum;
    }
    rays[3u * r + 2u] = vec4<f32>(color_cosine.xyz, select(weight * params.w_color, 0.0, bell_sum < 1e-6));
}

fn ring_ray(r: u32) {
    let n = params.ring_rays;
    let step = schedule.steps[schedule.cursor].number;
    let slot = ((step % params.ring_frames) * (n % params.ring_frames) + r) % params.ring_frames;
    let source = frames[params.surface_frames + slot];
    var draws = Draws(vec3<u32>(params.seed.x, params.seed.y + step, 2u * r + 1u), 0u, vec4<u32>(0u));
    let candidate = 3u * (source.y + pick(&draws, source.z));
    let dir_limit = candidates[candidate];
    let empty = dir_limit.w < 0.0;
    let clearance = candidates[candidate + 2u].x;
    let least = select(min(clearance, params.epsilon), clearance, empty);
    let weight = select(1.0, params.first_frame_weight, source.x == 0u);
    let ray = params.surface_rays + r;
    let dir = object_ray(ray, source.x, dir_limit.xyz);
    let origin = rays[3u * ray].xyz * params.center.w + params.center.xyz;
    var strata = begin_strata(begin_walk(origin, dir, abs(dir_limit.w)));
    let hit = strata.total > 0.0;
    for (var k = 0u; k < params.free; k++) {
        var sample = vec4<f32>(0.0);
        if (hit) {
            let t = next_stratum(&strata, (f32(k) + uniform_number(&draws)) / f32(params.free));
            if (in_cube(origin, dir, t)) {
                sample.x = t / params.center.w;
                sample.y = least;
                sample.z = select(weight * params.w_ring_uncertain, 0.0, empty);
                sample.w = select(0.0, weight * params.w_ring_empty, empty);
            }
        }
        samples[k * n + r] = sample;
    }
    rays[3u * ray + 2u] = vec4<f32>(0.0);
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x < params.surface_rays) {
        surface_ray(id.x);
    } else if (id.x < params.surface_rays + params.ring_rays) {
        ring_ray(id.x - params.surface_rays);
    }
}
