//! The truth that comes with a frame is the truth.
#![allow(clippy::unwrap_used, missing_docs)]

use marching_cubes::TriMesh;
use nalgebra::{Isometry3, Point3, Vector3};
use rgbd_io::{CustomFolder, CustomOptions, FrameSource, Intrinsics};
use rgbd_synth::{
    Backdrop, Error, Light, MaskFaults, Masks, Motion, Object, Occluder, Plane, Sensor, Sequence,
    SequenceSpec, Shape, Texture, write_custom,
};
use std::sync::Arc;

const K: Intrinsics = Intrinsics { fx: 150.0, fy: 155.0, cx: 81.3, cy: 58.9 };

fn scene(object: Object, cam_from_obj: Isometry3<f64>) -> SequenceSpec {
    SequenceSpec {
        name: "test".into(),
        frames: 3,
        width: 160,
        height: 120,
        intrinsics: K,
        seed: 1,
        object: Arc::new(object),
        motion: Motion::still(cam_from_obj),
        camera: None,
        occluders: Vec::new(),
        backdrop: Backdrop::default(),
        light: Light::default(),
        sensor: Sensor::perfect(),
        masks: Masks::Every,
        mask_faults: MaskFaults::none(),
    }
}

fn wall(normal: [f64; 3], distance: f64) -> Backdrop {
    Backdrop {
        planes: vec![Plane { normal, distance, texture: Texture::plain([0.5; 3]) }],
        furniture: vec![],
    }
}

fn ball(radius: f32) -> Object {
    Object::from_shape(Shape::Sphere { radius }, Texture::plain([0.7, 0.3, 0.2]), 0.002).unwrap()
}

#[test]
fn a_ball_has_its_analytic_depth_and_mask() {
    let center = Vector3::new(0.03, -0.02, 0.5);
    let pose = Isometry3::translation(center.x, center.y, center.z);
    let frame = Sequence::new(scene(ball(0.1), pose)).unwrap().render(0);
    let (mut compared, mut rim) = (0, 0);
    for y in 0..120 {
        for x in 0..160 {
            let ray = Vector3::from(K.unproject(x as f64, y as f64, 1.0));
            let (a, b) = (ray.norm_squared(), ray.dot(&center));
            let root = b * b - a * (center.norm_squared() - 0.01);
            // Distance of the ray from the ball's surface: mesh and ball differ by up to a few micrometres.
            let gap = (center.norm_squared() - b * b / a).sqrt() - 0.1;
            if gap.abs() < 2e-5 {
                rim += 1;
                continue;
            }
            assert_eq!(frame.visible_mask[(x, y)], if root > 0.0 { 255 } else { 0 }, "pixel {x} {y}");
            let z = frame.true_depth[(x, y)];
            if root <= 0.0 {
                assert_eq!(z, 0.0);
            } else if root.sqrt() / a.sqrt() > 0.03 {
                assert!((f64::from(z) - (b - root.sqrt()) / a).abs() < 1e-4, "pixel {x} {y}");
                compared += 1;
            }
        }
    }
    assert!(compared > 2000 && rim < 20, "{compared} {rim}");
}

#[test]
fn a_slanted_plane_has_its_analytic_depth_even_through_the_near_plane() {
    // Two triangles that reach behind the camera.
    let mesh = TriMesh {
        vertices: vec![[-20.0, 0.0, -20.0], [20.0, 0.0, -20.0], [20.0, 0.0, 20.0], [-20.0, 0.0, 20.0]],
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        ..Default::default()
    };
    let pose = Isometry3::new(Vector3::new(0.0, 0.3, 0.0), Vector3::new(0.3, 0.1, 0.2));
    let mut spec = scene(Object::from_mesh(mesh, Texture::plain([0.5; 3])), pose);
    let drawn = Sequence::new(spec.clone()).unwrap().render(0);
    let normal = pose.rotation * Vector3::y();
    let through = pose.translation.vector;
    let facing = if normal.dot(&through) > 0.0 { -normal } else { normal };
    let plane = wall(facing.into(), -facing.dot(&through));
    let mut compared = 0;
    for y in 0..120 {
        for x in 0..160 {
            let z = plane.planes[0].depth_along(K.unproject(x as f64, y as f64, 1.0)).unwrap_or(0.0);
            if (0.03..8.0).contains(&z) {
                assert!((f64::from(drawn.true_depth[(x, y)]) - z).abs() < 1e-4 * z.max(1.0));
                compared += 1;
            }
        }
    }
    assert!(compared > 3000, "{compared}");
    // The backdrop draws the same plane by itself.
    spec.motion = Motion::still(Isometry3::translation(0.0, 0.0, -9.0));
    let spec = SequenceSpec { backdrop: plane, object: Arc::new(ball(0.05)), ..spec };
    let cast = Sequence::new(spec).unwrap().render(0);
    let far = |z: f32| (0.03..8.0).contains(&z);
    for (a, b) in cast.true_depth.pixels().iter().zip(drawn.true_depth.pixels()) {
        assert!(!far(*a) || (a - b).abs() < 1e-3, "{a} {b}");
    }
}

