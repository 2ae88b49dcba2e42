//! Small rendered scenes with exact masks: a textured box in front of a wall, a bar that crosses it, fingers that
//! hold it.
#![allow(clippy::unwrap_used, missing_docs)]

use mask_tracker::{GivenMasks, Prior, Propagate, Segmentation, SurfacePoint, VideoSegmenter};
use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use rgbd_io::{Image, Intrinsics, Mask, RgbdFrame};

const SIZE: (usize, usize) = (160, 120);
const CAMERA: Intrinsics = Intrinsics { fx: 150.0, fy: 150.0, cx: 79.5, cy: 59.5 };
/// Half extents of the box's front face, metres.
const HALF: [f64; 2] = [0.11, 0.08];

#[derive(Clone, Copy, Default)]
struct Scene {
    /// Centre of the box's front face in the camera frame, and its turn about the vertical axis; none = gone.
    object: Option<([f64; 3], f64)>,
    /// Left edge (pixel) of a vertical bar, 24 pixels wide, in front of the box.
    bar: Option<f64>,
    /// A gripper that touches the box from the right at the same depth.
    gripper: bool,
}

fn pose(center: [f64; 3], turn: f64) -> Isometry3<f64> {
    Isometry3::from_parts(
        Translation3::new(center[0], center[1], center[2]),
        UnitQuaternion::from_euler_angles(0.0, turn, 0.0),
    )
}

fn checker(a: f64, b: f64, size: f64) -> bool {
    ((a / size).floor() + (b / size).floor()).rem_euclid(2.0) < 1.0
}

/// Deterministic pixel noise in -1..1.
fn noise(x: usize, y: usize, frame: usize) -> f64 {
    let v = ((x * 12_989 + y * 78_233 + frame * 37_719) as f64 * 0.618_033_988).fract() * 43_758.545;
    2.0 * v.fract() - 1.0
}

fn render(scene: &Scene, index: usize) -> (RgbdFrame, Mask) {
    let mut color = Image::filled(SIZE.0, SIZE.1, [0u8; 3]);
    let mut depth = Image::filled(SIZE.0, SIZE.1, 0.0f32);
    let mut mask = Image::filled(SIZE.0, SIZE.1, 0u8);
    let box_from_cam = scene.object.map(|(c, turn)| (pose(c, turn).inverse(), c));
    for y in 0..SIZE.1 {
        for x in 0..SIZE.0 {
            let ray = CAMERA.unproject(x as f64, y as f64, 1.0);
            let wall =
                if checker(ray[0], ray[1], 0.09) { [120.0, 125.0, 130.0] } else { [150.0, 150.0, 140.0] };
            let (mut z, mut rgb, mut object) = (1.2, wall, false);
            if let Some((inverse, center)) = box_from_cam {
                // The ray meets the face's plane z = 0 of the box frame.
                let origin = inverse * nalgebra::Point3::origin();
                let direction = inverse.rotation * nalgebra::Vector3::from(ray);
                let t = -origin.z / direction.z;
                let hit = origin + direction * t;
                if t > 0.0 && hit.x.abs() < HALF[0] && hit.y.abs() < HALF[1] {
                    let dark = checker(hit.x, hit.y, 0.03);
                    (z, object) = (t, true);
                    rgb = if dark { [170.0, 40.0, 40.0] } else { [220.0, 180.0, 50.0] };
                }
                let u = CAMERA.project([center[0] + HALF[0], center[1], center[2]]).unwrap();
                if scene.gripper && x as f64 > u[0] - 8.0 && (y as f64 - u[1]).abs() < 9.0 {
                    (z, rgb, object) = (center[2] - 0.012, [40.0, 45.0, 50.0], false);
                }
            }
            if scene.bar.is_some_and(|left| (left..left + 24.0).contains(&(x as f64))) {
                (z, rgb, object) = (0.45, [205.0, 150.0, 125.0], false);
            }
            let grain = 6.0 * noise(x, y, index);
            color[(x, y)] = rgb.map(|c: f64| (c + grain) as u8);
            depth[(x, y)] = (z + 0.0015 * noise(y, x, index + 7)) as f32;
            mask[(x, y)] = if object { 255 } else { 0 };
        }
    }
    (RgbdFrame { id: format!("{index:04}"), color, depth, mask: None, intrinsics: CAMERA }, mask)
}

