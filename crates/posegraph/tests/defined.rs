//! Every input has a defined result: structural mistakes are errors, bad data is dropped, costs never rise.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use common::{bumpy, matches, motion, node, orbit, render, rng, vector};
use nalgebra::{Isometry3, Matrix6, Translation3};
use posegraph::{
    DenseEdge, DenseView, Error, FeatureEdge, Pinhole, PoseGraph, PosePrior, SolveOptions, solve,
};
use proptest::prelude::*;
use rand::RngExt;

fn two_nodes<'a>() -> PoseGraph<'a> {
    let mut graph = PoseGraph::new();
    graph.add_node(node(Isometry3::identity(), true));
    graph.add_node(node(Isometry3::translation(0.01, 0.0, 0.0), false));
    graph
}

#[test]
fn an_empty_graph_has_an_empty_solution() {
    let solution = solve(&PoseGraph::new(), &SolveOptions::default()).unwrap();
    assert!(solution.poses.is_empty() && solution.converged);
    assert_eq!((solution.cost_initial, solution.cost_final, solution.iterations), (0.0, 0.0, 0));
}

#[test]
fn a_graph_without_terms_is_returned_as_it_is() {
    let graph = two_nodes();
    let solution = solve(&graph, &SolveOptions::default()).unwrap();
    assert!(solution.converged);
    for (node, pose) in graph.nodes().iter().zip(&solution.poses) {
        assert_eq!(node.obj_from_cam, *pose);
    }
    assert_eq!(solution.covariances, [None, None]);
}

#[test]
fn an_edge_without_usable_matches_changes_nothing() {
    let mut graph = two_nodes();
    let empty = FeatureEdge { i: 0, j: 1, points_i: vec![], points_j: vec![], weights: vec![] };
    graph.add_feature_edge(empty).unwrap();
    let bad = FeatureEdge {
        i: 0,
        j: 1,
        points_i: vec![[f32::NAN; 3], [0.0, f32::INFINITY, 0.0], [0.0; 3], [0.0; 3], [0.0; 3]],
        points_j: vec![[0.0; 3]; 5],
        weights: vec![1.0, 1.0, f32::NAN, -1.0, 0.0],
    };
    graph.add_feature_edge(bad).unwrap();
    let solution = solve(&graph, &SolveOptions::default()).unwrap();
    assert_eq!(solution.poses[1], graph.nodes()[1].obj_from_cam);
    assert_eq!(solution.feature_inliers, [0, 0]);
    assert_eq!(solution.cost_final, 0.0);
}

#[test]
fn nan_points_among_good_ones_are_dropped() {
    let mut rng = rng(70);
    let truth = [orbit(0.5, 0.0, 0.0), orbit(0.5, 0.3, 0.0)];
    let mut edge = matches(&mut rng, (0, &truth[0]), (1, &truth[1]), 40, 0.0, 0.0);
    edge.points_i[3] = [f32::NAN; 3];
    edge.points_j[9] = [0.0, f32::NEG_INFINITY, 0.0];
    let mut graph = PoseGraph::new();
    graph.add_node(node(truth[0], true));
    graph.add_node(node(truth[0], false));
    graph.add_feature_edge(edge).unwrap();
    let solution = solve(&graph, &SolveOptions::default()).unwrap();
    assert!(common::error(&solution.poses[1], &truth[1]).0 < 1e-5);
    assert_eq!(solution.feature_inliers, [38]);
}

#[test]
fn nan_poses_are_reported() {
    for fixed in [false, true] {
        let mut graph = two_nodes();
        let bad = Isometry3::from_parts(Translation3::new(f64::NAN, 0.0, 0.0), Default::default());
        graph.add_node(node(bad, fixed));
        assert_eq!(solve(&graph, &SolveOptions::default()), Err(Error::NonFinitePose { node: 2 }));
    }
}