#[test]
fn points_of_all_frames_lie_on_the_surface_and_agree_across_frames() {
    let sequence = Sequence::tiny().with_sensor(Sensor::perfect());
    let shape = sequence.spec().object.shape().unwrap().clone();
    let k = sequence.intrinsics();
    let frames: Vec<_> = [0, 9].map(|i| sequence.render(i)).into();
    let (mut compared, mut agreed) = (0, 0);
    for y in 0..120 {
        for x in 0..160 {
            if frames[0].visible_mask[(x, y)] == 0 {
                continue;
            }
            let p = Point3::from(k.unproject(x as f64, y as f64, f64::from(frames[0].frame.depth[(x, y)])));
            let p = frames[0].cam_from_obj.inverse() * p;
            let distance = shape.distance(p.coords.map(|v| v as f32).into());
            assert!(distance.abs() < 1.0e-3, "{distance} m off the surface");
            let q = frames[1].cam_from_obj * p;
            let [u, v] = k.project(q.coords.into()).unwrap();
            let (i, j) = (u.floor() as usize, v.floor() as usize);
            let at = |dx: usize, dy: usize| {
                let inside = frames[1].visible_mask.get(i + dx, j + dy).is_some_and(|m| *m != 0);
                inside.then(|| f64::from(frames[1].true_depth[(i + dx, j + dy)]))
            };
            let (Some(a), Some(b), Some(c), Some(d)) = (at(0, 0), at(1, 0), at(0, 1), at(1, 1)) else {
                continue;
            };
            let (s, t) = (u - i as f64, v - j as f64);
            let z = (a * (1.0 - s) + b * s) * (1.0 - t) + (c * (1.0 - s) + d * s) * t;
            // Turned away or behind another part of the object in the other frame.
            let spread = a.max(b).max(c).max(d) - a.min(b).min(c).min(d);
            if spread > 0.008 || z < q.z - 0.008 {
                continue;
            }
            compared += 1;
            agreed += usize::from((z - q.z).abs() < 1e-3);
        }
    }
    assert!(compared > 200 && agreed * 100 >= compared * 95, "{agreed} of {compared}");
}

#[test]
fn frames_do_not_depend_on_order_or_threads() {
    let sequence = Sequence::tiny();
    let (a, _, b) = (sequence.render(5), sequence.render(2), sequence.render(5));
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let c = pool.install(|| Sequence::tiny().render(5));
    for other in [&b, &c] {
        assert_eq!(a.frame.color, other.frame.color);
        assert_eq!(a.frame.depth, other.frame.depth);
        assert_eq!(a.visible_mask, other.visible_mask);
    }
    assert_ne!(a.frame.depth, sequence.render(6).frame.depth);
    let reseeded = Sequence::new(SequenceSpec { seed: 8, ..sequence.spec().clone() }).unwrap().render(5);
    assert_ne!(a.frame.depth, reseeded.frame.depth);
    assert_eq!(a.true_depth, reseeded.true_depth);
}

/// Depth errors on a wall, the object being out of sight.
fn errors(backdrop: Backdrop, sensor: Sensor) -> Vec<f64> {
    let mut spec = scene(ball(0.05), Isometry3::translation(0.0, 0.0, -1.0));
    (spec.backdrop, spec.sensor) = (backdrop, sensor);
    let f = Sequence::new(spec).unwrap().render(1);
    let pairs = f.frame.depth.pixels().iter().zip(f.true_depth.pixels());
    pairs.filter(|(z, _)| **z > 0.0).map(|(a, b)| f64::from(a - b)).collect()
}

