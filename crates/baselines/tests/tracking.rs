//! The three methods on a short synthetic sequence with known poses, and on what no method can track.
#![allow(clippy::unwrap_used)]

use baselines::{Baseline, BaselineConfig, Pose, PoseFusion};
use eval_metrics::{ModelPoints, add, rebase};
use nalgebra::{Isometry3, Point3, Vector3};
use rgbd_io::{Image, Intrinsics, RgbdFrame};
use rgbd_synth::{Sensor, Sequence};
use std::sync::OnceLock;

const FRAMES: usize = 10;

/// Half the demo's resolution.
fn sequence() -> &'static Sequence {
    static SEQUENCE: OnceLock<Sequence> = OnceLock::new();
    SEQUENCE.get_or_init(|| {
        let tiny = Sequence::tiny().with_sensor(Sensor::perfect());
        let mut spec = tiny.spec().clone();
        (spec.width, spec.height) = (2 * spec.width, 2 * spec.height);
        spec.intrinsics = spec.intrinsics.scaled(2.0, 2.0);
        spec.frames = FRAMES;
        Sequence::new(spec).unwrap()
    })
}

fn frames() -> &'static [RgbdFrame] {
    static FRAMES_RENDERED: OnceLock<Vec<RgbdFrame>> = OnceLock::new();
    FRAMES_RENDERED.get_or_init(|| (0..FRAMES).map(|i| sequence().render(i).frame).collect())
}

fn model() -> ModelPoints {
    ModelPoints::new(sequence().mesh().vertices.iter().map(|v| v.map(f64::from)).collect()).unwrap()
}

/// ADD of each frame, metres, with the object frames aligned at the first.
fn errors(poses: &[Pose]) -> Vec<f64> {
    let truth: Vec<_> = (0..poses.len()).map(|i| Some(sequence().cam_from_obj(i))).collect();
    let found: Vec<_> = poses.iter().map(|p| Some(p.cam_from_obj)).collect();
    let model = model();
    rebase(&found, &truth).iter().zip(&truth).map(|(p, t)| add(&p.unwrap(), &t.unwrap(), &model)).collect()
}

/// Tracks all frames; the error at the end must stay below `limit` metres, and well below that of no motion.
fn check(method: Baseline, limit: f64) {
    let mut tracker = method.tracker(&BaselineConfig::default());
    let poses: Vec<Pose> = frames().iter().map(|f| tracker.track(f)).collect();
    assert!(poses.iter().all(|p| p.tracked), "{method:?}");
    let errors = errors(&poses);
    assert!(errors.iter().all(|e| *e < limit), "{method:?}: {errors:?}");
    let still = vec![poses[0]; FRAMES];
    assert!(*self::errors(&still).last().unwrap() > 2.0 * limit, "the sequence is too easy");

    // The mesh lies on the true surface.
    let mesh = tracker.mesh(0.003);
    assert!(mesh.triangles.len() > 500 && mesh.has_colors() && mesh.has_normals());
    let gt_from_pred = sequence().cam_from_obj(0).inverse() * poses[0].cam_from_obj;
    let shape = sequence().spec().object.shape().unwrap();
    let mut distances: Vec<f32> = mesh
        .vertices
        .iter()
        .map(|v| gt_from_pred * nalgebra::Point3::from(v.map(f64::from)))
        .map(|p| shape.distance([p.x as f32, p.y as f32, p.z as f32]).abs())
        .collect();
    distances.sort_by(f32::total_cmp);
    let median = distances[distances.len() / 2];
    assert!(median < 0.004, "{method:?}: median distance of the mesh {median}");
}

