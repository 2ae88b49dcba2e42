//! Pose errors and their areas against known answers and brute force.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod support;

use eval_metrics::{
    MeshRef, ModelPoints, Summary, add, add_s, auc, rebase, recall_curve, rotation_error, score_poses,
    translation_error,
};
use nalgebra::{Isometry3, Point3, Vector3};
use proptest::prelude::*;

fn pose() -> impl Strategy<Value = Isometry3<f64>> {
    (proptest::array::uniform3(-0.3..0.3_f64), proptest::array::uniform3(-3.0..3.0_f64))
        .prop_map(|(t, r)| Isometry3::new(Vector3::from(t), Vector3::from(r)))
}

fn cloud() -> impl Strategy<Value = Vec<[f64; 3]>> {
    proptest::collection::vec(proptest::array::uniform3(-0.1..0.1_f64), 1..200)
}

/// The definition, word for word.
fn add_s_by_definition(pred: &Isometry3<f64>, gt: &Isometry3<f64>, points: &[[f64; 3]]) -> f64 {
    let at = |pose: &Isometry3<f64>, p: &[f64; 3]| pose * Point3::from(*p);
    let nearest =
        |x: Point3<f64>| points.iter().map(|y| (at(pred, y) - x).norm()).fold(f64::INFINITY, f64::min);
    points.iter().map(|x| nearest(at(gt, x))).sum::<f64>() / points.len() as f64
}

proptest! {
    #[test]
    fn add_s_equals_brute_force(pred in pose(), gt in pose(), points in cloud()) {
        let model = ModelPoints::new(points.clone()).unwrap();
        let expected = add_s_by_definition(&pred, &gt, &points);
        let found = add_s(&pred, &gt, &model);
        prop_assert!((found - expected).abs() < 1e-12, "{} {}", found, expected);
        prop_assert!(found <= add(&pred, &gt, &model) + 1e-12);
    }

    #[test]
    fn a_shift_is_its_length(gt in pose(), shift in proptest::array::uniform3(-0.1..0.1_f64), points in cloud()) {
        let mut pred = gt;
        pred.translation.vector += Vector3::from(shift);
        let length = Vector3::from(shift).norm();
        let model = ModelPoints::new(points).unwrap();
        prop_assert!((add(&pred, &gt, &model) - length).abs() < 1e-12);
        prop_assert!((translation_error(&pred, &gt) - length).abs() < 1e-12);
        prop_assert!(rotation_error(&pred, &gt) < 1e-7);
    }

    /// A tracker's choice of object frame has no influence.
    #[test]
    fn scores_do_not_depend_on_the_object_frame(
        gt in proptest::collection::vec(pose(), 2..6),
        frame in pose(),
        points in cloud(),
        lost in 1usize..6,
    ) {
        let model = ModelPoints::new(points).unwrap();
        let noisy: Vec<_> = gt.iter().enumerate().map(|(i, p)| {
            let wobble = Isometry3::new(Vector3::x() * 0.003 * i as f64, Vector3::z() * 0.02 * i as f64);
            (i != lost).then(|| p * wobble)
        }).collect();
        let other: Vec<_> = noisy.iter().map(|p| p.map(|p| p * frame)).collect();
        let gt: Vec<_> = gt.into_iter().map(Some).collect();
        let (a, b) = (score_poses(&noisy, &gt, &model, 0.1), score_poses(&other, &gt, &model, 0.1));
        prop_assert!((a.add_auc - b.add_auc).abs() < 1e-9);
        prop_assert!((a.add_s_auc - b.add_s_auc).abs() < 1e-9);
        for (x, y) in rebase(&noisy, &gt).iter().zip(rebase(&other, &gt)) {
            prop_assert_eq!(x.is_some(), y.is_some());
            if let (Some(x), Some(y)) = (x, y) {
                prop_assert!((x.to_homogeneous() - y.to_homogeneous()).norm() < 1e-12);
            }
        }
    }

    #[test]
    fn auc_is_monotone_and_bounded(mut errors in proptest::collection::vec(0.0..0.2_f64, 1..50), worse in 0.0..0.1_f64) {
        let before = auc(&errors, 0.1);
        prop_assert!((0.0..=100.0).contains(&before));
        // The exact area under the step function of recall; the staircase is at most one step above.
        let exact = errors.iter().map(|e| (0.1 - e).max(0.0)).sum::<f64>() / errors.len() as f64 / 0.1 * 100.0;
        prop_assert!(before >= exact - 1e-9 && before <= exact + 100.0 / errors.len() as f64 + 1e-9);
        errors[0] = f64::NAN;
        let lost = auc(&errors, 0.1);
        errors[0] = worse;
        prop_assert!(auc(&errors, 0.1) >= lost - 1e-9);
    }
}

