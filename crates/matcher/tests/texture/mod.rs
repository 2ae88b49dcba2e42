//! A procedural texture that can be evaluated at any point, so that warped views of it are exact.

/// Value noise of four octaves, 0 to 255; features of about 3 to 40 pixels.
pub fn texture(x: f32, y: f32, seed: u32) -> f32 {
    let mut value = 0.0;
    for (octave, (size, amplitude)) in
        [(5.0, 0.3), (9.0, 0.3), (17.0, 0.25), (37.0, 0.15)].into_iter().enumerate()
    {
        value += amplitude * noise(x / size, y / size, seed.wrapping_mul(31).wrapping_add(octave as u32));
    }
    // More contrast than an average of noises has.
    (128.0 + 2.2 * 255.0 * (value - 0.5)).clamp(0.0, 255.0)
}

fn noise(x: f32, y: f32, seed: u32) -> f32 {
    let (x0, y0) = (x.floor(), y.floor());
    let ease = |t: f32| t * t * t * (t * (6.0 * t - 15.0) + 10.0);
    let (fx, fy) = (ease(x - x0), ease(y - y0));
    let at = |dx: i32, dy: i32| hash(x0 as i32 + dx, y0 as i32 + dy, seed);
    let top = at(0, 0) + fx * (at(1, 0) - at(0, 0));
    let bottom = at(0, 1) + fx * (at(1, 1) - at(0, 1));
    top + fy * (bottom - top)
}

fn hash(x: i32, y: i32, seed: u32) -> f32 {
    let mut h = (x as u32).wrapping_mul(0x9E37_79B1)
        ^ (y as u32).wrapping_mul(0x85EB_CA77)
        ^ seed.wrapping_mul(0xC2B2_AE3D);
    h ^= h >> 15;
    h = h.wrapping_mul(0x2C1B_3C6D);
    h ^= h >> 12;
    h = h.wrapping_mul(0x297A_2D39);
    h ^= h >> 15;
    h as f32 / u32::MAX as f32
}
