//! Hashes and value noise: everything random in a scene is a function of a seed and a place.

/// One round of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014): turns counters into independent seeds.
pub(crate) fn mix(x: u64) -> u64 {
    let mut z = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Seed of one stream: a sequence's seed, a frame, and a row or purpose.
pub(crate) fn stream(seed: u64, index: u64, row: u64) -> u128 {
    let a = mix(seed ^ mix(index ^ mix(row)));
    (u128::from(a) << 64) | u128::from(mix(a))
}

/// A lattice point's 32 random bits.
#[inline]
pub(crate) fn lattice(x: i32, y: i32, z: i32, seed: u32) -> u32 {
    let mut h = (x as u32).wrapping_mul(0x8da6_b343)
        ^ (y as u32).wrapping_mul(0xd816_3841)
        ^ (z as u32).wrapping_mul(0xcb1a_b31f)
        ^ seed.wrapping_mul(0x9e37_79b9);
    h ^= h >> 16;
    h = h.wrapping_mul(0x85eb_ca6b);
    h ^= h >> 13;
    h = h.wrapping_mul(0xc2b2_ae35);
    h ^ (h >> 16)
}

/// A lattice point's value in `[0, 1)`.
#[inline]
pub(crate) fn lattice_unit(x: i32, y: i32, z: i32, seed: u32) -> f32 {
    (lattice(x, y, z, seed) >> 8) as f32 / 16_777_216.0
}

/// The next integer below. The library's `floor` is a function call on machines without an instruction for it.
#[inline]
pub(crate) fn floor(v: f32) -> i32 {
    let i = v as i32;
    i.wrapping_sub(i32::from(v < i as f32))
}

/// Value noise in `[0, 1)`: random lattice values blended with a cubic.
#[inline]
pub(crate) fn value_noise(p: [f32; 3], seed: u32) -> f32 {
    let [x, y, z] = p.map(floor);
    let f = [x, y, z].map(|v| v as f32);
    let w: [f32; 3] = core::array::from_fn(|k| {
        let t = p[k] - f[k];
        t * t * (3.0 - 2.0 * t)
    });
    let edge = |dy: i32, dz: i32| {
        let a = lattice_unit(x, y.wrapping_add(dy), z.wrapping_add(dz), seed);
        let b = lattice_unit(x.wrapping_add(1), y.wrapping_add(dy), z.wrapping_add(dz), seed);
        a + (b - a) * w[0]
    };
    let near = edge(0, 0) + (edge(1, 0) - edge(0, 0)) * w[1];
    let far = edge(0, 1) + (edge(1, 1) - edge(0, 1)) * w[1];
    near + (far - near) * w[2]
}

/// Sum of `octaves` of value noise, each of twice the frequency and half the weight; in `[0, 1)`.
pub(crate) fn fractal_noise(p: [f32; 3], octaves: u32, seed: u32) -> f32 {
    let (mut sum, mut weight, mut total, mut q) = (0.0, 1.0, 0.0, p);
    for octave in 0..octaves.max(1) {
        sum += weight * value_noise(q, seed.wrapping_add(octave));
        total += weight;
        weight *= 0.5;
        // The shift keeps the octaves' lattices from lining up.
        q = q.map(|v| v * 2.0 + 17.3);
    }
    sum / total
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_stays_in_the_unit_interval_and_is_continuous() {
        for i in 0..2000 {
            let t = i as f32 * 0.0137 - 11.0;
            let p = [t, 0.7 * t, 3.0 - t];
            let v = fractal_noise(p, 4, 5);
            assert!((0.0..1.0).contains(&v));
            let near = fractal_noise([p[0] + 1e-4, p[1], p[2]], 4, 5);
            assert!((v - near).abs() < 5e-3);
        }
    }

    #[test]
    fn streams_differ_in_every_argument() {
        let base = stream(1, 2, 3);
        assert!(base != stream(2, 2, 3) && base != stream(1, 3, 3) && base != stream(1, 2, 4));
        assert_ne!(stream(1, 2, 3), stream(1, 3, 2));
    }
}