#[test]
fn perfect_missing_and_hopeless_videos() {
    let (vertices, triangles) = support::cuboid([0.1, 0.06, 0.04], 4);
    let model = ModelPoints::from_mesh(MeshRef::new(&vertices, &triangles)).unwrap();
    let gt: Vec<_> = (0..10)
        .map(|i| Some(Isometry3::new(Vector3::new(0.0, 0.0, 0.5), Vector3::y() * 0.1 * f64::from(i))))
        .collect();

    let perfect = score_poses(&gt, &gt, &model, 0.1);
    assert!((perfect.add_auc - 100.0).abs() < 1e-9 && (perfect.add_s_auc - 100.0).abs() < 1e-9);

    // Three of ten frames missing, one of them not finite: 70 %, and no frame is left out.
    let mut pred = gt.clone();
    pred[4] = None;
    pred[5] = None;
    pred[9] = Some(Isometry3::translation(f64::NAN, 0.0, 0.0));
    let some = score_poses(&pred, &gt, &model, 0.1);
    assert!((some.add_auc - 70.0).abs() < 1e-9, "{}", some.add_auc);
    assert!((some.add_s_auc - 70.0).abs() < 1e-9);
    assert_eq!(some.add_errors.len(), 10);
    assert_eq!(some.add_errors[9], f64::INFINITY);
    assert_eq!(some.rotation_errors[4], f64::INFINITY);

    // Frames without truth do not count; predictions may be fewer.
    let mut sparse = gt.clone();
    sparse[0] = None;
    sparse[7] = None;
    let scores = score_poses(&gt[..9], &sparse, &model, 0.1);
    assert_eq!(scores.frames, [1, 2, 3, 4, 5, 6, 8, 9]);
    assert!((scores.add_auc - 700.0 / 8.0).abs() < 1e-9);

    for hopeless in [vec![None; 10], Vec::new()] {
        let scores = score_poses(&hopeless, &gt, &model, 0.1);
        assert_eq!((scores.add_auc, scores.add_s_auc), (0.0, 0.0));
        assert_eq!(scores.add_errors.len(), 10);
    }
    let scores = score_poses(&[], &[], &model, 0.1);
    assert_eq!((scores.add_auc, scores.frames.len()), (0.0, 0));
}

#[test]
fn alignment_is_taken_at_the_first_frame() {
    let model = ModelPoints::new(vec![[0.0; 3]]).unwrap();
    let gt = vec![Some(Isometry3::translation(0.0, 0.0, 1.0)); 4];
    // Wrong by 1 cm in the first frame only: every later frame pays, the first does not.
    let mut pred = gt.clone();
    pred[0] = Some(Isometry3::translation(0.01, 0.0, 1.0));
    let scores = score_poses(&pred, &gt, &model, 0.1);
    assert_eq!(scores.add_errors[0], 0.0);
    assert!(scores.add_errors[1..].iter().all(|e| (e - 0.01).abs() < 1e-12));
}

