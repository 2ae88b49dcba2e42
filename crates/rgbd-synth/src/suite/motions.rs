//! Paths of objects, cards and cameras. Times in frames, taken as 30 a second.

use crate::Motion;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use std::f64::consts::TAU;

/// Rises from 0 at `from` to 1 at `to` with smooth speed.
pub(super) fn ramp(time: f64, from: f64, to: f64) -> f64 {
    let t = ((time - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

fn wave(time: f64, period: f64, phase: f64) -> f64 {
    (TAU * time / period + phase).sin()
}

fn pose(place: [f64; 3], [tilt, turn, roll]: [f64; 3]) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), tilt)
        * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), roll)
        * UnitQuaternion::from_axis_angle(&Vector3::y_axis(), turn);
    Isometry3::from_parts(Translation3::from(place), rotation)
}

/// Shaken after a calm start: blurred by the shutter, but slow at the turning points.
pub(super) fn shaken() -> Motion {
    Motion::from_fn(|t| {
        let vigour = ramp(t, 6.0, 40.0);
        let place = [
            0.105 * vigour * wave(t, 27.0, 0.0),
            0.045 * vigour * wave(t, 19.0, 1.0),
            0.62 + 0.035 * vigour * wave(t, 33.0, 0.4),
        ];
        let angles = [
            0.25 + 0.30 * vigour * wave(t, 37.0, 0.3),
            0.4 + 0.014 * t + 0.62 * vigour * wave(t, 31.0, 0.0),
            0.22 * vigour * wave(t, 23.0, 2.0),
        ];
        pose(place, angles)
    })
}

/// Turned to and fro, so that what comes back into sight has been seen from nearby before.
pub(super) fn to_and_fro() -> Motion {
    Motion::from_fn(|t| {
        let place = [0.02 * wave(t, 88.0, 0.3), 0.012 * wave(t, 71.0, 1.1), 0.60 + 0.03 * wave(t, 97.0, 2.0)];
        let angles =
            [0.2 + 0.28 * wave(t, 120.0, 0.5), 0.5 + 1.2 * wave(t, 170.0, 0.0), 0.14 * wave(t, 101.0, 1.9)];
        pose(place, angles)
    })
}

/// A card that comes in from the right, stands before the object during `hidden`, and leaves to the left.
pub(super) fn curtain(hidden: [f64; 2]) -> Motion {
    const WAY: f64 = 16.0;
    Motion::from_fn(move |t| {
        let [from, to] = hidden;
        let x = 0.46 * (1.0 - ramp(t, from - WAY, from)) - 0.46 * ramp(t, to, to + WAY);
        pose([x + 0.008 * wave(t, 21.0, 0.0), 0.01, 0.40], [0.06, 0.1 * wave(t, 40.0, 0.0), 0.05])
    })
}

/// Something that swings before the object, coming into the image after frame 8.
pub(super) fn swing(place: [f64; 3], reach: f64, period: f64, phase: f64, lean: f64) -> Motion {
    Motion::from_fn(move |t| {
        let away = 0.45 * (1.0 - ramp(t, 4.0, 30.0)) * place[0].signum();
        let x = place[0] + away + reach * wave(t, period, phase);
        let y = place[1] + 0.25 * reach * wave(t, 0.7 * period, phase);
        pose([x, y, place[2]], [0.1, 0.3 * wave(t, 1.3 * period, phase), lean + 0.15 * wave(t, period, 1.0)])
    })
}

/// `cam_from_world` of a camera that goes once around the point `[0, -height, 0]` in `frames` frames, looking down
/// at it (y is down), as a walking person carries it.
pub(super) fn orbit(height: f64, frames: f64) -> Motion {
    Motion::from_fn(move |t| {
        let turn = TAU * t / frames + 0.05 * wave(t, 61.0, 0.0);
        let elevation = 0.46 + 0.20 * wave(t, 0.8 * frames, 0.3);
        let distance = 0.58 + 0.06 * wave(t, 0.55 * frames, 1.2);
        let eye = Point3::new(
            distance * elevation.cos() * turn.sin(),
            -height - distance * elevation.sin(),
            -distance * elevation.cos() * turn.cos(),
        );
        let target = Point3::new(0.025 * wave(t, 43.0, 0.0), -height + 0.02 * wave(t, 37.0, 1.0), 0.0);
        let rotation = UnitQuaternion::face_towards(&(target - eye), &Vector3::y());
        Isometry3::from_parts(Translation3::from(eye), rotation).inverse()
    })
}