#[test]
fn noise_has_the_deviation_of_the_model() {
    let sensor = Sensor { depth_base: 0.0004, depth_quadratic: 0.0019, ..Sensor::perfect() };
    for (z, quantum) in [(0.5, 0.0), (0.5, 0.001), (1.5, 0.001)] {
        let e = errors(wall([0.0, 0.0, -1.0], z), Sensor { quantum, ..sensor });
        assert_eq!(e.len(), 160 * 120);
        let mean = e.iter().sum::<f64>() / e.len() as f64;
        let std = (e.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / e.len() as f64).sqrt();
        let model = f64::from(sensor.depth_sigma(z as f32, 1.0));
        let model = (model * model + f64::from(quantum * quantum) / 12.0).sqrt();
        assert!((std / model - 1.0).abs() < 0.05, "{std} {model}");
        assert!(mean.abs() < 0.05 * std + 1e-6, "biased by {mean}");
    }
    assert!(sensor.depth_sigma(1.0, 0.2) == sensor.depth_sigma(1.0, 1.0));
    let grazing = Sensor { depth_grazing: 0.0001, ..sensor };
    // Nguyen et al.: theta^2 / (pi/2 - theta)^2 = 25 at 75 degrees.
    let more = grazing.depth_sigma(1.0, 75f32.to_radians().cos()) - sensor.depth_sigma(1.0, 1.0);
    assert!((more - 0.0025).abs() < 1e-4, "{more}");
}

#[test]
fn depth_is_missing_in_the_share_asked_for() {
    let all = (160 * 120) as f64;
    let facing = || wall([0.0, 0.0, -1.0], 1.0);
    let holes = Sensor { hole_share: 0.05, hole_radius: 4.0, ..Sensor::perfect() };
    let lost = 1.0 - errors(facing(), holes).len() as f64 / all;
    // Holes overlap a little and are cut at the border.
    assert!((0.035..0.06).contains(&lost), "{lost}");
    let near = Sensor { max_range: 0.9, ..Sensor::perfect() };
    assert!(errors(facing(), near).is_empty());

    let mut spec = scene(ball(0.1), Isometry3::translation(0.0, 0.0, 0.5));
    spec.backdrop = facing();
    spec.sensor = Sensor { edge_dropout: 0.4, edge_radius: 1, ..Sensor::perfect() };
    let f = Sequence::new(spec).unwrap().render(0);
    let (mut edge, mut lost) = (0, 0);
    for y in 1..119 {
        for x in 1..159 {
            let around = (0..9).map(|i| f.true_depth[(x + i % 3 - 1, y + i / 3 - 1)]);
            let (a, b) = around.fold((9f32, 0f32), |(a, b), z| (a.min(z), b.max(z)));
            let gone = f.frame.depth[(x, y)] == 0.0;
            if b - a > 0.02 {
                edge += 1;
                lost += usize::from(gone);
            } else {
                assert!(!gone);
            }
        }
    }
    let share = lost as f64 / f64::from(edge);
    assert!(edge > 200 && (0.3..0.5).contains(&share), "{share} of {edge}");
}

#[test]
fn flying_pixels_lie_between_the_two_sides_of_an_edge() {
    let mut spec = scene(ball(0.1), Isometry3::translation(0.0, 0.0, 0.5));
    spec.backdrop = wall([0.0, 0.0, -1.0], 1.0);
    spec.sensor = Sensor { flying: 0.5, ..Sensor::perfect() };
    let f = Sequence::new(spec).unwrap().render(0);
    let between = f.frame.depth.pixels().iter().filter(|z| (0.55..0.98).contains(*z)).count();
    assert!(between > 50, "{between}");
    assert!(f.frame.depth.pixels().iter().all(|z| (0.39..=1.0).contains(z)));
}