#[test]
fn true_poses_give_the_true_surface() {
    // Somewhere else than the fused volume's own frame.
    let other = Isometry3::new(Vector3::new(0.3, -0.2, 0.1), Vector3::new(0.4, -0.7, 1.1));
    let mut fusion = PoseFusion::new(&BaselineConfig::default());
    for (i, frame) in frames().iter().enumerate() {
        assert!(fusion.add(frame, &(sequence().cam_from_obj(i) * other)));
    }
    let mesh = fusion.mesh(0.003);
    assert!(mesh.triangles.len() > 500);
    let shape = sequence().spec().object.shape().unwrap();
    let distance = |v: &[f32; 3]| {
        let p = other * Point3::from(v.map(f64::from));
        shape.distance([p.x as f32, p.y as f32, p.z as f32]).abs()
    };
    let mut distances: Vec<f32> = mesh.vertices.iter().map(distance).collect();
    distances.sort_by(f32::total_cmp);
    assert!(distances[distances.len() / 2] < 0.002, "median {}", distances[distances.len() / 2]);
    // A frame without mask, or a pose that is none, changes nothing.
    let unmasked = RgbdFrame { mask: None, ..frames()[0].clone() };
    assert!(!fusion.add(&unmasked, &other));
    assert!(!fusion.add(&frames()[0], &Isometry3::translation(f64::NAN, 0.0, 0.0)));
    assert_eq!(fusion.mesh(0.003).vertices.len(), mesh.vertices.len());
    assert!(PoseFusion::new(&BaselineConfig::default()).mesh(0.003).triangles.is_empty());
}

#[test]
fn kinectfusion_follows() {
    check(Baseline::KinectFusion, 0.01);
}

#[test]
fn sdf2sdf_follows() {
    check(Baseline::Sdf2Sdf, 0.01);
}

#[test]
fn frame_to_frame_follows() {
    check(Baseline::FrameToFrame, 0.01);
}

/// A plain ball of 5 cm radius with its middle there, metres.
fn ball(middle: [f64; 3]) -> RgbdFrame {
    let intrinsics = Intrinsics { fx: 400.0, fy: 400.0, cx: 99.5, cy: 79.5 };
    let depth = Image::from_fn(200, 160, |x, y| {
        let ray = Vector3::from(intrinsics.unproject(x as f64, y as f64, 1.0));
        let middle = Vector3::from(middle);
        let (a, b, c) = (ray.dot(&ray), ray.dot(&middle), middle.dot(&middle) - 0.0025);
        let root = b * b - a * c;
        if root > 0.0 { ((b - root.sqrt()) / a) as f32 } else { 0.0 }
    });
    let mask = Some(depth.map(|&z| u8::from(z > 0.0)));
    RgbdFrame { id: String::new(), color: depth.map(|_| [120; 3]), depth, mask, intrinsics }
}

/// Its place can be seen; its turn can't, and must not run away.
#[test]
fn a_plain_ball_is_followed() {
    for method in Baseline::ALL {
        let mut tracker = method.tracker(&BaselineConfig::default());
        let place = |i: usize| [-0.02 + 0.004 * i as f64, 0.002 * i as f64, 0.5 + 0.003 * i as f64];
        let first = tracker.track(&ball(place(0)));
        for i in 1..10 {
            let pose = tracker.track(&ball(place(i)));
            assert!(pose.tracked, "{method:?}, frame {i}");
            let middle = pose.cam_from_obj * first.cam_from_obj.inverse() * Point3::from(place(0));
            let error = (middle - Point3::from(place(i))).norm();
            assert!(error < 0.002, "{method:?}, frame {i}: {error}");
            let turn = pose.cam_from_obj.rotation.angle();
            assert!(turn < 0.45, "{method:?}, frame {i}: turned by {turn}");
        }
    }
}

