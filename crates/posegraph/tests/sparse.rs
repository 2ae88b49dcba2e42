//! Sparse graphs with known optima.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stdout)]

mod common;

use common::{error, motion, rng};
use nalgebra::{Isometry3, Matrix6, Vector3, Vector6};
use posegraph::sparse::{Error, Graph, Kernel, Options, RelativePose, solve};
use proptest::prelude::*;
use se3_lie::se3;

/// A helix of `n` poses, `turn` to a round, with exact edges to the next pose and the next round.
fn helix(n: usize, turn: usize) -> Graph {
    let pose = |k: usize| {
        let angle = k as f64 / turn as f64 * std::f64::consts::TAU;
        let position = Vector3::new(5.0 * angle.cos(), 5.0 * angle.sin(), 0.3 * angle);
        Isometry3::new(position, Vector3::z() * angle)
    };
    let poses: Vec<_> = (0..n).map(pose).collect();
    let pairs = (1..n).map(|k| (k - 1, k)).chain((turn..n).map(|k| (k - turn, k)));
    let information = Matrix6::from_diagonal(&Vector6::new(100.0, 100.0, 50.0, 400.0, 300.0, 400.0));
    let edges = pairs.map(|(a, b)| RelativePose::new(a, b, poses[a].inv_mul(&poses[b]), information));
    Graph { edges: edges.collect(), poses: poses.clone(), ..Graph::default() }
}

/// Largest error of any pose in metres and degrees.
fn worst(got: &[Isometry3<f64>], truth: &[Isometry3<f64>]) -> (f64, f64) {
    let errors = got.iter().zip(truth).map(|(a, b)| error(&(a.inv_mul(b)), &Isometry3::identity()));
    errors.fold((0.0, 0.0), |w, e| (f64::max(w.0, e.0), f64::max(w.1, e.1)))
}

#[test]
fn disturbed_poses_return_to_exact_measurements() {
    let truth = helix(120, 20);
    let mut start = truth.clone();
    let mut rng = rng(1);
    for pose in &mut start.poses[1..] {
        *pose *= motion(&mut rng, 0.5, 0.3);
    }
    let solution = solve(&start, &Options::default()).unwrap();
    let (t, r) = worst(&solution.poses, &truth.poses);
    assert!(solution.converged && t < 1e-6 && r < 1e-6, "{t} {r}");
    // The held node comes back bit for bit, and the same input gives the same bits.
    assert_eq!(solution.poses[0], start.poses[0]);
    assert_eq!(solution, solve(&start, &Options::default()).unwrap());
    assert_eq!(solution.cost_initial, start.half_chi_squared());
}

#[test]
fn huber_ignores_false_loops() {
    let truth = helix(100, 20);
    let mut graph = truth.clone();
    let mut rng = rng(2);
    for k in 0..6 {
        let false_loop = motion(&mut rng, 0.5, 0.5);
        graph.edges.push(RelativePose::new(10 * k, 10 * k + 35, false_loop, Matrix6::identity() * 100.0));
    }
    let squares = solve(&graph, &Options::default()).unwrap();
    let robust = solve(&graph, &Options { kernel: Kernel::Huber(1.0), ..Options::default() }).unwrap();
    let (plain, robust) = (worst(&squares.poses, &truth.poses), worst(&robust.poses, &truth.poses));
    assert!(plain.0 > 1.0 && robust.0 < 0.3 * plain.0, "{plain:?} {robust:?}");
}

#[test]
fn optimum_does_not_move_with_the_world() {
    let mut graph = helix(60, 15);
    let mut rng = rng(3);
    for edge in &mut graph.edges {
        edge.from_from_to *= motion(&mut rng, 0.05, 0.02);
    }
    let options = Options { relative_decrease: 1e-12, ..Options::default() };
    let here = solve(&graph, &options).unwrap();
    let shift = Isometry3::new(Vector3::new(4000.0, -900.0, 30.0), Vector3::new(0.2, 1.0, -0.5));
    graph.poses.iter_mut().for_each(|pose| *pose = shift * *pose);
    let there = solve(&graph, &options).unwrap();
    assert!((here.cost_final - there.cost_final).abs() < 1e-6 * here.cost_final);
    assert!(here.cost_final > 1.0);
    let back: Vec<_> = there.poses.iter().map(|pose| shift.inv_mul(pose)).collect();
    let (t, r) = worst(&back, &here.poses);
    assert!(t < 1e-5 && r < 1e-4, "{t} {r}");
}

#[test]
fn one_edge_has_the_closed_form_of_the_mean() {
    // Two measurements of one translation: the information-weighted mean, half chi squared w1 w2 d^2 / (2 (w1 + w2)).
    let measure = |x: f64, w: f64| {
        RelativePose::new(0, 1, Isometry3::translation(x, 0.0, 0.0), Matrix6::identity() * w)
    };
    let graph = Graph {
        poses: vec![Isometry3::identity(); 2],
        edges: vec![measure(1.0, 3.0), measure(2.0, 1.0)],
        fixed: [0].into(),
    };
    let solution = solve(&graph, &Options { relative_decrease: 1e-12, ..Options::default() }).unwrap();
    assert!((solution.poses[1].translation.x - 1.25).abs() < 1e-6);
    assert!((solution.cost_final - 0.375).abs() < 1e-9);
}

