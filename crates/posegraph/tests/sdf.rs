//! SDF terms on analytic shapes.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use common::{disturb, error, gradient, in_camera, node, orbit, rng, unit};
use nalgebra::{Isometry3, Matrix6, Vector3, Vector6};
use posegraph::{PoseGraph, SdfModel, SdfTerm, SolveOptions, solve};

struct Shape {
    distance: fn(&Vector3<f64>) -> f64,
    /// Unknown farther than this from the surface.
    band: f64,
}

impl SdfModel for Shape {
    fn sdf_and_gradient(&self, points: &[[f32; 3]], sdf: &mut [f32], out: &mut [[f32; 3]]) {
        for ((p, s), g) in points.iter().zip(sdf).zip(out) {
            let x = Vector3::from(p.map(f64::from));
            let d = (self.distance)(&x);
            *s = if d.abs() <= self.band { d as f32 } else { f32::NAN };
            *g = gradient(self.distance, &x).map(|c| c as f32).into();
        }
    }
}

fn sphere(x: &Vector3<f64>) -> f64 {
    x.norm() - 0.08
}

fn cuboid(x: &Vector3<f64>) -> f64 {
    let q = x.abs() - Vector3::new(0.05, 0.07, 0.09);
    q.map(|c| c.max(0.0)).norm() + q.max().min(0.0)
}

/// Union of a sphere and a box that sticks out of it: no symmetry left.
fn both(x: &Vector3<f64>) -> f64 {
    sphere(x).min(cuboid(&(x - Vector3::new(0.06, 0.03, 0.01))))
}

fn surface(f: fn(&Vector3<f64>) -> f64, count: usize, seed: u64) -> Vec<Vector3<f64>> {
    let mut rng = rng(seed);
    (0..count)
        .map(|_| {
            let direction = unit(&mut rng);
            let mut r = 0.3;
            for _ in 0..200 {
                r -= f(&(direction * r));
            }
            direction * r
        })
        .collect()
}

#[test]
fn sphere_and_box_recover_the_pose() {
    for seed in 0..5 {
        let mut rng = rng(20 + seed);
        let truth = orbit(0.5, 0.3, 0.2);
        let model = Shape { distance: both, band: 0.1 };
        let mut points: Vec<_> = surface(both, 800, seed).iter().map(|x| in_camera(&truth, x)).collect();
        points.push([f32::NAN; 3]);
        let mut graph = PoseGraph::new();
        let n = graph.add_node(node(disturb(&mut rng, &truth, 0.01, 5.0), false));
        graph.add_sdf_term(SdfTerm { node: n, points, model: &model }).unwrap();
        let solution = solve(&graph, &SolveOptions::default()).unwrap();
        let (t, r) = error(&solution.poses[n], &truth);
        assert!(t < 1e-4 && r < 0.05, "seed {seed}: {t} m {r} deg, {} iterations", solution.iterations);
        assert!(solution.sdf_rms < 1e-4);
    }
}

#[test]
fn a_sphere_fixes_position_only() {
    let truth = orbit(0.5, 0.0, 0.0);
    let mut rng = rng(30);
    let start = disturb(&mut rng, &truth, 0.01, 5.0);
    let model = Shape { distance: sphere, band: 1.0 };
    let points = surface(sphere, 500, 1).iter().map(|x| in_camera(&truth, x)).collect();
    let mut graph = PoseGraph::new();
    let n = graph.add_node(node(start, false));
    graph.add_sdf_term(SdfTerm { node: n, points, model: &model }).unwrap();
    let solution = solve(&graph, &SolveOptions::default()).unwrap();
    let centre = solution.poses[n] * truth.inverse() * nalgebra::Point3::origin();
    let (iterations, converged) = (solution.iterations, solution.converged);
    assert!(centre.coords.norm() < 1e-5, "not the model's centre: {centre} {iterations} {converged}");
    let turned = solution.poses[n].rotation.angle_to(&start.rotation).to_degrees();
    assert!(turned < 0.01, "rotation is not observed and stays: {turned} deg");
    let observability = solution.observability.unwrap();
    assert_eq!(observability.held().count(), 3, "{:?}", observability.directions);
}

