//! Shapes that slide along themselves, with and without anything else to see: what is held, and what must not be.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use common::{error, images, matches, node, orbit, rng, vector, view};
use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use posegraph::{DenseEdge, DenseView, PoseGraph, Solution, SolveOptions, solve};
use rand_pcg::Pcg64Mcg;

/// Signed distances (bounds are enough).
fn sphere(x: &Vector3<f64>) -> f64 {
    x.norm() - 0.06
}

fn can(x: &Vector3<f64>) -> f64 {
    let side = x.x.hypot(x.z) - 0.033;
    side.max(x.y.abs() - 0.06)
}

fn cuboid(x: &Vector3<f64>) -> f64 {
    let d = x.abs() - Vector3::new(0.05, 0.06, 0.03);
    d.map(|c| c.max(0.0)).norm() + d.max().min(0.0)
}

fn wall(x: &Vector3<f64>) -> f64 {
    -x.z
}

type Shape = fn(&Vector3<f64>) -> f64;

/// What a depth camera sees: 1 mm of noise, normals off by some degrees.
fn seen(shape: Shape, obj_from_cam: &Isometry3<f64>, rng: &mut Pcg64Mcg) -> DenseView {
    let (points, mut normals) = images(shape, obj_from_cam, 90, 0.001, rng);
    for normal in normals.iter_mut().filter(|n| **n != [0.0; 3]) {
        let tilted = Vector3::from(*normal).cast::<f64>() + vector(rng, 0.12);
        *normal = tilted.normalize().cast::<f32>().into();
    }
    view(90, &points, &normals)
}

/// A turn of the object about its y axis.
fn turn(degrees: f64) -> Isometry3<f64> {
    Isometry3::rotation(Vector3::y() * degrees.to_radians())
}

struct Scene {
    truth: [Isometry3<f64>; 2],
    views: [DenseView; 2],
    rng: Pcg64Mcg,
}

impl Scene {
    /// Two views 10 degrees apart, from a little above.
    fn new(shape: Shape, seed: u64) -> Self {
        let mut rng = rng(seed);
        let truth = [orbit(0.5, 0.3, 0.4), orbit(0.5, 0.3, 0.4 + 10f64.to_radians())];
        let views = truth.map(|pose| seen(shape, &pose, &mut rng));
        Self { truth, views, rng }
    }

    /// The second pose, started at `start` away from the truth and predicted at `predicted` away from it.
    fn solve(
        &mut self,
        [start, predicted]: [Isometry3<f64>; 2],
        print: usize,
        options: &SolveOptions,
    ) -> (Solution, Isometry3<f64>) {
        let mut graph = PoseGraph::new();
        graph.add_node(node(self.truth[0], true));
        graph.add_node(node(start * self.truth[1], false));
        graph.set_prediction(1, predicted * self.truth[1]).unwrap();
        for (k, view) in self.views.iter().enumerate() {
            graph.set_view(k, view).unwrap();
        }
        graph.add_dense_edge(DenseEdge { source: 1, target: 0 }).unwrap();
        if print > 0 {
            let (a, b) = ((1, &self.truth[1]), (0, &self.truth[0]));
            graph.add_feature_edge(matches(&mut self.rng, a, b, print, 0.002, 0.0)).unwrap();
        }
        let solution = solve(&graph, options).unwrap();
        let off = solution.poses[1] * self.truth[1].inverse();
        (solution, off)
    }
}

/// Angle about the y axis and about all others, degrees.
fn angles(off: &Isometry3<f64>) -> (f64, f64) {
    let angle = off.rotation.scaled_axis() * 180.0 / std::f64::consts::PI;
    (angle.y, angle.x.hypot(angle.z))
}

/// Nudged by a millimetre and half a degree across the axis.
fn nudge() -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(0.009, 0.0, 0.0));
    Isometry3::from_parts(Vector3::new(0.001, -0.001, 0.001).into(), rotation)
}