/// The object leaves, comes back a little further on, and is found again.
#[test]
fn a_gap_is_bridged() {
    for method in Baseline::ALL {
        let mut tracker = method.tracker(&BaselineConfig::default());
        let mut poses = Vec::new();
        for (i, frame) in frames().iter().take(8).enumerate() {
            let hidden = RgbdFrame { mask: None, ..frame.clone() };
            poses.push(tracker.track(if i == 3 || i == 4 { &hidden } else { frame }));
            assert_eq!(poses[i].tracked, i != 3 && i != 4, "{method:?}, frame {i}");
        }
        let error = errors(&poses)[7];
        assert!(error < 0.01, "{method:?}: {error}");
    }
}

#[test]
fn what_cannot_be_tracked_keeps_the_last_pose() {
    let good = &frames()[0];
    let (width, height) = good.depth.size();
    let no_mask = RgbdFrame { mask: None, ..good.clone() };
    let no_depth = RgbdFrame { depth: Image::filled(width, height, 0.0), ..good.clone() };
    let nan_depth = RgbdFrame { depth: Image::filled(width, height, f32::NAN), ..good.clone() };
    let empty_mask = RgbdFrame { mask: Some(Image::filled(width, height, 0)), ..good.clone() };
    let wrong_size = RgbdFrame { mask: Some(Image::filled(8, 8, 1)), ..good.clone() };
    let small_color = RgbdFrame { color: Image::filled(8, 8, [0; 3]), ..good.clone() };
    let nothing = RgbdFrame {
        color: Image::default(),
        depth: Image::default(),
        mask: Some(Image::default()),
        ..good.clone()
    };
    let mut camera = good.intrinsics;
    camera.fx = f64::NAN;
    let no_camera = RgbdFrame { intrinsics: camera, ..good.clone() };
    // The mask is full, so that something is there that is not the object.
    let elsewhere = RgbdFrame { depth: Image::filled(width, height, 3.0), ..good.clone() };
    let bad =
        [no_mask, no_depth, nan_depth, empty_mask, wrong_size, small_color, nothing, no_camera, elsewhere];
    for method in Baseline::ALL {
        let mut tracker = method.tracker(&BaselineConfig::default());
        assert!(tracker.mesh(0.002).triangles.is_empty());
        for frame in &bad[..8] {
            assert_eq!(tracker.track(frame), Pose { cam_from_obj: Isometry3::identity(), tracked: false });
        }
        let first = tracker.track(good);
        assert!(first.tracked && first.cam_from_obj.rotation.angle() == 0.0);
        for (i, frame) in bad.iter().enumerate() {
            assert_eq!(tracker.track(frame), Pose { tracked: false, ..first }, "{method:?}, frame {i}");
        }
        // The model is unharmed: the next good frame is tracked again.
        assert!(tracker.track(&frames()[1]).tracked, "{method:?}");
        for spacing in [0.0, -1.0, f32::NAN, f32::INFINITY] {
            assert!(tracker.mesh(spacing).triangles.is_empty());
        }
    }
}

#[test]
fn unusable_numbers_in_the_configuration_are_no_panic() {
    let config = BaselineConfig {
        voxel_m: Some(f32::NAN),
        truncation_voxels: f32::NAN,
        max_weight: f32::NAN,
        max_step_m: f64::NAN,
        max_step_rad: f64::NAN,
        seed: 1,
    };
    for method in Baseline::ALL {
        let mut tracker = method.tracker(&config);
        frames().iter().take(2).for_each(|f| {
            tracker.track(f);
        });
        assert!(tracker.mesh(0.01).vertices.len() < 100_000);
    }
}

#[test]
fn runs_repeat() {
    let run = || {
        let mut tracker = Baseline::FrameToFrame.tracker(&BaselineConfig::default());
        frames().iter().take(4).map(|f| tracker.track(f)).collect::<Vec<_>>()
    };
    assert_eq!(run(), run());
}

#[test]
fn names_lead_back() {
    for (name, method) in Baseline::names().into_iter().zip(Baseline::ALL) {
        assert_eq!(Baseline::from_name(&name.to_uppercase()), Some(method));
    }
    assert_eq!(Baseline::from_name("bundlesdf"), None);
}