/// A long video without error and a short one that is lost after its first frame.
#[test]
fn videos_count_alike_or_by_their_frames() {
    let model = ModelPoints::new(vec![[0.0; 3], [0.1, 0.0, 0.0]]).unwrap();
    let gt = |n: usize| vec![Some(Isometry3::translation(0.0, 0.0, 1.0)); n];
    let perfect = score_poses(&gt(30), &gt(30), &model, 0.1);
    let lost = score_poses(&gt(1), &gt(10), &model, 0.1);
    assert!((lost.add_auc - 10.0).abs() < 1e-9);
    let videos = [perfect, lost];
    let (means, pooled) = (Summary::per_video(&videos).unwrap(), Summary::pooled(&videos, 0.1).unwrap());
    assert!((means.add_auc - 55.0).abs() < 1e-9 && (means.add_s_auc - 55.0).abs() < 1e-9);
    // 31 of 40 frames.
    assert!((pooled.add_auc - 77.5).abs() < 1e-9 && (pooled.add_s_auc - 77.5).abs() < 1e-9);
    assert_eq!((Summary::per_video(&[]), Summary::pooled(&[], 0.1)), (None, None));
    assert_eq!(Summary::pooled(&[score_poses(&[], &[], &model, 0.1)], 0.1), None);
}

/// What is plotted: recall over a threshold, and errors over time, at any upper end of the area.
#[test]
fn errors_over_time_and_recall_curves() {
    let model = ModelPoints::new(vec![[0.0; 3]]).unwrap();
    let gt: Vec<_> = (0..5).map(|_| Some(Isometry3::translation(0.0, 0.0, 1.0))).collect();
    let drift = |i: usize| Isometry3::new(Vector3::x() * 0.1 * i as f64, Vector3::z() * 0.2 * i as f64);
    let pred: Vec<_> = (0..5).map(|i| gt[i].map(|pose| pose * drift(i))).collect();
    let scores = score_poses(&pred, &gt, &model, 0.5);
    for i in 0..5 {
        assert_eq!(scores.frames[i], i);
        assert!((scores.translation_errors[i] - 0.1 * i as f64).abs() < 1e-12);
        assert!((scores.rotation_errors[i] - 0.2 * i as f64).abs() < 1e-7);
    }
    // Five steps of a fifth of the range: recall 0.4, 0.6, 0.8, 1, and 1 to the end.
    assert!((scores.add_auc - 76.0).abs() < 1e-9, "{}", scores.add_auc);
    assert!((auc(&scores.add_errors, 0.25) - 52.0).abs() < 1e-9);
    assert_eq!(recall_curve(&scores.add_errors, &[0.05, 0.15, 1.0]), [0.2, 0.4, 1.0]);
}

#[test]
fn a_symmetric_turn_costs_add_but_not_add_s() {
    let (vertices, triangles) = support::cuboid([0.08, 0.08, 0.08], 10);
    let model = ModelPoints::from_mesh(MeshRef::new(&vertices, &triangles)).unwrap();
    let gt = Isometry3::translation(0.1, 0.0, 0.6);
    let pred = gt * Isometry3::rotation(Vector3::z() * std::f64::consts::FRAC_PI_2);
    assert!(add_s(&pred, &gt, &model) < 1e-12);
    assert!(add(&pred, &gt, &model) > 0.05);
}

#[test]
fn invalid_models_are_none() {
    assert!(ModelPoints::new(Vec::new()).is_none());
    assert!(ModelPoints::new(vec![[0.0, f64::NAN, 0.0]]).is_none());
    assert!(ModelPoints::new(vec![[0.0, f64::INFINITY, 0.0]]).is_none());
    assert!(ModelPoints::from_mesh(MeshRef::new(&[[0.0; 3]], &[[0, 0, 9]])).is_none());
    // All points the same is allowed.
    let same = ModelPoints::new(vec![[0.1; 3]; 1000]).unwrap();
    assert_eq!(add_s(&Isometry3::identity(), &Isometry3::identity(), &same), 0.0);
}