fn iou(a: &Mask, b: &Mask) -> f64 {
    let pairs = || a.pixels().iter().zip(b.pixels());
    let both = pairs().filter(|(a, b)| **a != 0 && **b != 0).count();
    let either = pairs().filter(|(a, b)| **a != 0 || **b != 0).count();
    if either == 0 { 1.0 } else { both as f64 / either as f64 }
}

fn face() -> Vec<SurfacePoint> {
    let mut points = Vec::new();
    for i in -22..=22 {
        for j in -16..=16 {
            let position =
                [f64::from(i) * HALF[0] / 22.0, f64::from(j) * HALF[1] / 16.0, 0.0].map(|v| v as f32);
            points.push(SurfacePoint { position, normal: [0.0, 0.0, -1.0] });
        }
    }
    points
}

fn step(segmenter: &mut Propagate, frame: &RgbdFrame, prior: &Prior<'_>) -> Segmentation {
    let found = segmenter.next(frame, prior);
    segmenter.refine(frame, found, prior)
}

fn drifting(k: usize) -> ([f64; 3], f64) {
    let t = k as f64;
    ([-0.1 + 0.006 * t, 0.03 * (0.2 * t).sin(), 0.6 + 0.002 * t], 0.012 * t)
}

/// Mean IoU over `frames` frames, starting from the exact first mask.
fn mean_iou(frames: usize, scene: impl Fn(usize) -> Scene, with_prior: bool) -> f64 {
    let model = face();
    let mut segmenter = Propagate::default();
    let (frame, mask) = render(&scene(0), 0);
    segmenter.start(&frame, &mask);
    let mut sum = 0.0;
    for k in 1..frames {
        let (frame, truth) = render(&scene(k), k);
        let prior = match scene(k).object {
            Some((center, turn)) if with_prior => {
                Prior { cam_from_obj: Some(pose(center, turn)), model: &model, confidence: 1.0 }
            }
            _ => Prior::default(),
        };
        sum += iou(&step(&mut segmenter, &frame, &prior).mask, &truth);
    }
    sum / (frames - 1) as f64
}

#[test]
fn follows_a_turning_box_without_a_pose() {
    let j = mean_iou(30, |k| Scene { object: Some(drifting(k)), ..Scene::default() }, false);
    assert!(j > 0.93, "{j}");
}

#[test]
fn an_occluder_that_crosses_is_left_out_and_what_it_hid_comes_back() {
    let scene = |k: usize| Scene {
        object: Some(([0.0, 0.0, 0.6], 0.0)),
        bar: Some(-30.0 + 6.0 * k as f64),
        gripper: false,
    };
    for with_prior in [false, true] {
        let j = mean_iou(34, scene, with_prior);
        assert!(j > 0.9, "{j} with prior {with_prior}");
    }
}

#[test]
fn a_gripper_that_moves_along_is_never_taken_for_the_object() {
    let scene = |k: usize| Scene { object: Some(drifting(k)), bar: None, gripper: true };
    for with_prior in [false, true] {
        let j = mean_iou(40, scene, with_prior);
        assert!(j > 0.9, "{j} with prior {with_prior}");
    }
}

#[test]
fn knows_when_the_object_is_gone_and_finds_it_again() {
    let mut segmenter = Propagate::default();
    let (frame, mask) = render(&Scene { object: Some(([-0.1, 0.0, 0.6], 0.0)), ..Scene::default() }, 0);
    segmenter.start(&frame, &mask);
    let found = step(&mut segmenter, &frame, &Prior::default());
    assert!(found.confidence > 0.9 && found.area > 500);
    for k in 1..6 {
        let (frame, _) = render(&Scene::default(), k);
        let found = step(&mut segmenter, &frame, &Prior::default());
        assert_eq!(found.area, 0);
        assert!(found.confidence < 0.3, "{}", found.confidence);
    }
    // Elsewhere in the image, and nearer.
    for k in 6..9 {
        let scene = Scene { object: Some(([0.13, 0.05, 0.55], 0.1)), ..Scene::default() };
        let (frame, truth) = render(&scene, k);
        let found = step(&mut segmenter, &frame, &Prior::default());
        if k == 8 {
            assert!(iou(&found.mask, &truth) > 0.85, "{}", iou(&found.mask, &truth));
            assert!(found.confidence > 0.6);
        }
    }
}

