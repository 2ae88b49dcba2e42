// The step's random numbers, bit for bit those of draws.rs: pcg4d (Jarzynski and Olano, JCGT 2020) of seed, step,
// ray and position in the ray's sequence.

fn pcg4d(key: vec4<u32>) -> vec4<u32> {
    var v = key * 1664525u + 1013904223u;
    v.x += v.y * v.w;
    v.y += v.z * v.x;
    v.z += v.x * v.y;
    v.w += v.y * v.z;
    v ^= v >> vec4<u32>(16u);
    v.x += v.y * v.w;
    v.y += v.z * v.x;
    v.z += v.x * v.y;
    v.w += v.y * v.z;
    return v;
}

struct Draws {
    key: vec3<u32>,
    next: u32,
    block: vec4<u32>,
}

fn uniform_number(draws: ptr<function, Draws>) -> f32 {
    let at = (*draws).next;
    if (at % 4u == 0u) {
        (*draws).block = pcg4d(vec4<u32>((*draws).key, at / 4u));
    }
    (*draws).next = at + 1u;
    return f32((*draws).block[at % 4u] >> 8u) * (1.0 / 16777216.0);
}

fn pick(draws: ptr<function, Draws>, n: u32) -> u32 {
    return min(u32(uniform_number(draws) * f32(n)), n - 1u);
}
