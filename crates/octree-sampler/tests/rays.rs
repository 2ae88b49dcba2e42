//! Ray intervals against brute force: dense sampling of `contains`, and slab intersection of every voxel.
#![allow(clippy::unwrap_used)]

use octree_sampler::{MAX_CELLS_PER_AXIS, VoxelOctree, sampling};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

fn cloud(rng: &mut Pcg64Mcg, n: usize, extent: f32) -> Vec<[f32; 3]> {
    (0..n).map(|_| std::array::from_fn(|_| (rng.random::<f32>() - 0.5) * extent)).collect()
}

/// Points on a sphere: the shape whose inside is skipped.
fn shell(rng: &mut Pcg64Mcg, n: usize, radius: f32) -> Vec<[f32; 3]> {
    cloud(rng, n, 2.0)
        .into_iter()
        .map(|p| {
            let norm = (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt().max(1e-6);
            p.map(|v| v / norm * radius)
        })
        .collect()
}

fn at(o: [f32; 3], d: [f32; 3], t: f64) -> [f32; 3] {
    std::array::from_fn(|a| (f64::from(o[a]) + t * f64::from(d[a])) as f32)
}

/// Sorted union of the slab intersections of all voxels.
fn naive(octree: &VoxelOctree, o: [f32; 3], d: [f32; 3], t_min: f32, t_max: f32) -> Vec<[f64; 2]> {
    let size = f64::from(octree.voxel_size());
    let mut hits: Vec<[f64; 2]> = octree
        .voxels()
        .filter_map(|corner| {
            let (mut near, mut far) = (f64::from(t_min), f64::from(t_max));
            for a in 0..3 {
                let (lo, o, d) = (f64::from(corner[a]), f64::from(o[a]), f64::from(d[a]));
                if d == 0.0 {
                    if o < lo || o >= lo + size {
                        return None;
                    }
                    continue;
                }
                let (t0, t1) = ((lo - o) / d, (lo + size - o) / d);
                near = near.max(t0.min(t1));
                far = far.min(t0.max(t1));
            }
            (near < far).then_some([near, far])
        })
        .collect();
    hits.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let mut merged: Vec<[f64; 2]> = Vec::new();
    for hit in hits {
        match merged.last_mut() {
            Some(last) if hit[0] <= last[1] + 1e-6 => last[1] = last[1].max(hit[1]),
            _ => merged.push(hit),
        }
    }
    merged
}

/// Length of the symmetric difference of two sorted interval lists.
fn difference(a: &[[f64; 2]], b: &[[f64; 2]]) -> f64 {
    let covered = |list: &[[f64; 2]], t: f64| list.iter().any(|i| i[0] <= t && t < i[1]);
    let mut cuts: Vec<f64> = a.iter().chain(b).flatten().copied().collect();
    cuts.sort_by(f64::total_cmp);
    cuts.windows(2)
        .filter(|w| covered(a, 0.5 * (w[0] + w[1])) != covered(b, 0.5 * (w[0] + w[1])))
        .map(|w| w[1] - w[0])
        .sum()
}

fn check_ray(octree: &VoxelOctree, o: [f32; 3], d: [f32; 3], t_min: f32, t_max: f32) {
    let mut got = Vec::new();
    octree.intervals(o, d, t_min, t_max, &mut got);
    for i in &got {
        assert!(i[0] < i[1] && i[0] >= t_min && i[1] <= t_max, "{i:?} in {t_min}..{t_max}");
    }
    assert!(got.windows(2).all(|w| w[0][1] < w[1][0]), "sorted and disjoint: {got:?}");
    let got: Vec<[f64; 2]> = got.iter().map(|i| i.map(f64::from)).collect();
    let want = naive(octree, o, d, t_min, t_max);
    let slack = 1e-5 * (1.0 + want.len() as f64);
    assert!(difference(&got, &want) < slack, "ray {o:?} {d:?}\n got {got:?}\nwant {want:?}");

    // Dense sampling, away from interval ends where rounding decides.
    for k in 0..400 {
        let t = f64::from(t_min) + (f64::from(t_max) - f64::from(t_min)) * (f64::from(k) + 0.37) / 400.0;
        if got.iter().flatten().any(|end| (end - t).abs() < 1e-4) {
            continue;
        }
        let inside = got.iter().any(|i| i[0] < t && t < i[1]);
        let p = at(o, d, t);
        // A point within rounding of a voxel face may fall on either side.
        let near_face = p.iter().any(|v| {
            let c = v / octree.voxel_size();
            (c - c.round()).abs() < 1e-3
        });
        assert!(near_face || inside == octree.contains(p), "t {t} of ray {o:?} {d:?}: {got:?}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn intervals_agree_with_brute_force(
        seed in any::<u64>(), n in 1usize..120, extent in 0.05f32..1.5, dilation in 0u32..3, axis_aligned in any::<bool>(),
    ) {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let points = if seed % 2 == 0 { cloud(&mut rng, n, extent) } else { shell(&mut rng, n, extent / 2.0) };
        let octree = VoxelOctree::from_points(&points, 0.02, dilation).unwrap();
        for _ in 0..12 {
            let o = std::array::from_fn(|_| (rng.random::<f32>() - 0.5) * 3.0);
            let target = points[rng.random_range(0..n)];
            let mut d: [f32; 3] = std::array::from_fn(|a| (target[a] - o[a]) * 1.7);
            let mut o = o;
            if axis_aligned {
                // Parallel to one or two axes, through the target.
                for a in 0..1 + rng.random_range(0..2usize) {
                    d[a] = 0.0;
                    o[a] = target[a];
                }
            }
            check_ray(&octree, o, d, 0.0, 5.0);
            check_ray(&octree, target, d, -0.5, 0.5);
        }
    }

    #[test]
    fn any_bits_end_and_keep_the_contract(
        o in prop::array::uniform3(any::<f32>()), d in prop::array::uniform3(any::<f32>()),
        t_min in any::<f32>(), t_max in any::<f32>(), size in any::<f32>(),
        points in prop::collection::vec(prop::array::uniform3(any::<f32>()), 0..4), dilation in any::<u32>(),
    ) {
        let small = VoxelOctree::from_points(&[[0.1, 0.2, 0.3], [0.4, 0.0, -0.3]], 0.02, 1);
        let odd = VoxelOctree::from_points(&points, size, dilation % 4);
        let mut out = vec![[0.0; 2]];
        for octree in [small, odd].into_iter().flatten() {
            octree.intervals(o, d, t_min, t_max, &mut out);
            prop_assert!(out.iter().all(|i| i[0] < i[1] && i[0] >= t_min && i[1] <= t_max));
            octree.intervals([0.1, 0.2, -5.0], d, t_min, t_max, &mut out);
            prop_assert!(out.windows(2).all(|w| w[0][1] < w[1][0]));
            prop_assert!(!octree.is_empty() && octree.voxel_size() > 0.0);
        }
    }

    #[test]
    fn samples_stay_inside_and_spread_evenly(seed in any::<u64>(), n in 1usize..200) {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let octree = VoxelOctree::from_points(&cloud(&mut rng, 40, 0.5), 0.02, 1).unwrap();
        let (mut intervals, mut depths) = (Vec::new(), Vec::new());
        let d = std::array::from_fn(|_| rng.random::<f32>() - 0.5);
        octree.intervals([0.0; 3], d, -10.0, 10.0, &mut intervals);
        sampling::stratified(&intervals, n, || rng.random(), &mut depths);
        prop_assert_eq!(depths.len(), if intervals.is_empty() { 0 } else { n });
        prop_assert!(depths.windows(2).all(|w| w[0] <= w[1]));
        let total = sampling::length(&intervals);
        for (k, t) in depths.iter().enumerate() {
            prop_assert!(intervals.iter().any(|i| i[0] <= *t && *t <= i[1]));
            // The k-th sample has between k/n and (k+1)/n of the occupied length before it.
            let mut head = intervals.clone();
            sampling::clip(&mut head, *t);
            let before = sampling::length(&head) / total * n as f64;
            prop_assert!(before > k as f64 - 1e-2 && before < k as f64 + 1.01, "{before} for {k}");
        }
    }
}

#[test]
fn hollow_shell_is_entered_twice() {
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    let octree = VoxelOctree::from_points(&shell(&mut rng, 40_000, 0.15), 0.005, 1).unwrap();
    let mut out = Vec::new();
    octree.intervals([0.0, 0.0, -1.0], [0.0, 0.0, 2.0], 0.0, 10.0, &mut out);
    assert_eq!(out.len(), 2, "{out:?}");
    assert!((out[0][0] - 0.42).abs() < 0.006 && (out[1][1] - 0.58).abs() < 0.006, "{out:?}");
}

#[test]
fn degenerate_rays_are_empty() {
    let octree = VoxelOctree::from_points(&[[0.0; 3]], 0.02, 1).unwrap();
    let (o, z) = ([0.0, 0.0, -1.0], [0.0, 0.0, 1.0]);
    let mut out = vec![[1.0, 2.0]];
    let nan = f32::NAN;
    let inf = f32::INFINITY;
    for (o, d, t0, t1) in [
        (o, [0.0; 3], 0.0, 2.0),
        (o, [nan, 0.0, 1.0], 0.0, 2.0),
        (o, [inf, 0.0, 1.0], 0.0, 2.0),
        ([nan, 0.0, 0.0], z, 0.0, 2.0),
        (o, z, nan, 2.0),
        (o, z, 0.0, nan),
        (o, z, 2.0, 0.0),
        (o, z, 3.0, 4.0),
        ([1.0, 0.0, 0.0], z, -inf, inf),
    ] {
        octree.intervals(o, d, t0, t1, &mut out);
        assert!(out.is_empty(), "{o:?} {d:?} {t0} {t1}: {out:?}");
    }
    octree.intervals(o, z, -inf, inf, &mut out);
    assert_eq!(out.len(), 1);
    octree.intervals(o, [1e-40, -1e-40, 1.0], 0.0, inf, &mut out);
    assert_eq!(out.len(), 1);
    // So slow that it never leaves within the range of f32.
    octree.intervals([0.0; 3], [0.0, 0.0, 1e-45], 0.0, inf, &mut out);
    assert_eq!(out, [[0.0, f32::MAX]]);
}

#[test]
fn every_point_is_inside_and_size_is_bounded() {
    let mut rng = Pcg64Mcg::seed_from_u64(3);
    let mut points = cloud(&mut rng, 500, 1.0);
    points.push([f32::NAN, 0.0, 0.0]);
    let octree = VoxelOctree::from_points(&points, 0.0001, 1).unwrap();
    assert!(points.iter().take(500).all(|p| octree.contains(*p)));
    assert!(!octree.contains([f32::NAN, 0.0, 0.0]));
    let (lo, hi) = octree.bounds();
    for a in 0..3 {
        assert!((hi[a] - lo[a]) / octree.voxel_size() < MAX_CELLS_PER_AXIS as f32 + 0.5);
    }
    assert!((octree.voxel_size() - 0.0032).abs() < 1e-7, "{}", octree.voxel_size());
    assert_eq!(octree.voxels().count(), octree.len());
    let half = octree.voxel_size() / 2.0;
    assert!(octree.voxels().all(|v| octree.contains(v.map(|c| c + half))));
}

#[test]
fn no_usable_input_is_none() {
    assert!(VoxelOctree::from_points(&[], 0.02, 1).is_none());
    assert!(VoxelOctree::from_points(&[[f32::NAN; 3]], 0.02, 1).is_none());
    for size in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        assert!(VoxelOctree::from_points(&[[0.0; 3]], size, 1).is_none());
    }
    let huge = VoxelOctree::from_points(&[[f32::MAX; 3], [f32::MIN; 3]], 0.02, u32::MAX).unwrap();
    assert!(huge.contains([0.0; 3]) || huge.contains([f32::MAX; 3]));
}