#[test]
fn hidden_completely_is_gone_until_it_shows_again() {
    let object = Some(([0.0, 0.0, 0.9], 0.0));
    let mut segmenter = Propagate::default();
    let (frame, mask) = render(&Scene { object, ..Scene::default() }, 0);
    segmenter.start(&frame, &mask);
    let mut last = 0.0;
    for k in 1..30 {
        // For ten frames something fills the whole view.
        let (mut frame, mut truth) = render(&Scene { object, ..Scene::default() }, k);
        if (10..20).contains(&k) {
            frame.depth = frame.depth.map(|_| 0.4);
            frame.color = frame.color.map(|_| [205, 150, 125]);
            truth = truth.map(|_| 0);
        }
        let found = step(&mut segmenter, &frame, &Prior::default());
        if (10..20).contains(&k) {
            assert_eq!(found.area, 0);
        }
        last = iou(&found.mask, &truth);
    }
    assert!(last > 0.9, "{last}");
}

#[test]
fn hidden_completely_and_back_nearer_turned_and_in_a_dimmer_light() {
    let before = Scene { object: Some(([0.0, 0.0, 0.75], 0.0)), ..Scene::default() };
    let after = Scene { object: Some(([0.0, 0.0, 0.62], 0.35)), ..Scene::default() };
    let mut segmenter = Propagate::default();
    let (frame, mask) = render(&before, 0);
    segmenter.start(&frame, &mask);
    for k in 1..16 {
        let (mut frame, truth) = render(if k < 10 { &before } else { &after }, k);
        let covered = match k {
            6 => 90,
            7..12 => SIZE.0,
            _ => 0,
        };
        for y in 0..SIZE.1 {
            for x in 0..covered {
                frame.depth[(x, y)] = 0.4;
                frame.color[(x, y)] = [205, 150, 125];
            }
        }
        if k >= 12 {
            frame.color = frame.color.map(|c| c.map(|c| c - c / 8));
        }
        let found = step(&mut segmenter, &frame, &Prior::default());
        match k {
            7..12 => assert_eq!(found.area, 0, "frame {k}"),
            12.. => assert!(iou(&found.mask, &truth) > 0.9, "frame {k}: {:.2}", iou(&found.mask, &truth)),
            _ => (),
        }
    }
}

#[test]
fn hidden_bit_by_bit_until_nothing_is_left_it_is_all_taken_back_at_once() {
    let object = Some(([0.0, 0.0, 0.9], 0.0));
    let mut segmenter = Propagate::default();
    let (frame, mask) = render(&Scene { object, ..Scene::default() }, 0);
    segmenter.start(&frame, &mask);
    let mut found_at = None;
    for k in 1..30 {
        // A curtain is drawn from the left, so that the last that is seen is a sliver; then it drops.
        let (mut frame, truth) = render(&Scene { object, ..Scene::default() }, k);
        let covered = if k < 22 { 44 + 3 * k } else { 0 };
        for y in 0..SIZE.1 {
            for x in 0..covered.min(SIZE.0) {
                frame.depth[(x, y)] = 0.4;
                frame.color[(x, y)] = [205, 150, 125];
            }
        }
        let found = step(&mut segmenter, &frame, &Prior::default());
        if k == 21 {
            assert_eq!(found.area, 0);
        }
        if k >= 22 && iou(&found.mask, &truth) > 0.9 {
            found_at = found_at.or(Some(k));
        }
    }
    assert!(found_at.is_some_and(|k| k <= 23), "{found_at:?}");
}

#[test]
fn without_any_depth_colour_carries_on() {
    let mut segmenter = Propagate::default();
    let scene = |k: usize| Scene { object: Some(drifting(k)), ..Scene::default() };
    let (mut frame, mask) = render(&scene(0), 0);
    frame.depth = frame.depth.map(|_| 0.0);
    segmenter.start(&frame, &mask);
    let mut lowest = 1.0f64;
    for k in 1..20 {
        let (mut frame, truth) = render(&scene(k), k);
        frame.depth = frame.depth.map(|_| if k % 2 == 0 { 0.0 } else { f32::NAN });
        lowest = lowest.min(iou(&step(&mut segmenter, &frame, &Prior::default()).mask, &truth));
    }
    assert!(lowest > 0.85, "{lowest}");
}

