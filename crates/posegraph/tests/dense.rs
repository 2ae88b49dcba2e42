//! Dense edges on synthetic views of a bumpy surface.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use common::{bumpy, disturb, error, images, node, orbit, render, rng, view};
use posegraph::{DenseEdge, DenseView, PoseGraph, SolveOptions, solve};

#[test]
fn a_displaced_view_returns_to_the_surface() {
    let truth = [orbit(0.5, 0.0, 0.0), orbit(0.5, 0.3, 0.15)];
    let mut noise = rng(40);
    let views = truth.map(|t| render(bumpy, &t, 120, 0.0, &mut noise));
    for seed in 0..8 {
        let mut rng = rng(50 + seed);
        let mut graph = PoseGraph::new();
        graph.add_node(node(truth[0], true));
        graph.add_node(node(disturb(&mut rng, &truth[1], 0.01, 5.0), false));
        for (k, view) in views.iter().enumerate() {
            graph.set_view(k, view).unwrap();
        }
        graph.add_dense_edge(DenseEdge { source: 1, target: 0 }).unwrap();
        let solution = solve(&graph, &SolveOptions::default()).unwrap();
        let (t, r) = error(&solution.poses[1], &truth[1]);
        // The bisecting normal cancels the curvature bias: with the target's normal alone this is 0.2 deg.
        assert!(t < 5e-5 && r < 0.05, "seed {seed}: {t} m, {r} deg after {}", solution.iterations);
        assert!(solution.cost_final < solution.cost_initial);
        assert!(solution.dense_inliers[0] > 300, "{:?}", solution.dense_inliers);
        assert!(solution.dense_rms < 5e-4, "{}", solution.dense_rms);
        assert_eq!(solution.observability.unwrap().held().count(), 0);
    }
}

#[test]
fn several_noisy_views_are_refined_together() {
    let truth: Vec<_> = (0..4).map(|k| orbit(0.5, 0.25 * k as f64, 0.1 * k as f64)).collect();
    let mut rng = rng(60);
    let views: Vec<DenseView> = truth.iter().map(|t| render(bumpy, t, 120, 0.001, &mut rng)).collect();
    let mut graph = PoseGraph::new();
    for (k, t) in truth.iter().enumerate() {
        graph.add_node(if k == 0 { node(*t, true) } else { node(disturb(&mut rng, t, 0.006, 3.0), false) });
    }
    for (k, view) in views.iter().enumerate() {
        graph.set_view(k, view).unwrap();
        for other in 0..k {
            graph.set_view(other, &views[other]).unwrap();
            graph.add_dense_edge(DenseEdge { source: other, target: k }).unwrap();
        }
    }
    let solution = solve(&graph, &SolveOptions::default()).unwrap();
    for (pose, truth) in solution.poses.iter().zip(&truth) {
        let (t, r) = error(pose, truth);
        // 1 mm of noise on a nearly round object: the covariance predicts about half a degree.
        assert!(t < 5e-4 && r < 1.0, "{t} m, {r} deg");
    }
    // Same input, same bits.
    assert_eq!(solution, solve(&graph, &SolveOptions::default()).unwrap());
}

#[test]
fn views_too_far_apart_are_skipped() {
    let truth = [orbit(0.5, 0.0, 0.0), orbit(0.5, 1.2, 0.0)];
    let mut rng = rng(61);
    let views = truth.map(|t| render(bumpy, &t, 60, 0.0, &mut rng));
    let start = disturb(&mut rng, &truth[1], 0.005, 2.0);
    let mut graph = PoseGraph::new();
    graph.add_node(node(truth[0], true));
    graph.add_node(node(start, false));
    graph.set_view(0, &views[0]).unwrap();
    graph.set_view(1, &views[1]).unwrap();
    graph.add_dense_edge(DenseEdge { source: 1, target: 0 }).unwrap();
    let solution = solve(&graph, &SolveOptions::default()).unwrap();
    assert_eq!(solution.dense_inliers, [0]);
    assert_eq!(solution.poses[1], start);
}

#[test]
fn a_plane_leaves_three_directions_free_and_they_do_not_drift() {
    let plane = |x: &nalgebra::Vector3<f64>| -x.z;
    let truth = orbit(0.5, 0.0, 0.0);
    let mut rng = rng(62);
    let view = render(plane, &truth, 60, 0.0, &mut rng);
    let start = nalgebra::Isometry3::translation(0.003, 0.002, 0.004) * truth;
    let mut graph = PoseGraph::new();
    graph.add_node(node(truth, true));
    graph.add_node(node(start, false));
    graph.set_view(0, &view).unwrap();
    graph.set_view(1, &view).unwrap();
    graph.add_dense_edge(DenseEdge { source: 1, target: 0 }).unwrap();
    let solution = solve(&graph, &SolveOptions::default()).unwrap();
    let moved = solution.poses[1].translation.vector - truth.translation.vector;
    assert!(moved.z.abs() < 1e-5, "{moved}");
    assert!((moved.x - 0.003).abs() < 1e-4 && (moved.y - 0.002).abs() < 1e-4, "{moved}");
    let directions = solution.observability.unwrap().directions;
    assert!(directions[2].information < 1e-3 * directions[3].information, "{directions:?}");
}