#[test]
fn every_part_without_a_fixed_node_holds_its_first() {
    let mut graph = helix(10, 5);
    graph.edges.retain(|e| (e.from < 5) == (e.to < 5));
    graph.fixed = [3].into();
    let before = graph.poses.clone();
    let mut rng = rng(4);
    for pose in &mut graph.poses {
        *pose *= motion(&mut rng, 0.1, 0.1);
    }
    graph.poses.push(before[9]); // a node without edges
    let solution = solve(&graph, &Options::default()).unwrap();
    assert!(solution.converged && solution.cost_final < 1e-9, "{solution:?}");
    for held in [3, 5, 10] {
        assert_eq!(solution.poses[held], graph.poses[held]);
    }
}

#[test]
fn degenerate_graphs_have_defined_results() {
    let options = Options::default();
    let empty = solve(&Graph::default(), &options).unwrap();
    assert!(empty.converged && empty.poses.is_empty() && empty.cost_final == 0.0);
    let mut graph = helix(6, 3);
    graph.poses[2] *= Isometry3::translation(0.1, 0.0, 0.0);
    // No information at all: nothing moves.
    let mut blind = graph.clone();
    blind.edges.iter_mut().for_each(|e| e.information = Matrix6::zeros());
    assert_eq!(solve(&blind, &options).unwrap().poses, graph.poses);
    // Information on translations only leaves rotations of the last pose open: the cost still vanishes.
    let mut partial = graph.clone();
    let only = Matrix6::from_diagonal(&Vector6::new(1.0, 1.0, 1.0, 0.0, 0.0, 0.0));
    partial.edges.iter_mut().for_each(|e| e.information = only);
    assert!(solve(&partial, &options).unwrap().cost_final < 1e-9);
    let mut fixed = graph.clone();
    fixed.fixed = (0..6).collect();
    assert_eq!(solve(&fixed, &options).unwrap().poses, graph.poses);
    let none = Options { max_iterations: 0, ..options };
    assert!(!solve(&graph, &none).unwrap().converged);
}

#[test]
fn mistakes_are_errors() {
    let good = helix(4, 2);
    let fails = |change: &dyn Fn(&mut Graph)| {
        let mut graph = good.clone();
        change(&mut graph);
        solve(&graph, &Options::default()).unwrap_err()
    };
    assert!(matches!(fails(&|g| g.edges[0].to = 9), Error::NodeOutOfRange { edge: 0, node: 9, nodes: 4 }));
    assert!(matches!(fails(&|g| g.edges[1].to = 1), Error::SelfEdge { edge: 1, node: 1 }));
    assert!(matches!(fails(&|g| g.poses[2].translation.x = f64::NAN), Error::NonFinitePose { node: 2 }));
    assert!(matches!(fails(&|g| g.fixed = [usize::MAX].into()), Error::FixedOutOfRange { .. }));
    let nan = |g: &mut Graph| g.edges[0].from_from_to.translation.y = f64::INFINITY;
    assert!(matches!(fails(&nan), Error::NonFiniteMeasurement { edge: 0 }));
    assert!(matches!(
        fails(&|g| g.edges[2].information[(0, 1)] = 7.0),
        Error::InvalidInformation { edge: 2 }
    ));
    assert!(matches!(
        fails(&|g| g.edges[2].information[(3, 3)] = -9.0),
        Error::InvalidInformation { edge: 2 }
    ));
    for kernel in [0.0, -1.0, f64::NAN].map(Kernel::Huber) {
        let error = solve(&good, &Options { kernel, ..Options::default() }).unwrap_err();
        assert!(matches!(error, Error::InvalidOption { name: "kernel", .. }));
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// Whatever the topology and the numbers: no panic, no rise of the cost, finite poses, constants untouched.
    #[test]
    fn any_graph_is_solved_without_harm(
        joins in prop::collection::vec((0usize..12, 0usize..12, -3.0f64..3.0), 0..30),
        fixed in prop::collection::btree_set(0usize..12, 0..3),
        scale in -6i32..6,
    ) {
        let twist = |s: f64| Vector6::new(s, -s, 0.5 * s, 0.7 * s, s.sin(), 0.2);
        let poses: Vec<_> = (0..12).map(|k| se3::exp(&twist(0.3 * f64::from(k)))).collect();
        let information = Matrix6::identity() * 10f64.powi(scale);
        let edges = joins.iter().filter(|(a, b, _)| a != b);
        let edges = edges.map(|&(a, b, s)| RelativePose::new(a, b, se3::exp(&twist(s)), information)).collect();
        let graph = Graph { poses, edges, fixed };
        let solution = solve(&graph, &Options { max_iterations: 20, ..Options::default() }).unwrap();
        prop_assert!(solution.cost_final <= solution.cost_initial);
        prop_assert!(solution.poses.iter().all(|p| p.translation.vector.iter().all(|x| x.is_finite())));
        for &node in &graph.fixed {
            prop_assert_eq!(solution.poses[node], graph.poses[node]);
        }
        let again = Graph { poses: solution.poses, ..graph };
        let cost = again.half_chi_squared();
        prop_assert!((cost - solution.cost_final).abs() <= 1e-9 * (1.0 + cost));
    }
}

/// Published optima (GTSAM 4.3): half of chi squared 675.7 and 0.634.
#[test]
fn public_graphs_reach_their_optima() {
    for (name, optimum) in [("sphere2500", 675.7), ("parking-garage", 0.634)] {
        let path = format!("{}/../../../shared/data/g2o/{name}.g2o", env!("CARGO_MANIFEST_DIR"));
        let Ok(bytes) = std::fs::read(&path) else {
            println!("skipped: {name}.g2o is not there");
            continue;
        };
        let file = posegraph::g2o::parse(&bytes).unwrap();
        let solution = solve(&file.graph, &Options::default()).unwrap();
        let error = (solution.cost_final - optimum).abs() / optimum;
        assert!(solution.converged && error < 1e-3, "{name}: {}", solution.cost_final);
    }
}
