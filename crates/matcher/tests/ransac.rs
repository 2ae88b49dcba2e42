//! Rigid motions from matches with outliers.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use matcher::{LiftedMatch, RansacOptions, RigidModel, ransac};
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

fn motion(translation: [f64; 3], rotation: [f64; 3]) -> Isometry3<f64> {
    Isometry3::new(Vector3::from(translation), Vector3::from(rotation))
}

fn to_f32(v: Vector3<f64>) -> [f32; 3] {
    [v.x as f32, v.y as f32, v.z as f32]
}

/// Matches on a sphere of 8 cm radius; the first `outliers` parts of them are random; 1 mm of noise.
fn matches(n: usize, outliers: f64, truth: &Isometry3<f64>, seed: u64) -> Vec<LiftedMatch> {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut random = |scale: f64| {
        Vector3::from_fn(|_, _| {
            scale * (rng.random::<f64>() + rng.random::<f64>() + rng.random::<f64>() - 1.5)
        })
    };
    let wrong = (outliers * n as f64).round() as usize;
    (0..n)
        .map(|i| {
            let normal = random(1.0).normalize();
            let a = normal * 0.08;
            let (b, normal_b) = if i < wrong {
                let other = random(1.0).normalize();
                (other * 0.08, other)
            } else {
                ((truth * Point3::from(a)).coords + random(0.002), truth.rotation * normal)
            };
            LiftedMatch {
                a: to_f32(a),
                normal_a: to_f32(normal),
                b: to_f32(b),
                normal_b: to_f32(normal_b),
                sight: [0.0; 3],
                weight: 1.0,
            }
        })
        .collect()
}

fn errors(model: &RigidModel, truth: &Isometry3<f64>) -> (f64, f64) {
    let difference = model.motion.inverse() * truth;
    (difference.translation.vector.norm(), difference.rotation.angle())
}

#[test]
fn sixty_percent_outliers_are_survived() {
    let truth = motion([0.012, -0.02, 0.007], [0.1, 0.25, -0.3]);
    for seed in 0..10 {
        for known_normals in [true, false] {
            let mut all = matches(300, 0.6, &truth, seed);
            if !known_normals {
                all.iter_mut().for_each(|m| m.normal_b = [0.0; 3]);
            }
            let model = ransac::estimate(&all, &RansacOptions { seed, ..RansacOptions::default() }).unwrap();
            let (translation, angle) = errors(&model, &truth);
            assert!(translation < 0.0006 && angle < 0.006, "seed {seed}: {translation} m, {angle} rad");
            let true_inliers = model.inliers.iter().filter(|&&i| i >= 180).count();
            assert!(true_inliers >= 114 && model.inliers.len() - true_inliers <= 3);
            assert!(model.inliers.is_sorted() && model.score > 0.0);
        }
    }
}

#[test]
fn the_refinement_beats_the_best_sample() {
    let truth = motion([0.01, 0.0, 0.0], [0.0, 0.2, 0.0]);
    let mut mean = 0.0;
    for seed in 0..10 {
        let all = matches(100, 0.3, &truth, 100 + seed);
        mean += errors(&ransac::estimate(&all, &RansacOptions::default()).unwrap(), &truth).0 / 10.0;
    }
    // 70 inliers with 1 mm of noise an axis: about 1 mm * sqrt(3 / 70).
    assert!(mean < 0.0004, "mean translation error {mean} m");
}

#[test]
fn gates_reject_and_never_leak() {
    let truth = motion([0.0, 0.0, 0.03], [0.0, 0.5, 0.0]);
    let all = matches(200, 0.0, &truth, 1);
    let open = RansacOptions::default();
    assert!(ransac::estimate(&all, &open).is_some());
    let closed = [
        RansacOptions { max_translation: 0.02, ..open },
        RansacOptions { max_rotation: 0.4, ..open },
        RansacOptions { max_translation: f64::NAN, ..open },
        RansacOptions { max_rotation: -1.0, ..open },
    ];
    for options in closed {
        if let Some(model) = ransac::estimate(&all, &options) {
            // Another motion may explain a few of the points inside the gate, never the gated motion all of them.
            assert!(model.motion.translation.vector.norm() <= options.max_translation);
            assert!(model.motion.rotation.angle() <= options.max_rotation);
            assert!(model.inliers.len() < 100, "{} inliers leaked", model.inliers.len());
        }
        assert_eq!(ransac::refine(&all, &truth, &options), None);
    }
    let far = motion([0.5, 0.0, 0.0], [0.0; 3]);
    let all = matches(200, 0.0, &far, 1);
    assert_eq!(ransac::estimate(&all, &RansacOptions { max_translation: 0.1, ..open }), None);
    let just_wide_enough = RansacOptions { max_translation: 0.51, max_rotation: 0.1, ..open };
    assert!(ransac::estimate(&all, &just_wide_enough).is_some());
}