#[test]
fn points_outside_the_known_band_are_dropped_and_do_not_attract() {
    let truth = orbit(0.5, 0.0, 0.0);
    let mut rng = rng(31);
    let model = Shape { distance: both, band: 0.012 };
    let mut points: Vec<_> = surface(both, 600, 2).iter().map(|x| in_camera(&truth, x)).collect();
    points.extend((0..200).map(|_| in_camera(&truth, &(unit(&mut rng) * 0.2))));
    let mut graph = PoseGraph::new();
    let n = graph.add_node(node(disturb(&mut rng, &truth, 0.004, 2.0), false));
    graph.add_sdf_term(SdfTerm { node: n, points, model: &model }).unwrap();
    let solution = solve(&graph, &SolveOptions::default()).unwrap();
    let (t, r) = error(&solution.poses[n], &truth);
    assert!(t < 3e-4 && r < 0.1, "{t} {r}");
    assert!(solution.cost_final <= solution.cost_initial);
}

struct Unknown;
impl SdfModel for Unknown {
    fn sdf_and_gradient(&self, _: &[[f32; 3]], sdf: &mut [f32], gradient: &mut [[f32; 3]]) {
        sdf.fill(f32::NAN);
        gradient.fill([f32::INFINITY; 3]);
    }
}

/// The plane z = 0.5 m, seen from below.
struct Wall;
impl SdfModel for Wall {
    fn sdf_and_gradient(&self, points: &[[f32; 3]], sdf: &mut [f32], gradient: &mut [[f32; 3]]) {
        sdf.iter_mut().zip(points).for_each(|(s, p)| *s = 0.5 - p[2]);
        gradient.fill([0.0, 0.0, -1.0]);
    }
}

/// A model that is off by so many metres everywhere.
struct Off<'a>(&'a dyn SdfModel, f32);
impl SdfModel for Off<'_> {
    fn sdf_and_gradient(&self, points: &[[f32; 3]], sdf: &mut [f32], gradient: &mut [[f32; 3]]) {
        self.0.sdf_and_gradient(points, sdf, gradient);
        sdf.iter_mut().for_each(|s| *s += self.1);
    }
}

#[test]
fn information_is_the_curvature_of_the_cost_whatever_the_models_offset() {
    let truth = orbit(0.5, 0.3, 0.2);
    let model = Shape { distance: both, band: 0.1 };
    let points: Vec<_> = surface(both, 600, 3).iter().map(|x| in_camera(&truth, x)).collect();
    let options = SolveOptions::default();
    let term = SdfTerm { node: 0, points: points.clone(), model: &model };
    let information = term.information(&truth, &options);
    let mut rng = rng(32);
    for _ in 0..10 {
        let (slide, turn) = (unit(&mut rng) * 2e-4, unit(&mut rng) * 2e-3);
        let xi = Vector6::from_iterator(slide.iter().chain(turn.iter()).copied());
        let cost = |metres: f32| {
            let model = Off(&model, metres);
            let mut graph = PoseGraph::new();
            let n = graph.add_node(node(se3_lie::se3::exp(&xi) * truth, false));
            graph.add_sdf_term(SdfTerm { node: n, points: points.clone(), model: &model }).unwrap();
            solve(&graph, &options).unwrap().cost_initial
        };
        // The least cost over all offsets, a parabola's.
        const STEP: f32 = 2e-4;
        let [low, cost, high] = [-STEP, 0.0, STEP].map(cost);
        let (slope, bend) = (0.5 * (high - low), 0.5 * (high + low) - cost);
        let cost = cost - slope * slope / (4.0 * bend);
        let expected = 0.5 * xi.dot(&(information * xi));
        assert!((cost - expected).abs() < 0.03 * expected, "{cost} {expected}");
    }
    // A flat face: nothing is left of where it is along its normal, and its tilt stays known.
    let flat = (0..400).map(|k| [(k % 20) as f32 * 0.004 - 0.038, (k / 20) as f32 * 0.004 - 0.038, 0.5]);
    let face = SdfTerm { node: 0, points: flat.collect(), model: &Wall };
    let information = face.information(&Isometry3::identity(), &options);
    assert!(information[(2, 2)] < 1e-6 * information[(3, 3)] && information[(3, 3)] > 0.0, "{information}");
    let unknown = SdfTerm { node: 0, points, model: &Unknown };
    assert_eq!(unknown.information(&truth, &options), Matrix6::zeros());
}

#[test]
fn a_model_that_knows_nothing_changes_nothing() {
    let mut graph = PoseGraph::new();
    let n = graph.add_node(node(orbit(0.5, 0.3, 0.0), false));
    graph.add_sdf_term(SdfTerm { node: n, points: vec![[0.0, 0.0, 0.5]; 10], model: &Unknown }).unwrap();
    let solution = solve(&graph, &SolveOptions::default()).unwrap();
    assert_eq!(solution.poses[n], graph.nodes()[n].obj_from_cam);
    assert_eq!((solution.cost_final, solution.sdf_rms), (0.0, 0.0));
}
