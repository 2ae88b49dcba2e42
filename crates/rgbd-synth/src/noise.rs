//! Hashes and value noise: everything random in a scene is a function of a seed and a place.

use std::sync::OnceLock;

/// One round of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014): turns counters into independent seeds.
#[inline]
pub(crate) fn mix(x: u64) -> u64 {
    let mut z = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Seed of one stream: a sequence's seed, a frame, and a row or purpose.
pub(crate) fn stream(seed: u64, index: u64, row: u64) -> u64 {
    mix(seed ^ mix(index ^ mix(row)))
}

/// Levels of [`normal_levels`].
const LEVELS: usize = 4096;

/// Standard normal values at equal steps of probability (Abramowitz and Stegun 1964, 26.2.23, scaled to unit
/// variance): a look-up with 12 random bits takes the place of a logarithm, a root and a cosine for every pixel. The
/// largest value is 3.7.
pub(crate) fn normal_levels() -> &'static [f32; LEVELS] {
    static TABLE: OnceLock<Box<[f32; LEVELS]>> = OnceLock::new();
    TABLE.get_or_init(|| {
        let mut table = Box::new([0.0f32; LEVELS]);
        let mut power = 0.0;
        for (i, value) in table.iter_mut().enumerate() {
            let p = (i as f64 + 0.5) / LEVELS as f64;
            let t = (-2.0 * p.min(1.0 - p).ln()).sqrt();
            let above = 2.515_517 + t * (0.802_853 + t * 0.010_328);
            let below = 1.0 + t * (1.432_788 + t * (0.189_269 + t * 0.001_308));
            let v = (t - above / below) * (p - 0.5).signum();
            power += v * v / LEVELS as f64;
            *value = v as f32;
        }
        let scale = 1.0 / power.sqrt() as f32;
        table.iter_mut().for_each(|v| *v *= scale);
        table
    })
}

/// The value of [`normal_levels`] that the twelve bits of `random` from `shift` on choose.
#[inline]
pub(crate) fn normal(levels: &[f32; LEVELS], random: u64, shift: u32) -> f32 {
    levels[(random >> shift) as usize % LEVELS]
}

/// Even in `[0, 1)`: the sixteen bits of `random` from `shift` on.
#[inline]
pub(crate) fn unit(random: u64, shift: u32) -> f32 {
    (random >> shift & 0xffff) as f32 / 65_536.0
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
    fn normal_values_have_mean_zero_unit_variance_and_the_known_quantiles() {
        let table = normal_levels();
        let mean = table.iter().sum::<f32>() / 4096.0;
        let power = table.iter().map(|v| v * v).sum::<f32>() / 4096.0;
        assert!(mean.abs() < 1e-4 && (power - 1.0).abs() < 1e-4);
        assert!(table.windows(2).all(|w| w[0] < w[1]));
        // 84.13 % of all values lie below one, 97.72 % below two.
        assert!((table[3446] - 1.0).abs() < 0.01 && (table[4002] - 2.0).abs() < 0.02);
    }

    #[test]
    fn streams_differ_in_every_argument() {
        let base = stream(1, 2, 3);
        assert!(base != stream(2, 2, 3) && base != stream(1, 3, 3) && base != stream(1, 2, 4));
        assert_ne!(stream(1, 2, 3), stream(1, 3, 2));
    }
}
