//! Every sequence of the suite has the property that it is named after.
#![allow(clippy::unwrap_used, missing_docs)]

use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use rgbd_io::Mask;
use rgbd_synth::{Gloss, Object, Sensor, Sequence, SequenceSpec};
use std::sync::Arc;

fn named(name: &str) -> Sequence {
    Sequence::named(name).unwrap()
}

/// The same scene at a quarter of the resolution.
fn quarter(sequence: &Sequence) -> Sequence {
    let spec = sequence.spec().clone();
    let intrinsics = spec.intrinsics.scaled(0.25, 0.25);
    Sequence::new(SequenceSpec { width: 160, height: 120, intrinsics, ..spec }).unwrap()
}

fn count(mask: &Mask) -> usize {
    mask.pixels().iter().filter(|m| **m != 0).count()
}

fn degrees(a: &Isometry3<f64>, b: &Isometry3<f64>) -> f64 {
    a.rotation.angle_to(&b.rotation).to_degrees()
}

/// Largest turn (degrees), largest shift (metres) between neighbouring frames.
fn fastest(s: &Sequence) -> (f64, f64) {
    (1..s.len()).fold((0.0, 0.0), |(turn, shift), i| {
        let (a, b) = (s.cam_from_obj(i - 1), s.cam_from_obj(i));
        (degrees(&a, &b).max(turn), (a.translation.vector - b.translation.vector).norm().max(shift))
    })
}

#[test]
fn the_suite_is_as_the_readme_says() {
    let readme = include_str!("../README.md");
    let mut total = 0;
    for name in Sequence::suite() {
        let s = named(name);
        let row = format!("| `{name}` | {} | {} |", s.len(), Sequence::stresses(name).unwrap());
        assert!(readme.contains(&row), "the README lacks: {row}");
        assert_eq!(s.name(), name);
        assert!((200..=600).contains(&s.len()));
        assert_eq!((s.spec().width, s.spec().height), (640, 480));
        total += s.len();
    }
    assert_eq!(Sequence::suite().len(), 13);
    assert!(total <= 3400, "{total}");
    assert_eq!(named("in_hand_turn").name(), "in-hand-turn");
    assert!(Sequence::named("no-such-thing").is_none() && Sequence::stresses("").is_none());
}

#[test]
fn every_object_is_closed_and_starts_inside_the_image() {
    for s in Sequence::suite().map(named) {
        let mesh = s.mesh();
        assert!(mesh.is_watertight() && mesh.signed_volume() > 0.0, "{}", s.name());
        let pose = s.cam_from_obj(0);
        for v in &mesh.vertices {
            let p = pose * Point3::from(v.map(f64::from));
            let [x, y] = s.intrinsics().project(p.coords.into()).unwrap();
            assert!((4.0..636.0).contains(&x) && (4.0..476.0).contains(&y), "{} at {x} {y}", s.name());
        }
        // Nothing but the hand that holds it hides any of it at first.
        let hidden = s.occlusion(0);
        assert!(hidden <= 0.25, "{}: {hidden} hidden", s.name());
        let occluders = s.spec().occluders.iter().take(1).cloned().collect();
        let held = Sequence::new(SequenceSpec { occluders, ..s.spec().clone() }).unwrap();
        assert_eq!(held.occlusion(0), hidden, "{}", s.name());
    }
}

#[test]
fn speeds_are_those_of_hands_except_when_shaken() {
    for s in Sequence::suite().map(named) {
        let (turn, shift) = fastest(&s);
        if s.name() == "fast-motion" {
            assert!((8.0..12.0).contains(&turn) && (0.025..0.045).contains(&shift), "{turn} {shift}");
            assert!(s.spec().sensor.exposure > 0.3);
        } else {
            assert!(turn <= 3.5 && shift <= 0.010, "{}: {turn} degrees, {shift} m", s.name());
        }
        let path: f64 = (1..s.len()).map(|i| degrees(&s.cam_from_obj(i - 1), &s.cam_from_obj(i))).sum();
        assert!(path > 300.0, "{}: {path} degrees", s.name());
    }
}

#[test]
fn the_mask_alone_is_that_of_the_rendered_frame() {
    for (name, index) in [("moving-camera", 0), ("moving-camera", 130), ("partial-occlusion", 60)] {
        let s = quarter(&named(name));
        let mask = s.visible_mask(index);
        assert!(count(&mask) > 50);
        assert_eq!(mask, s.render(index).visible_mask);
    }
}

