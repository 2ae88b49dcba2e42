//! The suite's sequences.

use super::motions::{curtain, orbit, shaken, swing, to_and_fro};
use super::objects;
use crate::motion::Tumble;
use crate::presets::{block, rod, room, scaled_room, skin, sleeve, wall, wood};
use crate::{
    Backdrop, Grip, Hand, Light, MaskFaults, Masks, Motion, Object, Occluder, Plane, Sensor, SequenceSpec,
};
use nalgebra::Isometry3;
use rgbd_io::Intrinsics;
use std::sync::Arc;

/// Frames between which the curtain of "total-occlusion" stands still.
const HIDDEN: [f64; 2] = [92.0, 148.0];

/// An object in a hand before a structured-light camera in a room; the scenes change what they need.
fn held(object: Arc<Object>, motion: Motion, frames: usize, seed: u64, grip: Grip) -> SequenceSpec {
    SequenceSpec {
        name: String::new(),
        frames,
        width: 640,
        height: 480,
        intrinsics: Intrinsics { fx: 608.0, fy: 607.0, cx: 321.4, cy: 237.9 },
        seed,
        object,
        motion,
        camera: None,
        occluders: vec![Occluder::Hand(Box::new(Hand::new(grip, skin(), sleeve())))],
        backdrop: room(),
        light: Light::default(),
        sensor: Sensor::structured_light(),
        masks: Masks::Every,
        mask_faults: MaskFaults::none(),
    }
}

/// Turned by `turn` degrees a frame and tilted to and fro, `distance` metres away.
fn turning(distance: f64, start: f64, turn: f64) -> Tumble {
    Tumble {
        center: [-0.005, 0.0, distance],
        sway: [0.030, 0.018, 0.035],
        start,
        turn: turn.to_radians(),
        tilt: 24f64.to_radians(),
        roll: 12f64.to_radians(),
        period: 96.0,
    }
}

fn right() -> Grip {
    Grip { reach: -0.016, lift: 0.5, period: 41.0, ..Grip::default() }
}

fn left() -> Grip {
    Grip { side: 2.45, shift: -0.008, period: 45.0, ..right() }
}

pub(super) fn texture_less() -> SequenceSpec {
    held(objects::head(), Motion::tumble(turning(0.58, 0.2, 1.6)), 240, 101, right())
}

pub(super) fn symmetric() -> SequenceSpec {
    let motion = Motion::tumble(Tumble { tilt: 0.5, roll: 0.4, ..turning(0.56, 0.0, 1.5) });
    let sensor = Sensor::time_of_flight();
    SequenceSpec { sensor, ..held(objects::can(), motion, 220, 102, left()) }
}

pub(super) fn thin_structure() -> SequenceSpec {
    let grip = Grip { shift: 0.055, reach: -0.02, lift: 0.2, ..right() };
    let motion = Tumble { tilt: 0.22, roll: 0.16, ..turning(0.52, 0.3, 1.5) };
    held(objects::lantern(), Motion::tumble(motion), 220, 103, grip)
}

pub(super) fn specular() -> SequenceSpec {
    let sensor = Sensor { glare: 0.92, ..Sensor::structured_light() };
    SequenceSpec {
        sensor,
        ..held(objects::flask(), Motion::tumble(turning(0.57, 0.4, 1.5)), 220, 104, left())
    }
}

pub(super) fn fast_motion() -> SequenceSpec {
    let sensor = Sensor { exposure: 0.6, ..Sensor::time_of_flight() };
    SequenceSpec { sensor, ..held(objects::carton(), shaken(), 200, 105, right()) }
}

pub(super) fn partial_occlusion() -> SequenceSpec {
    let spec = held(objects::mug(), Motion::tumble(turning(0.60, 0.6, 1.5)), 240, 106, right());
    let rod = Arc::new(rod());
    let rigid = |object: &Arc<Object>, motion| Occluder::Rigid { object: object.clone(), motion };
    // A rod reaches along its z axis: upright, from below the image to above it.
    let upright = |motion: Motion| {
        let up = Isometry3::rotation(nalgebra::Vector3::x() * std::f64::consts::FRAC_PI_2)
            * Isometry3::translation(0.0, 0.0, -0.3);
        Motion::from_fn(move |t| motion.at(t) * up)
    };
    let mut occluders = spec.occluders.clone();
    occluders.push(rigid(&rod, upright(swing([-0.045, 0.0, 0.45], 0.075, 62.0, 0.0, 0.2))));
    occluders.push(rigid(&rod, upright(swing([0.05, 0.0, 0.42], 0.080, 79.0, 2.1, -0.3))));
    let card = objects::card([0.021, 0.034, 0.001_5], 61);
    occluders.push(rigid(&card, swing([-0.035, 0.01, 0.43], 0.055, 97.0, 4.0, 0.1)));
    SequenceSpec { occluders, ..spec }
}

