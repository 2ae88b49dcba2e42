//! The step's random numbers: a hash of seed, step, ray and position in the ray's sequence, so that any engine draws
//! the same number for the same purpose, in any order.

/// `pcg4d` (Jarzynski and Olano, Hash Functions for GPU Rendering, JCGT 2020): four 32-bit words to four, with
/// nothing but 32-bit arithmetic, which every shading language has.
pub(crate) fn pcg4d(v: [u32; 4]) -> [u32; 4] {
    let [mut x, mut y, mut z, mut w] = v.map(|c| c.wrapping_mul(1_664_525).wrapping_add(1_013_904_223));
    let mut cross = |scramble: fn(u32) -> u32| {
        x = x.wrapping_add(y.wrapping_mul(w));
        y = y.wrapping_add(z.wrapping_mul(x));
        z = z.wrapping_add(x.wrapping_mul(y));
        w = w.wrapping_add(y.wrapping_mul(z));
        [x, y, z, w] = [x, y, z, w].map(scramble);
    };
    cross(|c| c ^ (c >> 16));
    cross(|c| c);
    [x, y, z, w]
}

/// What a ray is drawn for; part of the key.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Purpose {
    Surface = 0,
    Ring = 1,
}

/// The sequence of one ray in one step.
pub(crate) struct Draws {
    key: [u32; 3],
    next: u32,
    block: [u32; 4],
}

impl Draws {
    /// `ray` counts the step's rays of one purpose, below 2^31.
    pub(crate) fn new(seed: u64, purpose: Purpose, step: usize, ray: usize) -> Self {
        let key = [
            seed as u32,
            ((seed >> 32) as u32).wrapping_add(step as u32),
            // In the low bits: differences in the highest ones hardly mix.
            (ray as u32) << 1 | purpose as u32,
        ];
        Self { key, next: 0, block: [0; 4] }
    }

    /// The next number, a multiple of 2^-24 in 0..1.
    pub(crate) fn uniform(&mut self) -> f32 {
        if self.next.is_multiple_of(4) {
            let [a, b, c] = self.key;
            self.block = pcg4d([a, b, c, self.next / 4]);
        }
        let word = self.block[(self.next % 4) as usize];
        self.next += 1;
        (word >> 8) as f32 * (1.0 / (1 << 24) as f32)
    }

    /// A number below `n` (at most 2^24, at least 1).
    pub(crate) fn pick(&mut self, n: usize) -> usize {
        ((self.uniform() * n as f32) as usize).min(n - 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sequences_are_uniform_and_differ_in_every_part_of_the_key() {
        let first =
            |seed: u64, step: usize, ray: usize| Draws::new(seed, Purpose::Surface, step, ray).uniform();
        for by in 0..3 {
            let values: Vec<f32> = (0..4000)
                .map(|i| match by {
                    0 => first(i, 5, 7),
                    1 => first(9, i as usize, 7),
                    _ => first(9, 5, i as usize),
                })
                .collect();
            let mut bins = [0usize; 16];
            for v in &values {
                assert!((0.0..1.0).contains(v));
                bins[(v * 16.0) as usize] += 1;
            }
            // 250 expected with a deviation of 15: five deviations.
            assert!(bins.iter().all(|b| (175..=325).contains(b)), "{bins:?}");
            let lag: f32 = values.windows(2).map(|w| (w[0] - 0.5) * (w[1] - 0.5)).sum::<f32>() / 4000.0;
            assert!(lag.abs() < 5.0 / 12.0 / 4000f32.sqrt(), "neighbours correlate: {lag}");
        }
        let ring = Draws::new(9, Purpose::Ring, 5, 7).uniform();
        assert_ne!(ring, first(9, 5, 7));
    }

    #[test]
    fn picks_stay_below_their_limit() {
        let mut draws = Draws::new(1, Purpose::Ring, 0, 0);
        assert!((0..1000).all(|_| draws.pick(1) == 0 && draws.pick(3) < 3 && draws.pick(1 << 24) < 1 << 24));
    }
}
