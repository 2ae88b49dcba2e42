//! The sensor's further faults have the size that their settings say.
#![allow(clippy::unwrap_used, missing_docs)]

use nalgebra::Isometry3;
use rgbd_io::Intrinsics;
use rgbd_synth::{
    Backdrop, Light, MaskFaults, Masks, Motion, Object, Plane, Sensor, Sequence, SequenceSpec, Shape, Texture,
};
use std::sync::Arc;

/// A wall of one colour, `z` metres ahead, fully lit.
fn wall(z: f64, level: f32, sensor: Sensor) -> Sequence {
    let ball = Object::from_shape(Shape::Sphere { radius: 0.05 }, Texture::plain([0.5; 3]), 0.01).unwrap();
    let plane = Plane { normal: [0.0, 0.0, -1.0], distance: z, texture: Texture::plain([level; 3]) };
    Sequence::new(SequenceSpec {
        name: "wall".into(),
        frames: 4,
        width: 160,
        height: 120,
        intrinsics: Intrinsics { fx: 300.0, fy: 300.0, cx: 79.5, cy: 59.5 },
        seed: 3,
        object: Arc::new(ball),
        motion: Motion::still(Isometry3::translation(0.0, 0.0, -1.0)),
        camera: None,
        occluders: vec![],
        backdrop: Backdrop { planes: vec![plane], furniture: vec![] },
        light: Light { ambient: 1.0, diffuse: 0.0, ..Light::default() },
        sensor,
        masks: Masks::None,
        mask_faults: MaskFaults::none(),
    })
    .unwrap()
}

/// Mean and standard deviation of the depth error, metres.
fn error(s: &Sequence) -> (f64, f64) {
    let f = s.render(2);
    let pairs = f.frame.depth.pixels().iter().zip(f.true_depth.pixels());
    let errors: Vec<f64> = pairs.filter(|(z, _)| **z > 0.0).map(|(a, b)| f64::from(a - b)).collect();
    let mean = errors.iter().sum::<f64>() / errors.len() as f64;
    (mean, (errors.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / errors.len() as f64).sqrt())
}

#[test]
fn photon_noise_grows_with_distance_and_falls_with_the_root_of_the_light() {
    let sensor = Sensor { depth_amplitude: 0.002, ..Sensor::perfect() };
    for (z, level) in [(0.5, 1.0), (1.0, 1.0), (1.0, 0.25)] {
        // Rays at the image's corners meet the wall at up to 18 degrees: 1 % of the mean.
        let expected = 0.002 * z / f64::from(level).sqrt();
        let (mean, std) = error(&wall(z, level, sensor));
        assert!((std / expected - 1.0).abs() < 0.05 && mean.abs() < 0.05 * std, "{std} {expected}");
    }
}

#[test]
fn the_wiggle_is_a_bias_of_the_distance() {
    let sensor = Sensor { wiggle: [0.003, 0.4], ..Sensor::perfect() };
    for (z, bias) in [(0.5, 0.003), (0.6, 0.0), (0.7, -0.003)] {
        let (mean, std) = error(&wall(z, 0.5, sensor));
        assert!((mean - bias).abs() < 1e-5 && std < 1e-5, "{z}: {mean}");
    }
}

#[test]
fn disparity_steps_grow_with_the_square_of_the_distance() {
    let sensor = Sensor { depth_base: 0.01, disparity_quantum: 0.00285, ..Sensor::perfect() };
    for z in [0.5f64, 1.0, 2.0] {
        let mut seen: Vec<f32> = wall(z, 0.5, sensor).render(0).frame.depth.into_pixels();
        seen.sort_by(f32::total_cmp);
        seen.dedup();
        // Neighbouring levels around the middle.
        let middle = seen.partition_point(|v| f64::from(*v) < z);
        let step = f64::from(seen[middle] - seen[middle - 1]);
        assert!((step / (0.00285 * z * z) - 1.0).abs() < 0.02, "{step}");
    }
}

#[test]
fn correlated_noise_has_its_deviation_and_is_shared_by_neighbours() {
    let sensor = Sensor { correlated: 0.004, correlation: 6.0, ..Sensor::perfect() };
    let s = wall(1.0, 0.5, sensor);
    let (mean, std) = error(&s);
    assert!((std / 0.004 - 1.0).abs() < 0.15 && mean.abs() < 0.001, "{mean} {std}");
    let z = s.render(2).frame.depth;
    let shared = |step: usize| {
        let products = (0..120).flat_map(|y| (0..160 - step).map(move |x| (x, y)));
        let products = products
            .map(|(x, y)| (f64::from(z[(x, y)]) - 1.0 - mean) * (f64::from(z[(x + step, y)]) - 1.0 - mean));
        products.sum::<f64>() / (120 * (160 - step)) as f64 / (std * std)
    };
    assert!(shared(1) > 0.85 && shared(3) > 0.3 && shared(15).abs() < 0.15);
    assert_ne!(z, s.render(3).frame.depth);
}

#[test]
fn glare_takes_the_depth_of_bright_surfaces_alone() {
    let sensor = Sensor { glare: 0.8, ..Sensor::perfect() };
    let missing = |level| {
        let f = wall(1.0, level, sensor).render(1);
        f.frame.depth.pixels().iter().filter(|z| **z == 0.0).count()
    };
    assert_eq!((missing(0.7), missing(0.9)), (0, 160 * 120));
}

#[test]
fn the_ready_made_sensors_differ_as_their_kinds_do() {
    let (light, time, poor) =
        (Sensor::structured_light(), Sensor::time_of_flight(), Sensor::poor_structured_light());
    // Triangulation loses to time of flight at a distance.
    assert!(light.depth_sigma(3.0, 1.0) > 2.0 * time.depth_sigma(3.0, 1.0));
    assert!(poor.depth_sigma(0.6, 1.0) > 2.0 * light.depth_sigma(0.6, 1.0));
    assert!(time.flying > light.flying && time.hole_share < light.hole_share);
    let (_, dark) = error(&wall(0.8, 0.1, time));
    let (_, bright) = error(&wall(0.8, 0.9, time));
    assert!(dark > 1.5 * bright, "{dark} {bright}");
}