#[test]
fn the_demo_turns_far_and_smoothly_and_stays_visible() {
    let demo = Sequence::demo();
    let poses: Vec<_> = (0..demo.len()).map(|i| demo.cam_from_obj(i)).collect();
    let mut turned = 0.0;
    for pair in poses.windows(2) {
        let angle = pair[0].rotation.angle_to(&pair[1].rotation).to_degrees();
        turned += angle;
        assert!(angle <= 4.0, "{angle} degrees in a frame");
        let moved = (pair[0].translation.vector - pair[1].translation.vector).norm();
        assert!(moved <= 0.015, "{moved} m in a frame");
    }
    assert!(turned > 250.0, "{turned}");
    let distances = poses.iter().map(|p| p.translation.z);
    assert!(distances.clone().all(|z| (0.5..0.7).contains(&z)));
    // Directions from which the object is seen: opposite sides, and from above and below.
    let views: Vec<_> = poses.iter().map(|p| (p.inverse() * Point3::origin()).coords.normalize()).collect();
    let widest = views.iter().map(|v| views[0].angle(v).to_degrees()).fold(0.0, f64::max);
    assert!(widest > 150.0, "{widest}");
    let heights = views.iter().map(|v| v.y);
    let tilt = heights.clone().fold(f64::MIN, f64::max) - heights.fold(f64::MAX, f64::min);
    assert!(tilt > 0.6, "{tilt}");
    let hand_only = SequenceSpec { occluders: demo.spec().occluders[..1].to_vec(), ..demo.spec().clone() };
    let hand_only = Sequence::new(hand_only).unwrap();
    let mut rod = 0.0f64;
    for index in (0..demo.len()).step_by(2) {
        let hidden = demo.occlusion(index);
        assert!(hidden <= 0.5, "{hidden} hidden in frame {index}");
        rod = rod.max(hidden - hand_only.occlusion(index));
    }
    assert!((0.2..0.4).contains(&rod), "the rod hides {rod}");
}

#[test]
fn the_occlusion_agrees_with_the_masks() {
    let sequence = Sequence::tiny();
    let alone = SequenceSpec { occluders: Vec::new(), ..sequence.spec().clone() };
    let alone = Sequence::new(alone).unwrap();
    let count = |s: &Sequence| s.render(12).visible_mask.pixels().iter().filter(|m| **m != 0).count() as f64;
    let hidden = 1.0 - count(&sequence) / count(&alone);
    assert!(hidden > 0.02 && (hidden - sequence.occlusion(12)).abs() < 1e-9, "{hidden}");
}

#[test]
fn the_true_mesh_is_the_closed_outer_surface() {
    let object = rgbd_synth::jug();
    let (mesh, shape) = (object.mesh(), object.shape().unwrap());
    assert!(mesh.is_watertight() && mesh.signed_volume() > 0.0);
    assert_eq!(mesh.colors.len(), mesh.vertices.len());
    let errors: Vec<f32> = mesh.vertices.iter().map(|&v| shape.distance(v).abs()).collect();
    let mean = errors.iter().sum::<f32>() / errors.len() as f32;
    assert!(mean < 2e-5 && errors.iter().all(|e| *e < 6e-4), "{mean}");
    let extent = mesh.bounds().map(|(a, b)| std::array::from_fn::<f32, 3, _>(|k| b[k] - a[k])).unwrap();
    assert!(extent.iter().all(|e| (0.07..0.18).contains(e)), "{extent:?}");
}

#[test]
fn masks_are_given_as_asked_for() {
    let sequence = Sequence::tiny();
    let given = |masks| {
        let s = sequence.with_masks(masks);
        [0, 1].map(|i| s.frame(i).unwrap().mask.is_some())
    };
    assert_eq!(given(Masks::Every), [true, true]);
    assert_eq!(given(Masks::First), [true, false]);
    assert_eq!(given(Masks::None), [false, false]);
    assert_eq!(FrameSource::len(&sequence), 24);
    assert_eq!(sequence.id(3), "000003");
    assert!(sequence.frame(24).unwrap_err().to_string().contains("below 24"));
}

