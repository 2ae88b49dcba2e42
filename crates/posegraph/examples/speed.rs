//! Times a solve of the size an online tracker has: 11 nodes, 45 pairs of 200 matches each, 40 000 dense residuals.
#![allow(clippy::print_stdout)]

use std::time::Instant;

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use posegraph::{DenseEdge, DenseView, Error, FeatureEdge, Node, Pinhole, PoseGraph, SolveOptions, solve};

/// Camera that looks at the object's centre from 0.5 m.
fn orbit(yaw: f64, pitch: f64) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_euler_angles(pitch, yaw, 0.0);
    Isometry3::from_parts(Translation3::from(rotation * Vector3::new(0.0, 0.0, -0.5)), rotation)
}

/// Semi-axes of the ellipsoid that is seen.
const AXES: Vector3<f64> = Vector3::new(0.07, 0.09, 0.11);

/// A 160 x 120 view of the ellipsoid.
fn view(obj_from_cam: &Isometry3<f64>) -> Result<DenseView, Error> {
    let (width, height, focal) = (160, 120, 300.0);
    let (cx, cy) = (79.5, 59.5);
    let (mut points, mut normals) = (Vec::new(), Vec::new());
    let origin = obj_from_cam.translation.vector.component_div(&AXES);
    for v in 0..height {
        for u in 0..width {
            let ray = Vector3::new((f64::from(u) - cx) / focal, (f64::from(v) - cy) / focal, 1.0);
            let d = (obj_from_cam.rotation * ray).component_div(&AXES);
            let (a, b, c) = (d.norm_squared(), d.dot(&origin), origin.norm_squared() - 1.0);
            let root = b * b - a * c;
            let (mut p, mut n) = (Vector3::zeros(), Vector3::zeros());
            if root > 0.0 {
                p = ray * ((-b - root.sqrt()) / a);
                let x = obj_from_cam.transform_point(&Point3::from(p)).coords;
                let normal = x.component_div(&AXES).component_div(&AXES).normalize();
                n = obj_from_cam.rotation.inverse() * normal;
            }
            points.push([p.x as f32, p.y as f32, p.z as f32]);
            normals.push([n.x as f32, n.y as f32, n.z as f32]);
        }
    }
    let (width, height) = (width as usize, height as usize);
    DenseView::new((width, height), Pinhole { fx: focal, fy: focal, cx, cy }, &points, &normals)
}

fn main() -> Result<(), Error> {
    let truth: Vec<_> = (0..11).map(|k| orbit(0.08 * f64::from(k), 0.05 * f64::from(k % 3))).collect();
    let views = truth.iter().map(view).collect::<Result<Vec<_>, Error>>()?;
    let mut graph = PoseGraph::new();
    for (k, pose) in truth.iter().enumerate() {
        let s = 0.002 * (k as f64 * 1.7).sin();
        let wrong = Isometry3::new(Vector3::new(s, -s, 0.5 * s), Vector3::new(4.0 * s, 0.0, -6.0 * s)) * pose;
        graph.add_node(Node { obj_from_cam: if k == 0 { *pose } else { wrong }, fixed: k == 0 });
        graph.set_view(k, &views[k])?;
    }
    let pairs: Vec<_> =
        (0..11).flat_map(|i| (0..i).map(move |j| (i, j))).filter(|(i, j)| i - j < 7).collect();
    for &(i, j) in &pairs {
        let seen = |node: usize, k: usize, noise: f64| {
            let s = |f: f64| (f * k as f64).sin();
            let x = Point3::new(0.07 * s(1.3), 0.09 * s(2.1), 0.1 * s(0.7))
                + Vector3::new(s(9.1), s(8.3), s(7.7)) * noise;
            let p = truth[node].inverse_transform_point(&x);
            [p.x as f32, p.y as f32, p.z as f32]
        };
        let points_i = (0..200).map(|k| seen(i, k, 0.0)).collect();
        let points_j = (0..200).map(|k| seen(j, k, 0.001)).collect();
        graph.add_feature_edge(FeatureEdge { i, j, points_i, points_j, weights: Vec::new() })?;
        graph.add_dense_edge(DenseEdge { source: i, target: j })?;
    }
    let options = SolveOptions { max_dense_per_edge: 930, ..SolveOptions::default() };
    let mut times = Vec::new();
    let mut solution = solve(&graph, &options)?;
    for _ in 0..50 {
        let start = Instant::now();
        solution = solve(&graph, &options)?;
        times.push(start.elapsed().as_secs_f64() * 1e3);
    }
    times.sort_by(f64::total_cmp);
    println!(
        "{} nodes, {} pairs, {} feature and {} dense inliers: {} iterations, median {:.2} ms, best {:.2} ms, cost {:.1} -> {:.1}, converged {}",
        truth.len(),
        pairs.len(),
        solution.feature_inliers.iter().sum::<usize>(),
        solution.dense_inliers.iter().sum::<usize>(),
        solution.iterations,
        times[times.len() / 2],
        times[0],
        solution.cost_initial,
        solution.cost_final,
        solution.converged
    );
    Ok(())
}
