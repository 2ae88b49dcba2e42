//! What [`Propagate`] remembers between two frames, as bytes: a run that was cut off goes on as if it had not been.

use nalgebra::{Isometry3, Quaternion, Translation3, Unit, Vector3};
use serde::{Deserialize, Serialize};

use crate::Propagate;
use crate::appearance::Appearance;
use crate::memory::Memory;
use crate::volume::Volume;
use crate::warp::Sample;

#[derive(Serialize, Deserialize)]
struct Saved {
    appearance: Appearance,
    memory: Option<SavedMemory>,
}

#[derive(Serialize, Deserialize)]
struct SavedMemory {
    samples: Vec<Sample>,
    step: usize,
    volume: Option<Volume>,
    cam_from_obj: Option<[f64; 7]>,
    velocity: [f32; 3],
    missing: u32,
    fresh: bool,
}

impl Propagate {
    pub(crate) fn saved(&mut self) -> Option<Vec<u8>> {
        // A frame that was looked for and never refined is learnt by the next one; learning it now is the same.
        self.commit(None);
        let memory = self.memory.as_ref().map(|memory| {
            // Every field is named: one that is added has to be saved too.
            let Memory { samples, step, volume, cam_from_obj, velocity, missing, fresh } = memory;
            SavedMemory {
                samples: samples.clone(),
                step: *step,
                volume: volume.clone(),
                cam_from_obj: cam_from_obj.as_ref().map(numbers),
                velocity: (*velocity).into(),
                missing: *missing,
                fresh: *fresh,
            }
        });
        postcard::to_stdvec(&Saved { appearance: self.appearance.clone(), memory }).ok()
    }

    pub(crate) fn go_on_from(&mut self, bytes: &[u8]) -> bool {
        let Ok(mut saved) = postcard::from_bytes::<Saved>(bytes) else { return false };
        let volume = saved.memory.as_ref().and_then(|m| m.volume.as_ref());
        if !saved.appearance.complete() || volume.is_some_and(|v| !v.is_whole()) {
            return false;
        }
        let mut restored = Self::new(self.options.clone());
        restored.appearance = saved.appearance;
        restored.memory = saved.memory.map(|m| Memory {
            samples: m.samples,
            step: m.step,
            volume: m.volume,
            cam_from_obj: m.cam_from_obj.map(isometry),
            velocity: Vector3::from(m.velocity),
            missing: m.missing,
            fresh: m.fresh,
        });
        *self = restored;
        true
    }
}

/// Translation, then quaternion `[i, j, k, w]`: the very numbers of the pose.
fn numbers(pose: &Isometry3<f64>) -> [f64; 7] {
    let (t, q) = (pose.translation.vector, pose.rotation.coords);
    [t.x, t.y, t.z, q.x, q.y, q.z, q.w]
}

fn isometry([x, y, z, i, j, k, w]: [f64; 7]) -> Isometry3<f64> {
    Isometry3::from_parts(Translation3::new(x, y, z), Unit::new_unchecked(Quaternion::new(w, i, j, k)))
}

#[cfg(test)]
mod tests {
    use rgbd_io::{Image, Intrinsics, RgbdFrame};

    use super::*;
    use crate::{Prior, VideoSegmenter};

    fn frame(shift: usize) -> RgbdFrame {
        let inside = |x: usize, y: usize| (20 + shift..40 + shift).contains(&x) && (14..34).contains(&y);
        RgbdFrame {
            id: shift.to_string(),
            color: Image::from_fn(64, 48, |x, y| {
                if inside(x, y) { [200, 30, (x * 3) as u8] } else { [120, 120, y as u8] }
            }),
            depth: Image::from_fn(64, 48, |x, y| if inside(x, y) { 0.5 } else { 0.8 }),
            mask: None,
            intrinsics: Intrinsics { fx: 60.0, fy: 60.0, cx: 31.5, cy: 23.5 },
        }
    }

    #[test]
    fn a_restored_segmenter_answers_bit_for_bit_like_the_one_that_went_on() {
        let first = Image::from_fn(64, 48, |x, y| u8::from((20..40).contains(&x) && (14..34).contains(&y)));
        let mut uninterrupted = Propagate::default();
        uninterrupted.start(&frame(0), &first);
        for cut in 0..6 {
            let saved = uninterrupted.save().unwrap();
            let mut restored = Propagate::default();
            assert!(restored.restore(&saved));
            for shift in cut + 1..8 {
                let step = |s: &mut Propagate| {
                    let found = s.next(&frame(shift), &Prior::default());
                    // Every other frame is not refined, as after a loss.
                    if shift % 2 == 0 { s.refine(&frame(shift), found, &Prior::default()) } else { found }
                };
                let again = step(&mut restored);
                if shift == cut + 1 {
                    assert_eq!(step(&mut uninterrupted), again);
                    assert!(again.area > 300);
                }
            }
        }
    }

    #[test]
    fn foreign_bytes_change_nothing() {
        let mut segmenter = Propagate::default();
        segmenter.start(&frame(0), &Image::filled(64, 48, 1));
        let saved = segmenter.save().unwrap();
        for bytes in [&[][..], &[7; 40], &saved[..saved.len() / 2]] {
            assert!(!segmenter.restore(bytes));
        }
        assert_eq!(segmenter.save().unwrap(), saved);
    }
}