#[test]
fn holes_and_nan_in_views_are_ignored() {
    let truth = [orbit(0.5, 0.0, 0.0), orbit(0.5, 0.2, 0.1)];
    let mut rng = rng(63);
    let views = truth.map(|t| {
        let (mut points, mut normals) = images(bumpy, &t, 120, 0.0, &mut rng);
        for k in (0..points.len()).step_by(7) {
            match k % 3 {
                0 => points[k] = [f32::NAN; 3],
                1 => normals[k] = [f32::NAN; 3],
                _ => normals[k] = [0.0; 3],
            }
        }
        view(120, &points, &normals)
    });
    let mut graph = PoseGraph::new();
    graph.add_node(node(truth[0], true));
    graph.add_node(node(disturb(&mut rng, &truth[1], 0.005, 2.0), false));
    graph.set_view(0, &views[0]).unwrap();
    graph.set_view(1, &views[1]).unwrap();
    graph.add_dense_edge(DenseEdge { source: 0, target: 1 }).unwrap();
    let solution = solve(&graph, &SolveOptions::default()).unwrap();
    let (t, r) = error(&solution.poses[1], &truth[1]);
    assert!(t < 5e-4 && r < 0.2, "{t} {r}");
}

/// Coarse first iterations and the re-use of associations must not decide where the solve ends.
#[test]
fn faster_sums_and_searches_leave_the_optimum_where_it_is() {
    let truth: Vec<_> = (0..4).map(|k| orbit(0.5, 0.25 * k as f64, 0.1 * k as f64)).collect();
    let mut rng = rng(60);
    let views: Vec<DenseView> = truth.iter().map(|t| render(bumpy, t, 120, 0.001, &mut rng)).collect();
    let solve_from = |spread: f64, options: &SolveOptions| {
        let mut rng = common::rng(7);
        let mut graph = PoseGraph::new();
        for (k, t) in truth.iter().enumerate() {
            let start = if k == 0 { *t } else { disturb(&mut rng, t, 0.006 * spread, 3.0 * spread) };
            graph.add_node(node(start, k == 0));
            graph.set_view(k, &views[k]).unwrap();
            (0..k).for_each(|o| graph.add_dense_edge(DenseEdge { source: o, target: k }).unwrap());
        }
        solve(&graph, options).unwrap()
    };
    // From far through coarse iterations, and from near with the last gates and all samples from the start.
    let far = solve_from(1.0, &SolveOptions { max_iterations: 30, ..SolveOptions::default() });
    let fine = SolveOptions { tighten_iterations: 0, max_iterations: 30, ..SolveOptions::default() };
    let near = solve_from(0.1, &fine);
    for (a, b) in far.poses.iter().zip(&near.poses) {
        let (t, r) = error(a, b);
        assert!(t < 2e-4 && r < 0.15, "{t} m, {r} deg");
    }
}

/// Edges that share their pixels meet where edges that have all of theirs do, and know as much.
#[test]
fn a_share_of_the_pixels_finds_the_same_poses_with_the_same_information() {
    let truth: Vec<_> = (0..4).map(|k| orbit(0.5, 0.2 * k as f64, 0.1 * k as f64)).collect();
    let mut rng = rng(65);
    let views: Vec<DenseView> = truth.iter().map(|t| render(bumpy, t, 120, 0.0, &mut rng)).collect();
    let mut graph = PoseGraph::new();
    for (k, t) in truth.iter().enumerate() {
        graph.add_node(if k == 0 { node(*t, true) } else { node(disturb(&mut rng, t, 0.004, 2.0), false) });
        graph.set_view(k, &views[k]).unwrap();
        (0..k).for_each(|o| graph.add_dense_edge(DenseEdge { source: k, target: o }).unwrap());
    }
    let all = SolveOptions { max_iterations: 30, ..SolveOptions::default() };
    let shared = SolveOptions { max_dense: 6 * 290, ..all.clone() };
    let [all, shared] = [all, shared].map(|options| solve(&graph, &options).unwrap());
    let (of_all, of_shared): (usize, usize) =
        (all.dense_inliers.iter().sum(), shared.dense_inliers.iter().sum());
    assert!(2 * of_shared < of_all && of_shared > 0, "{of_shared} of {of_all}");
    for k in 1..4 {
        let (t, r) = error(&all.poses[k], &shared.poses[k]);
        assert!(t < 2e-4 && r < 0.15, "{t} m, {r} deg");
        let [known, still_known] = [&all, &shared].map(|s| s.covariances[k].unwrap().trace());
        assert!((0.8..1.25).contains(&(still_known / known)), "{known} {still_known}");
    }
}

/// However many threads there are, the bits are the same.
#[cfg(feature = "rayon")]
#[test]
fn threads_do_not_change_the_result() {
    let ball = |x: &nalgebra::Vector3<f64>| x.norm() - 0.1;
    let truth: Vec<_> = (0..3).map(|k| orbit(0.5, 0.25 * k as f64, 0.0)).collect();
    let mut rng = rng(64);
    let views: Vec<DenseView> = truth.iter().map(|t| render(ball, t, 40, 0.0, &mut rng)).collect();
    let mut graph = PoseGraph::new();
    for (k, t) in truth.iter().enumerate() {
        graph.add_node(node(disturb(&mut rng, t, 0.004, 2.0), k == 0));
        graph.set_view(k, &views[k]).unwrap();
        (0..k).for_each(|o| graph.add_dense_edge(DenseEdge { source: o, target: k }).unwrap());
    }
    let solve_on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| solve(&graph, &SolveOptions::default()).unwrap())
    };
    assert_eq!(solve_on(1), solve_on(3));
}
