//! Feature edges, priors, fixed nodes and covariance against problems whose answer is known.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use common::{disturb, error, matches, motion, node, orbit, rng, vector};
use nalgebra::{Isometry3, Matrix6, Vector6};
use posegraph::{FeatureEdge, PoseGraph, PosePrior, SolveOptions, solve};
use rand::RngExt;
use se3_lie::se3;

/// Four points of a rigid body, seen alike by both nodes: they pull the poses together.
fn pull_together(i: usize, j: usize) -> FeatureEdge {
    let points = vec![[0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1], [-0.1, -0.1, -0.1]];
    FeatureEdge { i, j, points_i: points.clone(), points_j: points, weights: Vec::new() }
}

#[test]
fn a_node_between_two_fixed_ones_takes_the_constrained_optimum() {
    // One-dimensional: new x, fixed y = 1 and z = 0, edges x - y = 0 and y - z = 0. Treating y as an unknown whose
    // increment is dropped afterwards gives x = 0 or 1/2; eliminating it gives x = 1.
    let mut graph = PoseGraph::new();
    let z = graph.add_node(node(Isometry3::translation(0.0, 0.0, 0.0), true));
    let y = graph.add_node(node(Isometry3::translation(1.0, 0.0, 0.0), true));
    let x = graph.add_node(node(Isometry3::translation(0.3, 0.0, 0.0), false));
    graph.add_feature_edge(pull_together(x, y)).unwrap();
    graph.add_feature_edge(pull_together(y, z)).unwrap();
    let solution = solve(&graph, &SolveOptions::default()).unwrap();
    assert!(solution.converged);
    assert!((solution.poses[x].translation.x - 1.0).abs() < 1e-6, "{}", solution.poses[x].translation.x);
    assert_eq!(solution.poses[y], graph.nodes()[y].obj_from_cam);
    assert_eq!(solution.poses[z], graph.nodes()[z].obj_from_cam);
    assert_eq!(solution.feature_inliers, [4, 0], "an edge between two fixed nodes is skipped");
    assert!(solution.covariances[x].is_some() && solution.covariances[y].is_none());
}

#[test]
fn fixed_nodes_come_back_bit_for_bit() {
    let mut rng = rng(7);
    let mut graph = PoseGraph::new();
    for k in 0..5 {
        graph.add_node(node(motion(&mut rng, 0.3, 1.0), k % 2 == 0));
    }
    for i in 0..5 {
        for j in 0..i {
            let (a, b) = (motion(&mut rng, 0.3, 1.0), motion(&mut rng, 0.3, 1.0));
            graph.add_feature_edge(matches(&mut rng, (i, &a), (j, &b), 20, 0.01, 0.2)).unwrap();
        }
    }
    let solution = solve(&graph, &SolveOptions::default()).unwrap();
    for (node, pose) in graph.nodes().iter().zip(&solution.poses).step_by(2) {
        let bits = |t: &Isometry3<f64>| {
            let q = t.rotation.coords;
            let t = t.translation.vector;
            [t.x, t.y, t.z, q.x, q.y, q.z, q.w].map(f64::to_bits)
        };
        assert_eq!(bits(&node.obj_from_cam), bits(pose));
    }
    assert!(solution.cost_final < solution.cost_initial);
}

#[test]
fn without_an_anchor_the_first_node_is_held() {
    let mut rng = rng(8);
    let truth = [orbit(0.5, 0.0, 0.1), orbit(0.5, 0.4, 0.0)];
    let mut graph = PoseGraph::new();
    graph.add_node(node(truth[0], false));
    graph.add_node(node(disturb(&mut rng, &truth[1], 0.02, 5.0), false));
    graph.add_feature_edge(matches(&mut rng, (0, &truth[0]), (1, &truth[1]), 50, 0.0, 0.0)).unwrap();
    let solution = solve(&graph, &SolveOptions::default()).unwrap();
    assert_eq!(solution.poses[0], truth[0]);
    let (t, r) = error(&solution.poses[1], &truth[1]);
    assert!(t < 1e-6 && r < 1e-4, "{t} {r}");
}

