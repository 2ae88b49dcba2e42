//! Where the object will be in the next frame.

use nalgebra::Isometry3;
use se3_lie::se3;

/// Constant-velocity prediction of the camera's motion relative to the object.
#[derive(Debug, Default)]
pub(super) struct Motion {
    /// Frame index and `obj_from_cam` of the last two tracked frames, newest last.
    pub(super) history: [Option<(usize, Isometry3<f64>)>; 2],
}

impl Motion {
    /// Longest gap that velocity is carried over (frames).
    const MAX_GAP: usize = 3;
    /// Share of the last velocity that is expected to go on: hands slow down as often as they speed up.
    const PERSISTENCE: f64 = 0.8;

    /// Adds the pose of a tracked frame.
    pub(super) fn observe(&mut self, index: usize, obj_from_cam: &Isometry3<f64>) {
        self.history = [self.history[1], Some((index, *obj_from_cam))];
    }

    /// Forgets the velocity, after a loss.
    pub(super) fn forget(&mut self) {
        self.history[0] = None;
    }

    /// Moves the history with the object frame's correction.
    pub(super) fn carry(&mut self, correct: impl Fn(&Isometry3<f64>) -> Isometry3<f64>) {
        for (_, pose) in self.history.iter_mut().flatten() {
            *pose = correct(pose);
        }
    }

    /// `obj_from_cam` expected at frame `index`; `None` without two recent poses.
    pub(super) fn predict(&self, index: usize) -> Option<Isometry3<f64>> {
        let [Some((i0, old)), Some((i1, new))] = self.history else { return None };
        let (span, ahead) = (i1 - i0, index.saturating_sub(i1));
        if span == 0 || span > Self::MAX_GAP || ahead > Self::MAX_GAP {
            return None;
        }
        let step = se3::log(&(new.inverse() * old)) * (Self::PERSISTENCE * ahead as f64 / span as f64);
        Some(new * se3::exp(&(-step)))
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;

    #[test]
    fn a_steady_motion_is_continued_and_a_gap_is_not() {
        let pose = |t: f64| {
            let rotation = UnitQuaternion::from_scaled_axis(Vector3::y() * 0.05 * t);
            Isometry3::from_parts(Vector3::new(0.01 * t, 0.0, 0.0).into(), rotation)
        };
        let mut motion = Motion::default();
        assert!(motion.predict(0).is_none());
        motion.observe(3, &pose(3.0));
        motion.observe(4, &pose(4.0));
        let predicted = motion.predict(5).unwrap();
        let (still, full) = (pose(4.0), pose(5.0));
        let error = |p: &Isometry3<f64>| se3::log(&p.inv_mul(&full)).norm();
        assert!(error(&predicted) < 0.3 * error(&still));
        assert!(motion.predict(20).is_none());
        motion.forget();
        assert!(motion.predict(5).is_none());
    }
}