#[test]
fn the_turn_of_a_can_without_print_stays_as_predicted() {
    let (mut drift, mut held_drift) = (0.0f64, 0.0f64);
    for seed in 0..4 {
        let mut scene = Scene::new(can, seed);
        let start = [nudge() * turn(1.5), turn(0.0)];
        let (solution, off) = scene.solve(start, 0, &SolveOptions::default());
        let (about, across) = angles(&off);
        assert!(about.abs() < 0.3, "seed {seed}: held but turned by {about} degrees");
        assert!(across < 0.5 && off.translation.vector.norm() < 1e-3, "seed {seed}: {across} {off}");
        held_drift = held_drift.max(about.abs());
        let observability = solution.observability.unwrap();
        let held: Vec<_> = observability.held().collect();
        assert_eq!(held.len(), 1, "seed {seed}: {:?}", observability.directions);
        let axis = held[0].twist.fixed_rows::<3>(3).normalize();
        assert!(axis.y.abs() > 0.995, "{axis}");
        // The axis goes through the origin: no point of it moves.
        let at_origin = held[0].twist.fixed_rows::<3>(0).norm() / held[0].twist.fixed_rows::<3>(3).norm();
        assert!(at_origin < 2e-3, "{at_origin} m");
        let free = SolveOptions { hold: false, ..SolveOptions::default() };
        drift = drift.max(angles(&scene.solve(start, 0, &free).1).0.abs());
    }
    assert!(drift > 3.0 * held_drift, "noise alone turns it: {drift} against {held_drift} degrees");
}

#[test]
fn a_can_that_is_shifted_does_not_roll() {
    for seed in 0..4 {
        let mut scene = Scene::new(can, seed);
        let before = Isometry3::translation(0.01, 0.0, 0.0);
        let (_, off) = scene.solve([nudge(), before], 0, &SolveOptions::default());
        assert!(angles(&off).0.abs() < 0.3, "seed {seed}: {off}");
        assert!(off.translation.vector.norm() < 1e-3, "seed {seed}: {off}");
    }
}

#[test]
fn the_turn_of_a_can_with_print_is_measured() {
    for seed in 0..4 {
        let mut scene = Scene::new(can, seed);
        // Started and predicted wrong: a turn that only the matches know of.
        let start = turn(4.0);
        let (solution, off) = scene.solve([start, start], 30, &SolveOptions::default());
        let (about, across) = angles(&off);
        assert!(about.abs() < 1.0 && across < 0.5, "seed {seed}: {about} {across}");
        assert_eq!(solution.observability.unwrap().held().count(), 0);
    }
}

#[test]
fn as_many_motions_are_held_as_the_shape_has_symmetries() {
    for (shape, symmetries) in [(sphere as Shape, 3), (wall, 3), (can, 1), (cuboid, 0)] {
        for seed in 0..3 {
            let mut scene = Scene::new(shape, seed);
            let (solution, off) = scene.solve([nudge(), turn(0.0)], 0, &SolveOptions::default());
            let observability = solution.observability.unwrap();
            assert_eq!(observability.held().count(), symmetries, "{:?}", observability.directions);
            let (t, r) = error(&off, &Isometry3::identity());
            assert!(t < 2e-3 && r < 0.8, "{symmetries} held: {t} m, {r} degrees");
        }
    }
}

#[test]
fn covariance_knows_what_was_measured_and_what_was_held() {
    let mut scene = Scene::new(can, 1);
    let sigma = |scene: &mut Scene, print: usize| {
        let (solution, _) = scene.solve([nudge(), turn(0.0)], print, &SolveOptions::default());
        let covariance = solution.observability.unwrap().covariance();
        [(1, 1), (4, 4)].map(|at| covariance[at].sqrt())
    };
    let [along, about] = sigma(&mut scene, 0);
    assert!(along < 1e-3, "the lid tells where it is along the axis: {along} m");
    assert!(about > 0.5, "its turn may be anything: {about} rad");
    let [_, printed] = sigma(&mut scene, 30);
    assert!(printed < 0.02, "{printed} rad");
}

#[test]
fn covariance_is_the_inverse_information_where_all_is_observed() {
    let mut scene = Scene::new(cuboid, 2);
    let (solution, _) = scene.solve([nudge(), turn(0.0)], 60, &SolveOptions::default());
    let observability = solution.observability.unwrap();
    assert!(observability.directions.iter().all(|d| d.observed == 1.0), "{:?}", observability.directions);
    let (ours, inverse) = (observability.covariance(), solution.covariances[1].unwrap());
    assert!((ours - inverse).amax() < 1e-6 * inverse.amax(), "{ours} {inverse}");
}
