//! Poses over time.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use std::fmt;
use std::sync::Arc;

/// A smooth motion: the pose `cam_from_body` for every time, counted in frames (fractions are used for blur).
#[derive(Clone)]
pub struct Motion(Arc<dyn Fn(f64) -> Isometry3<f64> + Send + Sync>);

impl fmt::Debug for Motion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Motion").field(&self.at(0.0)).finish()
    }
}

/// A body turned in front of the camera: steady turn about its own y axis, swinging tilt and roll, and sway.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tumble {
    /// Mean place of the body's origin in the camera frame, metres.
    pub center: [f64; 3],
    /// Amplitude of the sway along the camera's axes, metres.
    pub sway: [f64; 3],
    /// Turn at frame 0, radians.
    pub start: f64,
    /// Turn per frame, radians.
    pub turn: f64,
    /// Amplitude of the tilt towards the camera, radians.
    pub tilt: f64,
    /// Amplitude of the roll about the viewing direction, radians.
    pub roll: f64,
    /// Frames in which the tilt swings once; the other swings have periods near it.
    pub period: f64,
}

impl Motion {
    /// A motion from any function of the frame time.
    pub fn from_fn(f: impl Fn(f64) -> Isometry3<f64> + Send + Sync + 'static) -> Self {
        Self(Arc::new(f))
    }

    /// No motion.
    pub fn still(cam_from_body: Isometry3<f64>) -> Self {
        Self::from_fn(move |_| cam_from_body)
    }

    /// See [`Tumble`].
    pub fn tumble(t: Tumble) -> Self {
        Self::from_fn(move |time| {
            let swing = |period: f64, phase: f64| (std::f64::consts::TAU * time / period + phase).sin();
            let p = t.period.max(1e-6);
            let turn = t.start + t.turn * (time + 0.03 * p * swing(0.6 * p, 0.0));
            let rotation = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), t.tilt * swing(p, 0.4))
                * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), t.roll * swing(0.83 * p, 1.9))
                * UnitQuaternion::from_axis_angle(&Vector3::y_axis(), turn);
            let shift = [swing(0.8 * p, 0.2), swing(0.65 * p, 2.5), swing(1.1 * p, 4.0)];
            let place = std::array::from_fn::<f64, 3, _>(|k| t.center[k] + t.sway[k] * shift[k]);
            Isometry3::from_parts(Translation3::from(place), rotation)
        })
    }

    /// Passes through `poses` at the times `0, step, 2 step, ...` with smooth speed (Hermite blend of the place and
    /// eased spherical interpolation of the rotation), standing still before the first and after the last.
    pub fn through(poses: Vec<Isometry3<f64>>, step: f64) -> Self {
        Self::from_fn(move |time| {
            let Some(&last) = poses.last() else { return Isometry3::identity() };
            let s = (time / step.max(1e-9)).max(0.0);
            let i = s.floor() as usize;
            let (Some(&a), Some(&b)) = (poses.get(i), poses.get(i.saturating_add(1))) else { return last };
            let t = s - s.floor();
            let t = t * t * (3.0 - 2.0 * t);
            // Half a turn has no unique shortest way: stay until the next pose then.
            let rotation = a.rotation.try_slerp(&b.rotation, t, 1e-9).unwrap_or(a.rotation);
            let place = a.translation.vector.lerp(&b.translation.vector, t);
            Isometry3::from_parts(Translation3::from(place), rotation)
        })
    }

    /// The pose `cam_from_body` at `time` (frames).
    pub fn at(&self, time: f64) -> Isometry3<f64> {
        (self.0)(time)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn through_hits_its_poses_and_rests_at_the_ends() {
        let a = Isometry3::translation(0.0, 0.0, 0.5);
        let b = Isometry3::new(Vector3::new(0.1, 0.0, 0.6), Vector3::new(0.0, 0.7, 0.0));
        let m = Motion::through(vec![a, b], 10.0);
        for (time, pose) in [(-5.0, a), (0.0, a), (10.0, b), (99.0, b)] {
            assert!((m.at(time).to_homogeneous() - pose.to_homogeneous()).norm() < 1e-12);
        }
        assert!((m.at(5.0).rotation.angle() - 0.35).abs() < 1e-9);
        assert_eq!(Motion::through(vec![], 1.0).at(3.0), Isometry3::identity());
    }
}
