//! Sampling, chamfer distance, ICP and visibility on boxes.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod support;

use eval_metrics::{
    Camera, Chamfer, IcpOptions, MeshProtocol, MeshRef, chamfer_distance, icp, keep_faces, sample_surface,
    score_mesh, thin, visible_faces,
};
use nalgebra::{Isometry3, Point3, Vector3};
use proptest::prelude::*;
use support::cuboid;

const CAMERA: Camera = Camera { fx: 600.0, fy: 600.0, cx: 319.5, cy: 239.5, width: 640, height: 480 };

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn chamfer_equals_brute_force(
        a in proptest::collection::vec(proptest::array::uniform3(-1.0..1.0_f64), 1..60),
        b in proptest::collection::vec(proptest::array::uniform3(-1.0..1.0_f64), 1..60),
    ) {
        let one_way = |from: &[[f64; 3]], to: &[[f64; 3]]| {
            let nearest = |p: &[f64; 3]| to.iter()
                .map(|q| (Vector3::from(*p) - Vector3::from(*q)).norm()).fold(f64::INFINITY, f64::min);
            from.iter().map(nearest).sum::<f64>() / from.len() as f64
        };
        let expected = 0.5 * (one_way(&a, &b) + one_way(&b, &a));
        prop_assert!((chamfer_distance(&a, &b).unwrap() - expected).abs() < 1e-12);
        prop_assert_eq!(chamfer_distance(&a, &b), chamfer_distance(&b, &a));
        prop_assert_eq!(chamfer_distance(&a, &a), Some(0.0));
    }
}

#[test]
fn chamfer_without_points_is_none() {
    assert_eq!(chamfer_distance(&[], &[[0.0; 3]]), None);
    assert_eq!(chamfer_distance(&[[0.0; 3]], &[]), None);
    assert_eq!(chamfer_distance(&[[f64::NAN; 3]], &[[0.0; 3]]), None);
}

#[test]
fn samples_lie_on_the_surface_in_proportion_to_area() {
    // Sides of very different size, the triangles of one axis much finer.
    let (vertices, triangles) = cuboid([0.2, 0.1, 0.02], 3);
    let samples = sample_surface(MeshRef::new(&vertices, &triangles), 30_000, 7);
    assert_eq!(samples.len(), 30_000);
    let half = [0.1, 0.05, 0.01];
    let on = |p: &[f64; 3], k: usize| (p[k].abs() - half[k]).abs() < 1e-12;
    assert!(samples.iter().all(|p| (0..3).any(|k| on(p, k)) && (0..3).all(|k| p[k].abs() < half[k] + 1e-12)));
    let areas = [2.0 * 0.1 * 0.02, 2.0 * 0.2 * 0.02, 2.0 * 0.2 * 0.1];
    let total: f64 = areas.iter().sum();
    for k in 0..3 {
        let share = samples.iter().filter(|p| on(p, k)).count() as f64 / 30_000.0;
        assert!((share - areas[k] / total).abs() < 2e-3, "axis {k}: {share}");
        let mean = samples.iter().map(|p| p[k]).sum::<f64>() / 30_000.0;
        assert!(mean.abs() < 1e-3, "axis {k}: {mean}");
    }
    let again = sample_surface(MeshRef::new(&vertices, &triangles), 30_000, 7);
    assert_eq!(samples, again);
    assert_ne!(samples, sample_surface(MeshRef::new(&vertices, &triangles), 30_000, 8));
}

#[test]
fn meshes_without_area_have_no_samples() {
    let line = [[0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]];
    assert!(sample_surface(MeshRef::new(&line, &[[0, 1, 2], [0, 1, 7]]), 10, 0).is_empty());
    assert!(sample_surface(MeshRef::new(&[[f64::NAN; 3]; 3], &[[0, 1, 2]]), 10, 0).is_empty());
    assert!(sample_surface(MeshRef::new(&[], &[]), 10, 0).is_empty());
}