#[test]
fn bad_indices_and_lengths_are_errors() {
    let mut graph = two_nodes();
    let edge = |i, j, n| FeatureEdge {
        i,
        j,
        points_i: vec![[0.0; 3]; 2],
        points_j: vec![[0.0; 3]; n],
        weights: vec![],
    };
    assert!(matches!(graph.add_feature_edge(edge(0, 2, 2)), Err(Error::NodeOutOfRange { index: 2, .. })));
    assert!(matches!(graph.add_feature_edge(edge(1, 1, 2)), Err(Error::SelfEdge { index: 1, .. })));
    assert!(matches!(graph.add_feature_edge(edge(0, 1, 3)), Err(Error::LengthMismatch { .. })));
    let mut weights = edge(0, 1, 2);
    weights.weights = vec![1.0];
    assert!(matches!(graph.add_feature_edge(weights), Err(Error::LengthMismatch { .. })));
    let dense = DenseEdge { source: 0, target: 1 };
    assert_eq!(graph.add_dense_edge(dense), Err(Error::MissingView { node: 0 }));
    let camera = Pinhole { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
    let view = |camera, normals: &[[f32; 3]]| DenseView::new((2, 2), camera, &[[0.0; 3]; 4], normals);
    assert!(matches!(view(camera, &[[0.0; 3]; 3]), Err(Error::LengthMismatch { .. })));
    let broken = Pinhole { fx: f64::NAN, ..camera };
    assert_eq!(view(broken, &[[0.0; 3]; 4]), Err(Error::InvalidCamera));
    let view = view(camera, &[[0.0; 3]; 4]).unwrap();
    assert!(matches!(graph.clone().set_view(7, &view), Err(Error::NodeOutOfRange { .. })));
    assert!(matches!(
        graph.set_prediction(2, Isometry3::identity()),
        Err(Error::NodeOutOfRange { index: 2, .. })
    ));
    let nowhere = Isometry3::translation(f64::NAN, 0.0, 0.0);
    assert_eq!(graph.set_prediction(1, nowhere), Err(Error::NonFinitePose { node: 1 }));
    let prior = |information| PosePrior { node: 1, obj_from_cam: Isometry3::identity(), information };
    for bad in [Matrix6::from_element(f64::NAN), -Matrix6::identity()] {
        assert_eq!(graph.add_prior(prior(bad)), Err(Error::InvalidInformation { node: 1 }));
    }
    let options = SolveOptions { dense_huber: 0.0, ..SolveOptions::default() };
    assert_eq!(solve(&graph, &options), Err(Error::InvalidOption { name: "dense_huber", value: 0.0 }));
}

/// A random, often badly posed graph: wild poses, inconsistent matches, disconnected parts, rank deficiency.
fn random_graph<'a>(seed: u64, views: &'a [DenseView]) -> PoseGraph<'a> {
    let mut rng = rng(seed);
    let nodes = rng.random_range(1..6);
    let mut graph = PoseGraph::new();
    for k in 0..nodes {
        let spread = if rng.random_bool(0.5) { 0.02 } else { 2.0 };
        let pose = motion(&mut rng, spread, spread.min(3.0)) * orbit(0.5, 0.0, 0.0);
        graph.add_node(node(pose, rng.random_bool(0.2)));
        graph.set_view(k, &views[k % views.len()]).unwrap();
    }
    for i in 0..nodes {
        for j in 0..i {
            if rng.random_bool(0.5) {
                let (a, b) = (motion(&mut rng, 0.5, 2.0), motion(&mut rng, 0.5, 2.0));
                let count = rng.random_range(0..12);
                let noise = rng.random_range(0.0..0.05);
                graph.add_feature_edge(matches(&mut rng, (i, &a), (j, &b), count, noise, 0.3)).unwrap();
            }
            if rng.random_bool(0.3) {
                graph.add_dense_edge(DenseEdge { source: i, target: j }).unwrap();
            }
        }
        if rng.random_bool(0.2) {
            let v = vector(&mut rng, 100.0);
            let mut information = Matrix6::zeros();
            information.fixed_view_mut::<3, 3>(0, 0).copy_from(&(v * v.transpose()));
            let obj_from_cam = motion(&mut rng, 0.3, 3.0);
            graph.add_prior(PosePrior { node: i, obj_from_cam, information }).unwrap();
        }
    }
    graph
}

