//! Distance transform on the working grid.

/// For every cell the distance (cells, chamfer metric) to the nearest seed and that seed's index.
pub(crate) struct Nearest {
    pub(crate) distance: Vec<f32>,
    /// Index of the nearest seed, `u32::MAX` where there is no seed at all.
    pub(crate) seed: Vec<u32>,
}

const DIAGONAL: f32 = std::f32::consts::SQRT_2;

/// Two-pass chamfer transform (Borgefors 1986) that carries the seed along.
pub(crate) fn nearest(w: usize, h: usize, is_seed: impl Fn(usize) -> bool) -> Nearest {
    let n = w * h;
    let mut distance = vec![f32::INFINITY; n];
    let mut seed = vec![u32::MAX; n];
    for i in 0..n {
        if is_seed(i) {
            distance[i] = 0.0;
            seed[i] = i as u32;
        }
    }
    let mut relax = |i: usize, j: usize, cost: f32| {
        let d = distance[j] + cost;
        if d < distance[i] {
            distance[i] = d;
            seed[i] = seed[j];
        }
    };
    for y in 0..h {
        for x in 0..w {
            let i = y * w + x;
            if x > 0 {
                relax(i, i - 1, 1.0);
            }
            if y > 0 {
                relax(i, i - w, 1.0);
                if x > 0 {
                    relax(i, i - w - 1, DIAGONAL);
                }
                if x + 1 < w {
                    relax(i, i - w + 1, DIAGONAL);
                }
            }
        }
    }
    for y in (0..h).rev() {
        for x in (0..w).rev() {
            let i = y * w + x;
            if x + 1 < w {
                relax(i, i + 1, 1.0);
            }
            if y + 1 < h {
                relax(i, i + w, 1.0);
                if x > 0 {
                    relax(i, i + w - 1, DIAGONAL);
                }
                if x + 1 < w {
                    relax(i, i + w + 1, DIAGONAL);
                }
            }
        }
    }
    Nearest { distance, seed }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nearest_seed_is_carried_along() {
        let map = nearest(7, 5, |i| i == 0 || i == 34);
        assert_eq!(map.distance[1], 1.0);
        assert!((map.distance[8] - DIAGONAL).abs() < 1e-6);
        assert_eq!(map.seed[33], 34);
        assert_eq!(map.seed[2], 0);
        assert!(nearest(3, 3, |_| false).seed.iter().all(|&s| s == u32::MAX));
    }
}
