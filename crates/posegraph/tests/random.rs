//! Thousands of random problems: whatever the graph, the start and the outliers, a solve never makes things worse, and
//! where the measurements determine the poses it finds them.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stdout)]

mod common;

use common::{bumpy, disturb, error, matches, node, orbit, render, rng};
use nalgebra::Isometry3;
use posegraph::{DenseEdge, DenseView, PoseGraph, SolveOptions, solve};
use rand::RngExt;

const OUTLIERS: f64 = 0.3;

/// Cameras around an object, and what they see with 1 mm of noise.
fn cameras() -> Vec<(Isometry3<f64>, DenseView)> {
    let mut rng = rng(900);
    (0..16)
        .map(|k| {
            let pose = orbit(0.5, 0.4 * f64::from(k), 0.3 * f64::from(k % 4) - 0.45);
            let view = render(bumpy, &pose, 48, 0.001, &mut rng);
            (pose, view)
        })
        .collect()
}

struct Case<'a> {
    graph: PoseGraph<'a>,
    truth: Vec<Isometry3<f64>>,
    /// Whether the start is near the truth, every node hangs on enough good matches and one is fixed there.
    is_well_posed: bool,
}

/// 2 to 11 nodes, a random connected graph of matches of which 30 % are wrong, and sometimes dense edges.
fn case<'a>(seed: u64, cameras: &'a [(Isometry3<f64>, DenseView)]) -> Case<'a> {
    let mut rng = rng(seed);
    let nodes = rng.random_range(2..=11usize);
    let is_well_posed = rng.random_bool(0.5);
    let first = rng.random_range(0..cameras.len());
    let seen: Vec<_> = (0..nodes).map(|k| &cameras[(first + k) % cameras.len()]).collect();
    let mut graph = PoseGraph::new();
    for (k, (pose, view)) in seen.iter().enumerate() {
        let (metres, degrees) = if is_well_posed {
            (0.015, 6.0)
        } else {
            (rng.random_range(0.0..0.3), rng.random_range(0.0..180.0))
        };
        let fixed = if k == 0 { is_well_posed || rng.random_bool(0.5) } else { rng.random_bool(0.1) };
        let is_true = is_well_posed && fixed;
        let start = if is_true { *pose } else { disturb(&mut rng, pose, metres, degrees) };
        graph.add_node(node(start, fixed));
        graph.set_view(k, view).unwrap();
    }
    for i in 1..nodes {
        let tree = rng.random_range(0..i);
        for j in 0..i {
            if j != tree && !rng.random_bool(0.3) {
                continue;
            }
            let count = if is_well_posed { rng.random_range(40..120) } else { rng.random_range(0..40) };
            let (a, b) = ((i, &seen[i].0), (j, &seen[j].0));
            graph.add_feature_edge(matches(&mut rng, a, b, count, 0.001, OUTLIERS)).unwrap();
            if rng.random_bool(0.2) {
                graph.add_dense_edge(DenseEdge { source: i, target: j }).unwrap();
            }
        }
    }
    let truth = seen.iter().map(|(pose, _)| *pose).collect();
    Case { graph, truth, is_well_posed }
}

/// Solves the problems of these seeds; returns (how many well-posed ones, worst error in metres and degrees of those).
fn solve_all(seeds: std::ops::Range<u64>) -> (usize, f64, f64) {
    let cameras = cameras();
    let (mut posed, mut metres, mut degrees) = (0, 0.0f64, 0.0f64);
    for seed in seeds {
        let case = case(seed, &cameras);
        let solution = solve(&case.graph, &SolveOptions::default()).unwrap();
        assert!(solution.cost_final <= solution.cost_initial, "seed {seed}");
        for (pose, start) in solution.poses.iter().zip(case.graph.nodes()) {
            let numbers = pose.translation.vector.iter().chain(pose.rotation.coords.iter());
            assert!(numbers.into_iter().all(|x| x.is_finite()), "seed {seed}");
            assert!(!start.fixed || *pose == start.obj_from_cam, "seed {seed}");
        }
        if case.is_well_posed {
            posed += 1;
            for (pose, truth) in solution.poses.iter().zip(&case.truth) {
                let (m, d) = error(pose, truth);
                assert!(m < 0.005 && d < 3.0, "seed {seed}: {m} m, {d} degrees");
                (metres, degrees) = (metres.max(m), degrees.max(d));
            }
        }
    }
    (posed, metres, degrees)
}

#[test]
fn random_problems_never_diverge() {
    let (posed, ..) = solve_all(0..500);
    assert!(posed > 200);
}

/// `cargo test --release -p posegraph --test random -- --ignored --nocapture`
#[test]
#[ignore = "takes half a minute on a quiet machine"]
fn ten_thousand_random_problems_never_diverge() {
    let (posed, metres, degrees) = solve_all(0..10_000);
    println!("10000 problems, {posed} well posed: worst error {:.2} mm, {degrees:.2} degrees", metres * 1e3);
}