#[test]
fn blur_smears_and_brightness_swings() {
    let sharp = Sequence::tiny().with_sensor(Sensor::perfect());
    let blurred = sharp.with_sensor(Sensor { exposure: 1.0, ..Sensor::perfect() });
    let (a, b) = (sharp.render(7), blurred.render(7));
    assert_eq!(a.frame.depth, b.frame.depth);
    let edges = |s: &rgbd_synth::SynthFrame| -> i64 {
        let p = s.frame.color.pixels();
        let pairs = p.windows(2).zip(s.visible_mask.pixels()).filter(|(_, m)| **m != 0);
        pairs.map(|(w, _)| (i64::from(w[0][1]) - i64::from(w[1][1])).abs()).sum()
    };
    assert!(edges(&b) < edges(&a) * 9 / 10);
    let swinging = sharp.with_sensor(Sensor { brightness_swing: 0.3, ..Sensor::perfect() });
    let sum = |s: &Sequence, i| {
        s.render(i).frame.color.pixels().iter().map(|c| u64::from(c[0])).sum::<u64>() as f64
    };
    let ratio = sum(&swinging, 22) / sum(&sharp, 22);
    assert!((1.25..1.35).contains(&ratio), "{ratio}");
}

#[test]
fn a_nearer_occluder_hides_the_object() {
    let mut spec = scene(ball(0.05), Isometry3::translation(0.0, 0.0, 0.5));
    let occluder = |z| Occluder::Rigid {
        object: Arc::new(ball(0.05)),
        motion: Motion::still(Isometry3::translation(0.0, 0.0, z)),
    };
    spec.occluders = vec![occluder(0.35)];
    let hidden = Sequence::new(spec.clone()).unwrap();
    assert!(hidden.occlusion(0) == 1.0 && hidden.render(0).visible_mask.pixels().iter().all(|m| *m == 0));
    spec.occluders = vec![occluder(0.8)];
    assert_eq!(Sequence::new(spec).unwrap().occlusion(0), 0.0);
}

#[test]
fn a_written_sequence_reads_back() {
    let dir = tempfile::tempdir().unwrap();
    let sequence = Sequence::tiny().truncated(2);
    write_custom(&sequence, dir.path()).unwrap();
    let folder = CustomFolder::open(dir.path(), &CustomOptions::default()).unwrap();
    assert_eq!(folder.len(), 2);
    let (read, made) = (folder.frame(0).unwrap(), sequence.render(0));
    assert_eq!(read.color, made.frame.color);
    assert_eq!(read.mask.unwrap().pixels().len(), 160 * 120);
    for (a, b) in read.depth.pixels().iter().zip(made.frame.depth.pixels()) {
        assert!((a - b).abs() <= 5.1e-4);
    }
    let pose = rgbd_io::poses::read_pose(&dir.path().join("gt_poses/000001.txt")).unwrap();
    assert!((pose.to_homogeneous() - sequence.cam_from_obj(1).to_homogeneous()).norm() < 1e-6);
    assert!(dir.path().join("mesh/model.obj").metadata().unwrap().len() > 1000);
}

#[test]
fn descriptions_that_cannot_work_are_refused() {
    let texture = Texture::plain([0.5; 3]);
    let make = |shape, voxel| Object::from_shape(shape, texture.clone(), voxel);
    let sphere = || Shape::Sphere { radius: 0.1 };
    assert!(matches!(make(Shape::Union { parts: vec![], blend: 0.0 }, 0.01), Err(Error::EmptyShape)));
    assert!(matches!(make(Shape::Sphere { radius: f32::NAN }, 0.01), Err(Error::EmptyShape)));
    for voxel in [0.0, -1.0, f32::NAN, 1e-5] {
        assert!(matches!(make(sphere(), voxel), Err(Error::Voxel { .. })));
    }
    let good = scene(ball(0.1), Isometry3::identity());
    let bad = Intrinsics { fx: -1.0, ..K };
    assert!(matches!(
        Sequence::new(SequenceSpec { intrinsics: bad, ..good.clone() }),
        Err(Error::Intrinsics(_))
    ));
    assert!(matches!(
        Sequence::new(SequenceSpec { width: 0, ..good.clone() }),
        Err(Error::EmptyImage { .. })
    ));
    // The camera inside the object, and poses that are no poses, are defined too.
    Sequence::new(good.clone()).unwrap().render(0);
    let nowhere = Motion::still(Isometry3::translation(f64::NAN, 0.0, 0.0));
    Sequence::new(SequenceSpec { motion: nowhere, ..good }).unwrap().render(0);
}