#[test]
fn thinning_averages_cells() {
    let points = [[0.001, 0.0, 0.0], [0.003, 0.0, 0.0], [0.007, 0.0, 0.0], [-0.001, 0.0, 0.0], [f64::NAN; 3]];
    let mut thinned = thin(&points, 0.005);
    thinned.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let x: Vec<f64> = thinned.iter().map(|p| p[0]).collect();
    assert_eq!(x, [-0.001, 0.002, 0.007]);
    assert_eq!(thin(&points, 0.0).len(), 4);
    assert!(thin(&[], 0.005).is_empty());
}

#[test]
fn icp_recovers_a_small_motion() {
    let (vertices, triangles) = cuboid([0.1, 0.07, 0.05], 2);
    let mesh = MeshRef::new(&vertices, &triangles);
    let target = sample_surface(mesh, 20_000, 1);
    let truth = Isometry3::new(Vector3::new(0.002, -0.003, 0.001), Vector3::new(0.02, 0.01, -0.03));
    let source: Vec<[f64; 3]> =
        sample_surface(mesh, 5_000, 2).iter().map(|p| (truth.inverse() * Point3::from(*p)).into()).collect();
    let options = IcpOptions { max_iterations: 200, tolerance: 1e-9, ..IcpOptions::default() };
    let found = icp(&source, &target, &options);
    assert!((found.translation.vector - truth.translation.vector).norm() < 3e-4, "{found}");
    assert!(found.rotation.angle_to(&truth.rotation) < 0.005, "{found}");
}

#[test]
fn icp_without_pairs_is_the_identity() {
    let far = [[5.0, 0.0, 0.0], [5.0, 1.0, 0.0], [5.0, 0.0, 1.0]];
    let near = far.map(|p| [p[0] - 5.0, p[1], p[2]]);
    for (a, b) in [(&far[..], &near[..]), (&[], &near), (&near, &[])] {
        assert_eq!(icp(a, b, &IcpOptions::default()), Isometry3::identity());
    }
}

/// The protocol's floor: a perfect reconstruction of an object of the size of the YCB boxes.
#[test]
fn a_perfect_mesh_scores_the_quantisation_floor() {
    let (vertices, triangles) = cuboid([0.21, 0.16, 0.07], 8);
    let mesh = MeshRef::new(&vertices, &triangles);
    let score = |motion: &Isometry3<f64>, protocol: &MeshProtocol| {
        score_mesh(mesh, mesh, motion, protocol).unwrap().distance()
    };
    let shift = Isometry3::translation(0.0012, -0.0012, 0.001);
    let paper = score(&Isometry3::identity(), &MeshProtocol::paper_text());
    assert!((0.0010..0.0013).contains(&paper), "{paper}");
    // Without registration a 2 mm shift shows, with it the floor comes back.
    let shifted = score(&shift, &MeshProtocol::paper_text());
    assert!(shifted > paper + 2e-4, "{shifted}");
    let script = score(&Isometry3::identity(), &MeshProtocol::authors_script());
    let registered = score(&shift, &MeshProtocol::authors_script());
    assert!((0.0010..0.0013).contains(&script), "{script}");
    assert!((registered - script).abs() < 5e-5, "{registered} {script}");
}

#[test]
fn invented_surface_costs_accuracy_and_missing_surface_completeness() {
    let (vertices, triangles) = cuboid([0.1, 0.1, 0.1], 6);
    let whole = MeshRef::new(&vertices, &triangles);
    // Every triangle but those of the face z = +0.05.
    let open: Vec<bool> =
        triangles.iter().map(|t| t.iter().any(|i| vertices[*i as usize][2] < 0.049)).collect();
    let half = keep_faces(&triangles, &open);
    let half = MeshRef::new(&vertices, &half);
    let protocol = MeshProtocol { pred_samples: 20_000, ..MeshProtocol::paper_text() };
    let same = Isometry3::identity();
    let fit = score_mesh(whole, whole, &same, &protocol).unwrap();
    let invented = score_mesh(whole, half, &same, &protocol).unwrap();
    let missing = score_mesh(half, whole, &same, &protocol).unwrap();
    assert!(invented.forward > fit.forward + 1e-3 && (invented.backward - fit.backward).abs() < 1e-4);
    assert!(missing.backward > fit.backward + 1e-3 && (missing.forward - fit.forward).abs() < 1e-4);
    assert!(score_mesh(MeshRef::new(&[], &[]), whole, &same, &protocol).is_none());
    assert!(score_mesh(whole, MeshRef::new(&[], &[]), &same, &protocol).is_none());
}