#[test]
fn texture_less_and_symmetric_have_one_colour_and_symmetric_can_be_turned() {
    for name in ["texture-less", "symmetric"] {
        let s = named(name);
        assert!(s.mesh().colors.iter().all(|c| *c == s.mesh().colors[0]), "{name}");
    }
    let off_axis = |s: &Sequence| {
        let shape = s.spec().object.shape().unwrap();
        let moved = s.mesh().vertices.iter().step_by(23).map(|v| {
            let turned = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), 0.9) * Point3::from(*v);
            (shape.distance(turned.coords.into()) - shape.distance(*v)).abs()
        });
        moved.fold(0.0, f32::max)
    };
    assert!(off_axis(&named("symmetric")) < 1e-6);
    assert!(off_axis(&named("texture-less")) > 0.01);
}

#[test]
fn thin_structure_is_thin_and_the_others_are_not() {
    let thin = |name: &str| {
        let s = named(name);
        let shape = s.spec().object.shape().unwrap();
        let (mesh, mut thin) = (s.mesh(), 0);
        for (v, n) in mesh.vertices.iter().zip(&mesh.normals) {
            // Six millimetres below the surface is air again.
            thin += usize::from(shape.distance(std::array::from_fn(|k| v[k] - 0.006 * n[k])) > 0.0);
        }
        thin as f64 / mesh.vertices.len() as f64
    };
    let share = thin("thin-structure");
    assert!(share > 0.3, "{share}");
    assert!(thin("in-hand-turn") < 0.05);
}

#[test]
fn specular_glares_and_loses_depth_there() {
    let s = quarter(&named("specular"));
    let dull = Gloss { strength: 0.0, exponent: 1, mirror: 0.0 };
    let object: Object = (*s.spec().object).clone().with_gloss(dull);
    let matt = Sequence::new(SequenceSpec { object: Arc::new(object), ..s.spec().clone() }).unwrap();
    let (mut brighter, mut lost, mut kept) = (0, 0, 0);
    for index in [20, 36, 110] {
        let (a, b) = (s.render(index), matt.render(index));
        assert_eq!(a.visible_mask, b.visible_mask);
        for (i, m) in a.visible_mask.pixels().iter().enumerate().filter(|(_, m)| **m != 0) {
            assert_eq!(*m, 255);
            let level =
                |f: &rgbd_synth::SynthFrame| f.frame.color.pixels()[i].map(i32::from).iter().sum::<i32>();
            brighter += usize::from(level(&a) > level(&b) + 150);
            lost += usize::from(a.frame.depth.pixels()[i] == 0.0 && b.frame.depth.pixels()[i] > 0.0);
            kept += usize::from(a.frame.depth.pixels()[i] > 0.0);
        }
    }
    assert!(brighter > 30 && lost > 10 && kept > 10 * lost, "{brighter} {lost} {kept}");
}

#[test]
fn partial_occlusion_hides_much_but_never_all() {
    let s = named("partial-occlusion");
    let hidden: Vec<f64> = (30..s.len()).step_by(9).map(|i| s.occlusion(i)).collect();
    let mean = hidden.iter().sum::<f64>() / hidden.len() as f64;
    assert!((0.35..0.6).contains(&mean), "{mean}");
    assert!(hidden.iter().all(|h| *h < 0.85), "{hidden:?}");
}

#[test]
fn total_occlusion_hides_everything_and_shows_a_known_side_again() {
    let s = quarter(&named("total-occlusion"));
    let hidden: Vec<usize> = (0..s.len()).filter(|i| count(&s.visible_mask(*i)) == 0).collect();
    let (first, last) = (hidden[0], hidden[hidden.len() - 1]);
    assert_eq!(last - first + 1, hidden.len(), "in one piece");
    assert!((40..=80).contains(&hidden.len()), "{}", hidden.len());
    assert!(count(&s.visible_mask(first - 12)) > 200 && count(&s.visible_mask(last + 18)) > 200);
    let back = s.cam_from_obj(last + 1);
    let turned = degrees(&s.cam_from_obj(first - 1), &back);
    assert!((20.0..60.0).contains(&turned), "{turned}");
    // Surfaces seen before and after overlap: the nearest view is less than a quarter turn away.
    let nearest = (0..first).map(|i| degrees(&s.cam_from_obj(i), &back)).fold(f64::MAX, f64::min);
    assert!((10.0..45.0).contains(&nearest), "{nearest}");
}

#[test]
fn variants_are_other_videos_of_the_same_thing() {
    for name in ["symmetric", "total-occlusion", "moving-camera"] {
        let variants: Vec<_> = (0..4).map(|v| quarter(&Sequence::variant(name, v).unwrap())).collect();
        let suite = quarter(&named(name)).render(0);
        assert_eq!(suite.frame.color, variants[0].render(0).frame.color);
        for (a, b) in [(0, 1), (1, 2), (2, 3), (0, 3)] {
            let [a, b] = [a, b].map(|k: usize| &variants[k]);
            assert_ne!(a.render(0).frame.color, b.render(0).frame.color, "{name}");
            assert_ne!(a.mesh().colors, b.mesh().colors, "{name}");
            assert_eq!(a.mesh().vertices, b.mesh().vertices);
            assert_eq!(a.len(), b.len());
        }
        for s in &variants[1..] {
            assert!(count(&s.visible_mask(0)) > 200, "{name}");
            assert!(s.occlusion(0) < 0.5, "{name}: {}", s.occlusion(0));
        }
        let again = quarter(&Sequence::variant(name, 2).unwrap());
        assert_eq!(again.render(40).frame.color, variants[2].render(40).frame.color);
    }
    assert!(Sequence::variant("no-such-thing", 1).is_none());
}