#[test]
fn opposite_normals_are_outliers() {
    let truth = motion([0.01, 0.0, 0.0], [0.0; 3]);
    let mut all = matches(60, 0.0, &truth, 3);
    for m in &mut all[..40] {
        m.normal_b = m.normal_b.map(|v| -v);
    }
    let model = ransac::estimate(&all, &RansacOptions::default()).unwrap();
    assert!(model.inliers.iter().all(|&i| i >= 40) && model.inliers.len() >= 18);
    let untested = RansacOptions { inlier_normal_angle: f64::INFINITY, ..RansacOptions::default() };
    assert!(ransac::estimate(&all, &untested).unwrap().inliers.len() >= 55);
}

#[test]
fn weights_decide_between_two_motions() {
    let (one, two) = (motion([0.02, 0.0, 0.0], [0.0; 3]), motion([0.0, 0.02, 0.0], [0.0; 3]));
    let mut all = matches(60, 0.0, &one, 4);
    all.extend(matches(40, 0.0, &two, 5));
    let model = ransac::estimate(&all, &RansacOptions::default()).unwrap();
    assert!(errors(&model, &one).0 < 0.002);
    all[..60].iter_mut().for_each(|m| m.weight = 0.2);
    let model = ransac::estimate(&all, &RansacOptions::default()).unwrap();
    assert!(errors(&model, &two).0 < 0.002);
}

#[test]
fn the_result_is_determined_by_the_seed() {
    let all = matches(200, 0.7, &motion([0.01, 0.02, 0.0], [0.2, 0.0, 0.1]), 6);
    let options = RansacOptions { hypotheses: 50, seed: 9, ..RansacOptions::default() };
    assert_eq!(ransac::estimate(&all, &options), ransac::estimate(&all, &options));
}

#[test]
fn degenerate_matches_have_no_model() {
    let options = RansacOptions::default();
    let none = |all: &[LiftedMatch]| {
        ransac::estimate(all, &options).is_none()
            && ransac::refine(all, &Isometry3::identity(), &options).is_none()
    };
    let good = matches(50, 0.0, &motion([0.01, 0.0, 0.0], [0.0; 3]), 7);
    assert!(none(&[]) && none(&good[..2]) && none(&good[..4]));
    assert!(none(&vec![good[0]; 100]), "one match a hundred times");
    assert!(none(&[vec![good[0]; 30], vec![good[1]; 30]].concat()), "two matches thirty times each");
    let line = |i: usize| [0.01 * i as f32, 0.005 * i as f32, 0.5];
    let collinear: Vec<_> = (0..40)
        .map(|i| LiftedMatch {
            a: line(i),
            b: line(i),
            normal_a: [0.0; 3],
            normal_b: [0.0; 3],
            sight: [0.0; 3],
            weight: 1.0,
        })
        .collect();
    assert!(none(&collinear), "all on a line");
    let broken = |f: fn(&mut LiftedMatch)| {
        let mut all = good.clone();
        all.iter_mut().for_each(f);
        all
    };
    assert!(none(&broken(|m| m.a[1] = f32::NAN)));
    assert!(none(&broken(|m| m.b[2] = f32::INFINITY)));
    assert!(none(&broken(|m| m.normal_a[0] = f32::NAN)));
    assert!(none(&broken(|m| m.weight = 0.0)));
    assert!(none(&broken(|m| m.weight = f32::NAN)));
    assert!(none(&broken(|m| m.a = [0.0; 3])));
    for distance in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert_eq!(ransac::estimate(&good, &RansacOptions { inlier_distance: distance, ..options }), None);
    }
    assert_eq!(ransac::estimate(&good, &RansacOptions { hypotheses: 0, ..options }), None);

    // A few broken matches among good ones are only left out.
    let mut mixed = good.clone();
    mixed[3].a[0] = f32::NAN;
    let model = ransac::estimate(&mixed, &options).unwrap();
    assert!(model.inliers.len() >= 47 && !model.inliers.contains(&3));
}

#[test]
fn refinement_converges_from_nearby() {
    let truth = motion([0.01, -0.01, 0.02], [0.1, -0.2, 0.3]);
    let all = matches(200, 0.4, &truth, 8);
    let start = Isometry3::from_parts(
        (truth.translation.vector + Vector3::new(0.004, 0.003, -0.003)).into(),
        UnitQuaternion::from_scaled_axis(Vector3::new(0.02, 0.02, 0.02)) * truth.rotation,
    );
    let model = ransac::refine(&all, &start, &RansacOptions::default()).unwrap();
    let (translation, angle) = errors(&model, &truth);
    assert!(translation < 0.0006 && angle < 0.006, "{translation} m, {angle} rad");
    let far = motion([5.0, 0.0, 0.0], [0.0; 3]);
    assert_eq!(ransac::refine(&all, &far, &RansacOptions::default()), None);
    let broken = motion([f64::NAN, 0.0, 0.0], [0.0; 3]);
    assert_eq!(ransac::refine(&all, &broken, &RansacOptions::default()), None);
}