#[test]
fn a_thousand_random_problems_never_diverge() {
    let mut noise = rng(80);
    let views: Vec<DenseView> =
        (0..3).map(|k| render(bumpy, &orbit(0.5, 0.2 * k as f64, 0.0), 40, 0.001, &mut noise)).collect();
    let mut improved = 0;
    for seed in 0..1000 {
        let graph = random_graph(seed, &views);
        let solution = solve(&graph, &SolveOptions::default()).unwrap();
        assert!(solution.cost_final.is_finite() && solution.cost_final <= solution.cost_initial, "{seed}");
        assert!(solution.poses.iter().all(|p| p.translation.vector.iter().all(|x| x.is_finite())), "{seed}");
        for (node, pose) in graph.nodes().iter().zip(&solution.poses) {
            assert!(!node.fixed || node.obj_from_cam == *pose);
            assert!((pose.rotation.as_ref().norm() - 1.0).abs() < 1e-9);
        }
        improved += usize::from(solution.cost_final < solution.cost_initial);
    }
    assert!(improved > 500, "{improved}");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

    /// Moving the object frame (gauge) moves the answer along and changes nothing else.
    #[test]
    fn the_answer_does_not_depend_on_the_object_frame(seed in 0u64..10_000) {
        let mut rng = rng(seed);
        let truth = [orbit(0.5, 0.0, 0.0), orbit(0.5, 0.3, 0.1), orbit(0.5, 0.5, -0.1)];
        let start: Vec<_> = truth.iter().map(|t| common::disturb(&mut rng, t, 0.01, 4.0)).collect();
        let mut edges = Vec::new();
        for i in 0..3 {
            for j in 0..i {
                edges.push(matches(&mut rng, (i, &truth[i]), (j, &truth[j]), 30, 0.001, 0.1));
            }
        }
        let gauge = motion(&mut rng, 0.2, 2.0);
        let options = SolveOptions { max_iterations: 60, cost_tolerance: 1e-12, ..SolveOptions::default() };
        let run = |gauge: &Isometry3<f64>| {
            let mut graph = PoseGraph::new();
            for (k, pose) in start.iter().enumerate() {
                graph.add_node(node(gauge * pose, k == 0));
            }
            for edge in &edges {
                graph.add_feature_edge(edge.clone()).unwrap();
            }
            solve(&graph, &options).unwrap()
        };
        let (a, b) = (run(&Isometry3::identity()), run(&gauge));
        for (a, b) in a.poses.iter().zip(&b.poses) {
            let (t, r) = common::error(&(gauge.inverse() * b), a);
            prop_assert!(t < 1e-4 && r < 0.02, "{} {}", t, r);
        }
    }

    /// Any bits in the matches give a finite pose and no rise of the cost.
    #[test]
    fn arbitrary_floats_never_break_the_solve(
        values in prop::collection::vec(any::<f32>(), 42),
        weights in prop::collection::vec(any::<f32>(), 7),
    ) {
        let points: Vec<[f32; 3]> = values.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect();
        let (a, b) = points.split_at(7);
        let mut graph = two_nodes();
        graph
            .add_feature_edge(FeatureEdge {
                i: 0,
                j: 1,
                points_i: a.to_vec(),
                points_j: b.to_vec(),
                weights,
            })
            .unwrap();
        let solution = solve(&graph, &SolveOptions::default()).unwrap();
        prop_assert!(solution.poses[1].translation.vector.iter().all(|x| x.is_finite()));
        prop_assert!(solution.cost_final <= solution.cost_initial || solution.cost_initial.is_nan());
    }
}
