//! Distance transform on the working grid.

/// For every cell the distance (cells, chamfer metric) to the nearest seed and that seed's index.
pub(crate) struct Nearest {
    pub(crate) distance: Vec<f32>,
    /// Index of the nearest seed, `u32::MAX` where there is no seed at all.
    pub(crate) seed: Vec<u32>,
}

const DIAGONAL: f32 = std::f32::consts::SQRT_2;

/// Two-pass chamfer transform (Borgefors 1986) that carries the seed along.
///
/// What comes from the neighbouring row is taken for the whole row at once, so that only the passage along the row is
/// a chain of dependent steps.
pub(crate) fn nearest(w: usize, h: usize, is_seed: impl Fn(usize) -> bool) -> Nearest {
    let n = w * h;
    let seeds = |i: usize| if is_seed(i) { (0.0, i as u32) } else { (f32::INFINITY, u32::MAX) };
    let (mut distance, mut seed): (Vec<f32>, Vec<u32>) = (0..n).map(seeds).unzip();
    for y in 0..h {
        let (above, here) = distance.split_at_mut(y * w);
        let (seed_above, seed_here) = seed.split_at_mut(y * w);
        let (here, seed_here) = (&mut here[..w], &mut seed_here[..w]);
        if y > 0 {
            from_row((&above[(y - 1) * w..], &seed_above[(y - 1) * w..]), (here, seed_here));
        }
        for x in 1..w {
            along(here, seed_here, x - 1, x);
        }
    }
    for y in (0..h).rev() {
        let (here, below) = distance.split_at_mut((y + 1) * w);
        let (seed_here, seed_below) = seed.split_at_mut((y + 1) * w);
        let (here, seed_here) = (&mut here[y * w..], &mut seed_here[y * w..]);
        if y + 1 < h {
            from_row((&below[..w], &seed_below[..w]), (here, seed_here));
        }
        for x in (1..w).rev() {
            along(here, seed_here, x, x - 1);
        }
    }
    Nearest { distance, seed }
}

/// Steps from a row to the one next to it: straight, and along both diagonals.
fn from_row((from, from_seed): (&[f32], &[u32]), (to, to_seed): (&mut [f32], &mut [u32])) {
    let w = to.len();
    step(&from[..w], &from_seed[..w], to, to_seed, 1.0);
    if w > 1 {
        step(&from[..w - 1], &from_seed[..w - 1], &mut to[1..], &mut to_seed[1..], DIAGONAL);
        step(&from[1..w], &from_seed[1..w], &mut to[..w - 1], &mut to_seed[..w - 1], DIAGONAL);
    }
}

#[inline]
fn step(from: &[f32], from_seed: &[u32], to: &mut [f32], to_seed: &mut [u32], cost: f32) {
    for ((to, to_seed), (from, from_seed)) in to.iter_mut().zip(to_seed).zip(from.iter().zip(from_seed)) {
        let d = from + cost;
        let closer = d < *to;
        *to_seed = if closer { *from_seed } else { *to_seed };
        *to = if closer { d } else { *to };
    }
}

#[inline]
fn along(distance: &mut [f32], seed: &mut [u32], from: usize, to: usize) {
    let d = distance[from] + 1.0;
    if d < distance[to] {
        distance[to] = d;
        seed[to] = seed[from];
    }
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

    #[test]
    fn distances_are_those_of_the_shortest_way() {
        let (w, h) = (11, 9);
        let seeds = [3usize, 40, 77, 95];
        let map = nearest(w, h, |i| seeds.contains(&i));
        for i in 0..w * h {
            let way = |s: usize| {
                let (dx, dy) = ((s % w).abs_diff(i % w) as f32, (s / w).abs_diff(i / w) as f32);
                dx.max(dy) - dx.min(dy) + DIAGONAL * dx.min(dy)
            };
            let best = seeds.iter().map(|&s| way(s)).fold(f32::INFINITY, f32::min);
            assert!((map.distance[i] - best).abs() < 1e-4);
            assert!((way(map.seed[i] as usize) - best).abs() < 1e-4);
        }
    }
}