#[test]
fn noisy_graphs_with_outliers_recover_the_truth() {
    for seed in 0..6 {
        let mut rng = rng(100 + seed);
        let truth: Vec<_> = (0..8).map(|k| orbit(0.5, 0.25 * k as f64, 0.1 * (k % 3) as f64)).collect();
        let mut graph = PoseGraph::new();
        graph.add_node(node(truth[0], true));
        for t in &truth[1..] {
            graph.add_node(node(disturb(&mut rng, t, 0.02, 8.0), false));
        }
        for i in 0..8 {
            for j in 0..i {
                let edge = matches(&mut rng, (i, &truth[i]), (j, &truth[j]), 80, 0.001, 0.3);
                graph.add_feature_edge(edge).unwrap();
            }
        }
        // Up to a millimetre in each coordinate, half a metre away.
        let angle = 0.001 / 3f64.sqrt() / 0.5;
        let options = SolveOptions { max_iterations: 30, feature_angle: angle, ..SolveOptions::default() };
        let solution = solve(&graph, &options).unwrap();
        assert!(solution.converged, "seed {seed}: {} iterations", solution.iterations);
        for (pose, truth) in solution.poses.iter().zip(&truth) {
            let (t, r) = error(pose, truth);
            assert!(t < 0.001 && r < 0.5, "seed {seed}: {t} m, {r} deg");
        }
        assert!(solution.feature_inliers.iter().all(|&n| (45..=75).contains(&n)));
    }
}

#[test]
fn a_depth_that_is_off_everywhere_moves_a_pose_less_than_it_is_off() {
    // A camera whose depth is 3 mm too long sees the same points as four right ones. Their pixels are exact.
    let mut rng = rng(11);
    let truth: Vec<_> = (0..5).map(|k| orbit(0.5, 0.2 * f64::from(k), 0.0)).collect();
    let mut graph = PoseGraph::new();
    for (k, pose) in truth.iter().enumerate() {
        graph.add_node(node(*pose, k < 4));
    }
    for k in 0..4 {
        let mut edge = matches(&mut rng, (k, &truth[k]), (4, &truth[4]), 100, 0.0, 0.0);
        for p in &mut edge.points_j {
            let scale = 1.0 + 0.003 / p.iter().map(|c| c * c).sum::<f32>().sqrt();
            *p = p.map(|c| c * scale);
        }
        graph.add_feature_edge(edge).unwrap();
    }
    let off = |angle: f64| {
        let options = SolveOptions { feature_angle: angle, ..SolveOptions::default() };
        error(&solve(&graph, &options).unwrap().poses[4], &truth[4]).0
    };
    // As uncertain across the rays as along them, half a metre away.
    let alike = off(0.003);
    let by_rays = off(0.000_3);
    assert!(alike > 0.002, "{alike}");
    assert!(by_rays < 0.5 * alike, "{by_rays} {alike}");
}

#[test]
fn the_count_cap_keeps_a_crowded_edge_from_dominating() {
    // Node 1 is pulled to x = 0 by 100 000 matches and to x = 2 mm by 200: with the cap it stands in the middle.
    let mut graph = PoseGraph::new();
    graph.add_node(node(Isometry3::identity(), true));
    graph.add_node(node(Isometry3::identity(), false));
    graph.add_node(node(Isometry3::translation(0.002, 0.0, 0.0), true));
    let repeated = |i, j, times: usize| {
        let mut edge = pull_together(i, j);
        edge.points_i = edge.points_i.repeat(times);
        edge.points_j = edge.points_j.repeat(times);
        edge
    };
    graph.add_feature_edge(repeated(1, 0, 25_000)).unwrap();
    graph.add_feature_edge(repeated(1, 2, 50)).unwrap();
    let x = |options: &SolveOptions| solve(&graph, options).unwrap().poses[1].translation.x;
    // Two millimetres are far for points at a decimetre.
    let capped = SolveOptions { feature_huber: 1e3, ..SolveOptions::default() };
    assert!((x(&capped) - 0.001).abs() < 1e-6);
    let uncapped = SolveOptions { feature_cap: f64::INFINITY, ..capped };
    assert!(x(&uncapped) < 1e-5);
}