#[test]
fn a_card_hides_everything_while_it_should() {
    // Near, far, and with a camera that moves.
    for name in ["large-near", "small-far", "moving-camera"] {
        let s = quarter(&named(name)).hidden_between(20.0, 26.0);
        let seen: Vec<usize> = (0..44).map(|i| count(&s.visible_mask(i))).collect();
        assert!(seen[20..=26].iter().all(|n| *n == 0), "{name}: {seen:?}");
        let before = count(&quarter(&named(name)).visible_mask(2));
        assert!(seen[2] == before && seen[43] * 2 > before, "{name}: {seen:?}");
    }
}

#[test]
fn noisy_masks_are_wrong_by_the_stated_amount() {
    let s = named("noisy-masks");
    let (mut sum, mut frames, mut extra, mut lost) = (0.0, 0.0, 0, 0);
    for index in (0..s.len()).step_by(13) {
        let f = s.render(index);
        let (given, truth) = (f.frame.mask.unwrap(), f.visible_mask);
        if index == 0 {
            assert_eq!(given, truth);
            continue;
        }
        let pairs = || given.pixels().iter().zip(truth.pixels());
        let both = pairs().filter(|(a, b)| **a != 0 && **b != 0).count();
        let either = pairs().filter(|(a, b)| **a != 0 || **b != 0).count();
        extra += count(&given) - both;
        lost += count(&truth) - both;
        sum += both as f64 / either as f64;
        frames += 1.0;
    }
    let mean = sum / frames;
    assert!((0.70..0.90).contains(&mean), "J {mean}");
    assert!(extra > 5000 && lost > 5000, "{extra} {lost}");
    let small = quarter(&s).with_sensor(Sensor::perfect());
    let empty = (0..s.len()).filter(|i| count(&small.render(*i).frame.mask.unwrap()) == 0).count();
    assert!((3..20).contains(&empty), "{empty} empty masks");
}

/// Depth errors on the object away from its outline, by place; and the share of its depth that is missing.
fn errors(s: &Sequence, index: usize) -> (Vec<Option<f64>>, f64) {
    let f = s.render(index);
    let (mut missing, mut all) = (0, 0);
    let mut out = vec![None; 640 * 480];
    for y in 4..476 {
        for x in 4..636 {
            let inner = (0..81).all(|i| f.visible_mask[(x + i % 9 - 4, y + i / 9 - 4)] != 0);
            if inner {
                let (z, truth) = (f.frame.depth[(x, y)], f.true_depth[(x, y)]);
                all += 1;
                missing += usize::from(z == 0.0);
                let error = f64::from(z - truth);
                out[y * 640 + x] = (z > 0.0 && error.abs() < 0.03).then_some(error);
            }
        }
    }
    assert!(all > 3000);
    (out, f64::from(missing as u32) / f64::from(all))
}

#[test]
fn depth_noise_is_large_correlated_and_full_of_holes() {
    let poor = named("depth-noise");
    let usual = poor.with_sensor(Sensor::structured_light());
    let measure = |s: &Sequence| {
        let (errors, missing) = errors(s, 60);
        let known: Vec<f64> = errors.iter().flatten().copied().collect();
        let power = known.iter().map(|e| e * e).sum::<f64>() / known.len() as f64;
        let pairs: Vec<f64> = errors.windows(4).filter_map(|w| Some(w[0]? * w[3]?)).collect();
        let shared = pairs.iter().sum::<f64>() / pairs.len() as f64 / power;
        (power.sqrt(), shared, missing)
    };
    let (a, b) = (measure(&poor), measure(&usual));
    assert!(a.0 > 2.2 * b.0, "{a:?} {b:?}");
    assert!(a.1 > 0.2 && a.1 > b.1 + 0.15, "{a:?} {b:?}");
    assert!((0.12..0.35).contains(&a.2) && b.2 < 0.06, "{a:?} {b:?}");
}

#[test]
fn small_far_is_small_and_large_near_is_large() {
    for (name, range) in [("small-far", 400..1500), ("large-near", 40_000..90_000)] {
        let s = named(name);
        for index in (0..s.len()).step_by(20) {
            let area = count(&s.visible_mask(index));
            assert!(range.contains(&area), "{name} {index}: {area}");
        }
    }
    let distance = |name| named(name).cam_from_obj(0).translation.z;
    assert!(distance("small-far") > 1.0 && distance("large-near") < 0.5);
}

