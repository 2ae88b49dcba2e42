//! A triangle of poses with redundant, noisy matches: build, solve, print.
#![allow(clippy::print_stdout)]

use nalgebra::{Isometry3, Point3, Vector3};
use posegraph::{Error, FeatureEdge, Node, PoseGraph, SolveOptions, solve};

/// Points of a small grid as both cameras see them, 1 mm of deterministic "noise" in the second.
fn edge(i: usize, j: usize, truth: &[Isometry3<f64>]) -> FeatureEdge {
    let seen = |node: usize, x: &Point3<f64>| {
        let p = truth[node].inverse_transform_point(x);
        [p.x as f32, p.y as f32, p.z as f32]
    };
    let (mut points_i, mut points_j) = (Vec::new(), Vec::new());
    for k in 0..27 {
        let x = Point3::new(f64::from(k % 3), f64::from(k / 3 % 3), f64::from(k / 9)) * 0.05;
        let phase = f64::from(k) + 10.0 * i as f64;
        let noise = Vector3::new((7.0 * phase).sin(), (5.0 * phase).cos(), (3.0 * phase).sin()) * 1e-3;
        points_i.push(seen(i, &x));
        points_j.push(seen(j, &(x + noise)));
    }
    FeatureEdge { i, j, points_i, points_j, weights: Vec::new() }
}

fn main() -> Result<(), Error> {
    let truth = [
        Isometry3::translation(0.0, 0.0, -0.5),
        Isometry3::new(Vector3::new(0.3, 0.0, -0.4), Vector3::new(0.0, -0.6, 0.0)),
        Isometry3::new(Vector3::new(-0.3, 0.1, -0.4), Vector3::new(0.2, 0.6, 0.0)),
    ];
    let mut graph = PoseGraph::new();
    for (k, pose) in truth.iter().enumerate() {
        let disturbed = Isometry3::new(Vector3::new(0.02, -0.01, 0.01), Vector3::new(0.0, 0.1, 0.05)) * pose;
        graph.add_node(Node { obj_from_cam: if k == 0 { *pose } else { disturbed }, fixed: k == 0 });
    }
    for (i, j) in [(0, 1), (1, 2), (2, 0)] {
        graph.add_feature_edge(edge(i, j, &truth))?;
    }
    let solution = solve(&graph, &SolveOptions::default())?;
    println!(
        "cost {:.1} -> {:.1} in {} iterations, converged: {}, rms {:.2} deviations",
        solution.cost_initial,
        solution.cost_final,
        solution.iterations,
        solution.converged,
        solution.feature_rms
    );
    for (k, (pose, truth)) in solution.poses.iter().zip(&truth).enumerate() {
        let error = pose * truth.inverse();
        let sigma = solution.covariances[k].map_or(0.0, |c| c[(0, 0)].sqrt());
        println!(
            "node {k}: error {:.3} mm, {:.3} deg; sigma of x {:.3} mm",
            1e3 * error.translation.vector.norm(),
            error.rotation.angle().to_degrees(),
            1e3 * sigma
        );
    }
    Ok(())
}