#[test]
fn far_blobs_are_cropped_by_the_script_only() {
    let (mut vertices, mut triangles) = cuboid([0.1, 0.1, 0.1], 4);
    let (clean, clean_triangles) = (vertices.clone(), triangles.clone());
    let truth = MeshRef::new(&clean, &clean_triangles);
    let base = vertices.len() as u32;
    vertices.extend(clean.iter().map(|p| [p[0] + 2.0, p[1], p[2]]));
    triangles.extend(clean_triangles.iter().map(|t| t.map(|i| i + base)));
    let blobs = MeshRef::new(&vertices, &triangles);
    let same = Isometry3::identity();
    let score = |p: MeshProtocol| score_mesh(blobs, truth, &same, &p).unwrap();
    assert!(score(MeshProtocol::paper_text()).forward > 0.5);
    let cropped: Chamfer = score(MeshProtocol::authors_script());
    assert!(cropped.distance() < 0.0013, "{cropped:?}");
}

/// The box's sides that a camera can see, and no other, whatever the tessellation.
#[test]
fn only_the_sides_towards_the_camera_are_visible() {
    for n in [1, 5, 60] {
        let (vertices, triangles) = cuboid([0.1, 0.08, 0.06], n);
        let mesh = MeshRef::new(&vertices, &triangles);
        // Looking along +z at the side z = -0.03; then from the right so that the side x = +0.05 shows too.
        let front = Isometry3::translation(0.0, 0.0, 0.5);
        let right = Isometry3::new(Vector3::new(0.0, 0.0, 0.5), Vector3::y() * 0.6);
        let side = |t: &[u32; 3]| {
            let p = t.map(|i| vertices[i as usize]);
            (0..3).find(|&k| p.iter().all(|q| q[k] == p[0][k])).map(|k| (k, p[0][k] > 0.0)).unwrap()
        };
        let one = visible_faces(mesh, &[front], &CAMERA);
        let two = visible_faces(mesh, &[front, right], &CAMERA);
        // Triangles smaller than a cell of the depth buffer (0.4 mm) may show just around the corner.
        let behind = |t: &[u32; 3], k: usize, at: f64| {
            (t.iter().map(|i| vertices[*i as usize][k]).sum::<f64>() / 3.0 - at).abs()
        };
        for (i, t) in triangles.iter().enumerate() {
            let around = behind(t, 2, -0.03).min(behind(t, 0, 0.05)) < 1e-3;
            let expected = side(t) == (2, false);
            assert!(one[i] == expected || (one[i] && around), "{n}: {:?}", side(t));
            let expected = expected || side(t) == (0, true);
            assert!(two[i] == expected || (two[i] && around), "{n}: {:?}", side(t));
        }
    }
}

#[test]
fn what_is_outside_the_image_is_not_visible() {
    let (vertices, triangles) = cuboid([0.1, 0.1, 0.1], 20);
    let mesh = MeshRef::new(&vertices, &triangles);
    let seen = |pose: Isometry3<f64>| visible_faces(mesh, &[pose], &CAMERA).iter().filter(|s| **s).count();
    assert_eq!(seen(Isometry3::translation(0.0, 0.0, 0.5)), 800);
    assert_eq!(seen(Isometry3::translation(5.0, 0.0, 0.5)), 0);
    assert_eq!(seen(Isometry3::translation(0.0, 0.0, -0.5)), 0);
    assert_eq!(seen(Isometry3::translation(f64::NAN, 0.0, 0.5)), 0);
    // Half of the side is cut off by the image's border.
    let edge = 0.45 * 319.5 / 600.0;
    let half = Isometry3::translation(edge, 0.0, 0.5);
    let right = visible_faces(mesh, &[half], &CAMERA);
    let front: Vec<usize> = (0..triangles.len())
        .filter(|&i| triangles[i].iter().all(|v| vertices[*v as usize][2] == -0.05) && right[i])
        .collect();
    assert!((360..=480).contains(&front.len()), "{}", front.len());
}