#[test]
fn in_hand_turn_shows_all_sides_and_comes_back() {
    let s = named("in-hand-turn");
    let mut sides = [false; 24];
    for i in 0..s.len() {
        let eye = s.cam_from_obj(i).inverse() * Point3::origin();
        let around = eye.z.atan2(eye.x).rem_euclid(std::f64::consts::TAU);
        sides[(around / std::f64::consts::TAU * 24.0) as usize % 24] = true;
    }
    assert_eq!(sides, [true; 24]);
    let closest = (240..s.len()).map(|i| degrees(&s.cam_from_obj(0), &s.cam_from_obj(i)));
    let closest = closest.fold(f64::MAX, f64::min);
    assert!(closest < 25.0, "{closest}");
    let furthest = (0..s.len()).map(|i| degrees(&s.cam_from_obj(0), &s.cam_from_obj(i))).fold(0.0, f64::max);
    assert!(furthest > 165.0, "{furthest}");
}

#[test]
fn moving_camera_goes_around_a_world_that_stands_still() {
    let s = quarter(&named("moving-camera")).with_sensor(Sensor::perfect());
    let world_from_obj = |i: usize| s.cam_from_world(i).inverse() * s.cam_from_obj(i);
    let turned: f64 = (1..s.len()).map(|i| degrees(&s.cam_from_world(i - 1), &s.cam_from_world(i))).sum();
    assert!(turned > 330.0, "{turned}");
    for i in (0..s.len()).step_by(20) {
        let moved = world_from_obj(i).to_homogeneous() - world_from_obj(0).to_homogeneous();
        assert!(moved.norm() < 1e-12);
    }
    // What is seen of the surroundings in one frame is where another frame sees it.
    let k = s.intrinsics();
    let (a, b) = (s.render(40), s.render(48));
    let b_from_a = s.cam_from_world(48) * s.cam_from_world(40).inverse();
    let (mut compared, mut agreed, mut alike) = (0, 0, 0);
    for y in 0..120 {
        for x in 0..160 {
            let z = f64::from(a.true_depth[(x, y)]);
            if z == 0.0 || a.visible_mask[(x, y)] != 0 {
                continue;
            }
            let p = b_from_a * Point3::from(k.unproject(x as f64, y as f64, z));
            let Some([u, v]) = k.project(p.coords.into()) else { continue };
            let (u, v) = (u.round(), v.round());
            if !(0.0..160.0).contains(&u) || !(0.0..120.0).contains(&v) {
                continue;
            }
            let to = (u as usize, v as usize);
            compared += 1;
            agreed += usize::from((f64::from(b.true_depth[to]) / p.z - 1.0).abs() < 0.03);
            let (c, d) = (a.frame.color[(x, y)], b.frame.color[to]);
            alike += usize::from((0..3).all(|k| c[k].abs_diff(d[k]) < 30));
        }
    }
    assert!(compared > 8000, "{compared}");
    assert!(agreed * 100 > compared * 90 && alike * 100 > compared * 80, "{agreed} {alike} of {compared}");
}

#[test]
fn a_name_means_the_same_bits_every_time() {
    for name in ["fast-motion", "depth-noise", "noisy-masks"] {
        let a = quarter(&named(name)).render(33);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let b = pool.install(|| quarter(&named(name)).render(33));
        assert_eq!((a.frame.color, a.frame.depth), (b.frame.color, b.frame.depth));
        assert_eq!(a.frame.mask, b.frame.mask);
        let other = quarter(&named(name).with_seed(5)).render(33);
        assert_ne!(b.visible_mask.pixels().len(), 0);
        assert!(other.frame.mask != b.frame.mask || name != "noisy-masks");
        assert_eq!(other.true_depth, b.true_depth);
    }
}

#[test]
fn blur_follows_the_speed() {
    let s = quarter(&named("fast-motion"));
    let sharp = s.with_sensor(Sensor { exposure: 0.0, ..s.spec().sensor });
    // Frame 0 rests; the fastest frame of the first hundred is smeared.
    let speed = |i: usize| {
        (s.cam_from_obj(i + 1).translation.vector - s.cam_from_obj(i - 1).translation.vector).norm()
    };
    let fast = (20..100).max_by(|a, b| speed(*a).total_cmp(&speed(*b))).unwrap();
    let change = |i: usize| {
        let (a, b) = (s.render(i).frame.color, sharp.render(i).frame.color);
        let differences = a.pixels().iter().zip(b.pixels()).map(|(a, b)| u64::from(a[1].abs_diff(b[1])));
        differences.sum::<u64>()
    };
    let (rest, moving) = (change(0), change(fast));
    assert!(moving > 10 * (rest + 1000), "{rest} {moving}");
}