pub(super) fn total_occlusion() -> SequenceSpec {
    let mut spec = held(objects::robot(), to_and_fro(), 260, 107, Grip { reach: -0.025, ..left() });
    let object = objects::card([0.17, 0.145, 0.002], 62);
    spec.occluders.push(Occluder::Rigid { object, motion: curtain(HIDDEN) });
    SequenceSpec { sensor: Sensor::time_of_flight(), ..spec }
}

pub(super) fn noisy_masks() -> SequenceSpec {
    let motion = Motion::tumble(turning(0.60, 0.5, 1.6));
    SequenceSpec { mask_faults: MaskFaults::severe(), ..held(objects::drill(), motion, 240, 108, left()) }
}

pub(super) fn depth_noise() -> SequenceSpec {
    let motion = Motion::tumble(turning(0.66, 0.9, 1.4));
    let sensor = Sensor { brightness_swing: 0.2, ..Sensor::poor_structured_light() };
    SequenceSpec { sensor, ..held(crate::jug(), motion, 240, 109, right()) }
}

pub(super) fn small_far() -> SequenceSpec {
    let motion = Tumble { sway: [0.06, 0.04, 0.08], tilt: 0.5, ..turning(1.15, 0.4, 1.4) };
    let grip = Grip { shift: 0.0, reach: -0.045, lift: 0.3, ..right() };
    let spec = held(objects::car(), Motion::tumble(motion), 220, 110, grip);
    SequenceSpec { backdrop: scaled_room(2.0), ..spec }
}

pub(super) fn large_near() -> SequenceSpec {
    let motion = Tumble {
        center: [0.0, 0.012, 0.46],
        sway: [0.03, 0.012, 0.035],
        tilt: 0.28,
        roll: 0.16,
        ..turning(0.46, 2.2, 1.3)
    };
    let spec = held(objects::kettle(), Motion::tumble(motion), 220, 111, Grip { lift: 0.3, ..right() });
    SequenceSpec { sensor: Sensor::time_of_flight(), ..spec }
}

pub(super) fn in_hand_turn() -> SequenceSpec {
    let motion = Tumble { tilt: 0.30, roll: 0.15, period: 130.0, ..turning(0.58, 0.0, 1.25) };
    held(objects::bottle(), Motion::tumble(motion), 300, 112, right())
}

pub(super) fn moving_camera() -> SequenceSpec {
    let object = objects::teapot();
    // It stands on the table, which is the plane y = 0.
    let foot = object.mesh().bounds().map_or(0.0, |(_, high)| f64::from(high[1]));
    let motion = Motion::still(Isometry3::translation(0.0, -foot, 0.0));
    SequenceSpec {
        camera: Some(orbit(0.06, 260.0)),
        occluders: Vec::new(),
        backdrop: four_walls(),
        light: Light { direction: [-0.35, -0.85, -0.30], ..Light::default() },
        sensor: Sensor::time_of_flight(),
        ..held(object, motion, 260, 113, right())
    }
}

/// A room around the origin, closed but for the ceiling, with things on its table.
fn four_walls() -> Backdrop {
    let side =
        |normal: [f64; 3], distance, seed, a, b| Plane { normal, distance, texture: wall(seed, a, b, 1.0) };
    Backdrop {
        planes: vec![
            Plane { normal: [0.0, -1.0, 0.0], distance: 0.0, texture: wood() },
            side([0.0, 0.0, -1.0], 1.7, 71, [0.62, 0.63, 0.60], [0.72, 0.72, 0.67]),
            side([0.0, 0.0, 1.0], 2.0, 72, [0.60, 0.56, 0.50], [0.70, 0.66, 0.58]),
            side([-1.0, 0.0, 0.0], 1.8, 73, [0.55, 0.60, 0.64], [0.66, 0.69, 0.70]),
            side([1.0, 0.0, 0.0], 1.6, 74, [0.56, 0.62, 0.54], [0.68, 0.72, 0.62]),
        ],
        furniture: vec![
            block([0.10, 0.13, 0.05], [-0.55, -0.13, 0.85], 0.4, [0.52, 0.22, 0.20], 41, 1.0),
            block([0.06, 0.09, 0.06], [0.95, -0.09, 0.30], -0.5, [0.26, 0.42, 0.30], 42, 1.0),
            block([0.13, 0.05, 0.09], [0.30, -0.05, -0.95], 0.7, [0.72, 0.66, 0.42], 43, 1.0),
            block([0.08, 0.11, 0.05], [-0.95, -0.11, -0.35], 1.1, [0.30, 0.28, 0.50], 44, 1.0),
            block([0.07, 0.010, 0.05], [0.20, -0.010, 0.10], 0.5, [0.60, 0.34, 0.20], 45, 1.0),
            block([0.05, 0.012, 0.07], [-0.17, -0.012, -0.12], -0.3, [0.24, 0.40, 0.48], 46, 1.0),
        ],
    }
}