#[test]
fn degenerate_inputs_give_empty_masks() {
    let scene = Scene { object: Some(([0.0, 0.0, 0.6], 0.0)), ..Scene::default() };
    let (frame, mask) = render(&scene, 0);
    let empty_frame = RgbdFrame {
        id: String::new(),
        color: Image::filled(0, 0, [0; 3]),
        depth: Image::filled(0, 0, 0.0),
        mask: None,
        intrinsics: CAMERA,
    };
    let mut segmenter = Propagate::default();
    assert_eq!(segmenter.next(&frame, &Prior::default()).area, 0);
    for first in [mask.map(|_| 0), Image::filled(3, 3, 1u8)] {
        segmenter.start(&frame, &first);
        let found = step(&mut segmenter, &frame, &Prior::default());
        assert_eq!((found.area, found.confidence), (0, 0.0));
        assert_eq!(found.mask.size(), SIZE);
    }
    segmenter.start(&empty_frame, &Image::default());
    assert_eq!(step(&mut segmenter, &empty_frame, &Prior::default()).area, 0);

    // Broken camera, poses and models; a frame of another size; depth of another size than colour.
    segmenter.start(&frame, &mask);
    let nan_pose = Isometry3::from_parts(Translation3::new(f64::NAN, 0.0, 0.0), UnitQuaternion::identity());
    let model = [SurfacePoint { position: [f32::NAN; 3], normal: [f32::INFINITY; 3] }; 3];
    let prior = Prior { cam_from_obj: Some(nan_pose), model: &model, confidence: f32::NAN };
    step(&mut segmenter, &frame, &prior);
    step(&mut segmenter, &frame, &prior);
    let mut broken = frame.clone();
    broken.intrinsics.fx = f64::NAN;
    broken.depth = Image::filled(5, 4, 0.6);
    step(&mut segmenter, &broken, &Prior::default());
    let found = segmenter.next(&empty_frame, &prior);
    assert_eq!(found.area, 0);
    segmenter.refine(&frame, found, &prior);
    let small = RgbdFrame {
        color: Image::from_fn(80, 60, |x, y| frame.color[(2 * x, 2 * y)]),
        depth: Image::from_fn(80, 60, |x, y| frame.depth[(2 * x, 2 * y)]),
        intrinsics: CAMERA.scaled(0.5, 0.5),
        ..frame.clone()
    };
    segmenter.start(&frame, &mask);
    let found = step(&mut segmenter, &small, &Prior::default());
    assert_eq!(found.mask.size(), (80, 60));
    assert!(found.area > 100);
}

#[test]
fn same_input_same_masks() {
    let run = || {
        let mut segmenter = Propagate::default();
        let scene = |k: usize| Scene { object: Some(drifting(k)), bar: Some(4.0 * k as f64), gripper: true };
        let (frame, mask) = render(&scene(0), 0);
        segmenter.start(&frame, &mask);
        (1..8).map(|k| step(&mut segmenter, &render(&scene(k), k).0, &Prior::default())).collect::<Vec<_>>()
    };
    assert_eq!(run(), run());
}

#[test]
fn given_masks_are_passed_on() {
    let (mut frame, mask) = render(&Scene { object: Some(drifting(0)), ..Scene::default() }, 0);
    let mut segmenter = GivenMasks;
    segmenter.start(&frame, &mask);
    assert_eq!(segmenter.next(&frame, &Prior::default()).area, 0);
    frame.mask = Some(mask.clone());
    let found = segmenter.next(&frame, &Prior::default());
    assert_eq!(found.mask, mask);
    assert_eq!(segmenter.refine(&frame, found, &Prior::default()).confidence, 1.0);
    // Masks of another size are resampled.
    frame.mask = Some(Image::filled(2, 2, 1));
    assert_eq!(segmenter.next(&frame, &Prior::default()).area, SIZE.0 * SIZE.1);
}