#[test]
fn a_lone_prior_is_reached_and_its_covariance_is_the_inverse_information() {
    let mut rng = rng(9);
    let mean = motion(&mut rng, 0.2, 0.8);
    let root = Matrix6::from_fn(|_, _| rng.random_range(-1.0..1.0)) + Matrix6::identity() * 3.0;
    let information = root * root.transpose() * 100.0;
    let mut graph = PoseGraph::new();
    let n = graph.add_node(node(disturb(&mut rng, &mean, 0.1, 20.0), false));
    graph.add_prior(PosePrior { node: n, obj_from_cam: mean, information }).unwrap();
    let solution = solve(&graph, &SolveOptions::default()).unwrap();
    assert!(se3::log(&(solution.poses[n] * mean.inverse())).norm() < 1e-5);
    let covariance = solution.covariances[n].unwrap();
    let expected = information.try_inverse().unwrap();
    assert!((covariance - expected).amax() < 1e-6 * expected.amax());
}

#[test]
fn covariance_is_the_inverse_hessian_in_a_linear_chain() {
    // Priors of information a on node 0 (via a fixed mean) and matches between 0 and 1. At zero residual the problem
    // is linear; the Hessian is written out from the definition and inverted.
    let mut rng = rng(10);
    let mut graph = PoseGraph::new();
    let t = Isometry3::identity();
    graph.add_node(node(t, false));
    graph.add_node(node(t, false));
    let information = Matrix6::from_diagonal(&Vector6::new(1e5, 2e5, 3e5, 1e4, 2e4, 3e4));
    graph.add_prior(PosePrior { node: 0, obj_from_cam: t, information }).unwrap();
    let points: Vec<[f32; 3]> = (0..40)
        .map(|_| {
            let v = vector(&mut rng, 0.1);
            [v.x as f32, v.y as f32, v.z as f32]
        })
        .collect();
    let edge =
        FeatureEdge { i: 0, j: 1, points_i: points.clone(), points_j: points.clone(), weights: Vec::new() };
    graph.add_feature_edge(edge).unwrap();
    let options = SolveOptions::default();
    let solution = solve(&graph, &options).unwrap();

    let mut block = Matrix6::zeros();
    for p in &points {
        let x = nalgebra::Vector3::from(p.map(f64::from));
        let mut j = nalgebra::Matrix3x6::zeros();
        j.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
        j.fixed_view_mut::<3, 3>(0, 3).copy_from(&-x.cross_matrix());
        let across = (options.feature_angle * x.norm()).powi(2);
        let along = options.depth_sigma_constant + options.depth_sigma_quadratic * x.norm_squared();
        let ray = x.normalize();
        let covariance =
            nalgebra::Matrix3::identity() * across + ray * ray.transpose() * (along * along - across);
        block += j.transpose() * (2.0 * covariance).try_inverse().unwrap() * j;
    }
    // H = [P + B, -B; -B, B]: the inverse has P^-1 and P^-1 + B^-1 on its diagonal.
    let prior = information.try_inverse().unwrap();
    let expected = [prior, prior + block.try_inverse().unwrap()];
    for (got, expected) in solution.covariances.iter().zip(expected) {
        assert!((got.unwrap() - expected).amax() < 1e-6 * expected.amax());
    }
    assert_eq!((solution.cost_initial, solution.cost_final), (0.0, 0.0));
}

#[test]
fn unobservable_directions_are_held_and_reported() {
    // All matches on one line: the spin about it is free.
    let line: Vec<[f32; 3]> = (0..20).map(|k| [0.01 * k as f32, 0.0, 0.0]).collect();
    let shifted: Vec<[f32; 3]> = line.iter().map(|p| [p[0], p[1] + 0.01, p[2]]).collect();
    let mut graph = PoseGraph::new();
    graph.add_node(node(Isometry3::identity(), true));
    graph.add_node(node(Isometry3::rotation(nalgebra::Vector3::new(0.2, 0.0, 0.0)), false));
    let edge = FeatureEdge { i: 1, j: 0, points_i: line, points_j: shifted, weights: Vec::new() };
    graph.add_feature_edge(edge).unwrap();
    let solution = solve(&graph, &SolveOptions::default()).unwrap();
    assert!(solution.converged && solution.feature_rms < 1e-5);
    let spin = solution.poses[1].rotation.scaled_axis();
    assert!((spin.x - 0.2).abs() < 1e-4 && (solution.poses[1].translation.y - 0.01).abs() < 1e-5, "{spin}");
    assert!(solution.covariances[1].is_none());
    assert_eq!(solution.observability.unwrap().held().count(), 1);
}
