//! One sequence: the true poses stand in for the tracker, the model is fused from the segmenter's own masks. What the
//! tracker wouldn't know isn't told: where the object is while it is out of view, and how it moves at first after that.

use std::path::Path;
use std::time::Duration;

use anyhow::Context;
use mask_tracker::{Prior, Propagate, Segmentation, StageTimes, VideoSegmenter};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rgbd_io::{CustomFolder, CustomOptions, FrameSource, MaskSource, RgbdFrame};

use super::{MaskArgs, clock::thread_time, fusion::Fusion, overlay, score};

/// A frame's measurements.
pub(super) struct Measured {
    pub(super) index: usize,
    /// J before and after the pose.
    pub(super) region: [f64; 2],
    pub(super) boundary: f64,
    pub(super) confidence: f32,
    pub(super) time: Duration,
}

/// A sequence's measurements; the first frame, whose mask is given, isn't among them.
pub(super) struct Followed {
    pub(super) frames: Vec<Measured>,
    pub(super) stages: StageTimes,
    /// Cases of reappearance, and those found in time.
    pub(super) reappearances: (usize, usize),
}

pub(super) fn follow(folder: &Path, args: &MaskArgs) -> anyhow::Result<Followed> {
    let derived = folder.join("masks_derived");
    let masks = if derived.is_dir() { MaskSource::Folder(derived) } else { MaskSource::All };
    let source = CustomFolder::open(folder, &CustomOptions { masks, ..CustomOptions::default() })?;
    let mut segmenter = Propagate::default();
    let mut model = Fusion::default();
    let mut known = Known::default();
    let mut areas = Vec::new();
    let mut frames = Vec::new();
    for index in 0..source.len().min(args.frames.unwrap_or(usize::MAX)) {
        let mut frame = source.frame(index)?;
        let truth = frame.mask.take().with_context(|| format!("frame {} has no mask", frame.id))?;
        let pose = rgbd_io::poses::read_pose(&folder.join("gt_poses").join(format!("{}.txt", frame.id)))?;
        let pose = match args.noise[..] {
            [mm, deg] => disturbed(pose, mm, deg, index),
            _ => pose,
        };
        areas.push(truth.pixels().iter().filter(|m| **m != 0).count());
        if index == 0 {
            let given = folder.join("masks").join(format!("{}.png", frame.id));
            let first = if given.is_file() { rgbd_io::read_mask(&given)? } else { truth };
            segmenter.start(&frame, &first);
            known.observe(pose);
            if !args.no_pose {
                model.add(&frame, &first, &pose);
                let first = Segmentation::new(first, 1.0);
                segmenter.refine(&frame, first, &Prior { cam_from_obj: Some(pose), ..Prior::default() });
            }
            continue;
        }
        let points = model.points();
        let prior = |pose: Option<Isometry3<f64>>, confidence| match pose {
            Some(pose) if !args.no_pose => Prior { cam_from_obj: Some(pose), model: &points, confidence },
            _ => Prior::default(),
        };
        let (predicted, confidence) = known.predict();
        let (before, first_time) = timed(|| segmenter.next(&frame, &prior(predicted, confidence)));
        let first_pass = before.mask.clone();
        let (after, second_time) = timed(|| match before.area {
            0 => before,
            _ => segmenter.refine(&frame, before, &prior(Some(pose), 1.0)),
        });
        if after.area > 0 {
            known.observe(pose)
        } else {
            known.lose()
        }
        if !args.no_pose && after.confidence > 0.5 {
            model.add(&frame, &after.mask, &pose);
        }
        if let Some(overlays) = &args.overlays {
            draw(overlays, folder, &frame, &after, &truth)?;
        }
        frames.push(Measured {
            index,
            region: [&first_pass, &after.mask].map(|m| score::region(m, &truth)),
            boundary: score::boundary(&after.mask, &truth),
            confidence: after.confidence,
            time: first_time + second_time,
        });
    }
    let regions: Vec<f64> = std::iter::once(1.0).chain(frames.iter().map(|f| f.region[1])).collect();
    let reappearances = score::reappearances(&areas, &regions);
    Ok(Followed { frames, stages: segmenter.stage_times(), reappearances })
}

fn timed<T>(work: impl FnOnce() -> T) -> (T, Duration) {
    let begin = thread_time();
    (work(), thread_time().saturating_sub(begin))
}

/// The poses that a tracker would know.
#[derive(Default)]
struct Known {
    last: Option<Isometry3<f64>>,
    before: Option<Isometry3<f64>>,
    lost: bool,
}

impl Known {
    fn observe(&mut self, pose: Isometry3<f64>) {
        (self.before, self.last) = (self.last.filter(|_| !self.lost), Some(pose));
        self.lost = false;
    }

    fn lose(&mut self) {
        (self.before, self.lost) = (None, true);
    }

    /// The last step again, or where the object was last seen, with the tracker's confidence in it.
    fn predict(&self) -> (Option<Isometry3<f64>>, f32) {
        let steady = self.before.zip(self.last).map(|(a, b)| b * a.inverse() * b);
        (steady.or(self.last), if self.lost { 0.2 } else { 0.8 })
    }
}

fn draw(
    overlays: &Path,
    folder: &Path,
    frame: &RgbdFrame,
    found: &Segmentation,
    truth: &rgbd_io::Mask,
) -> anyhow::Result<()> {
    let dir = overlays.join(folder.file_name().unwrap_or_default());
    std::fs::create_dir_all(&dir).with_context(|| format!("{} can't be made", dir.display()))?;
    let picture = overlay::outlines(frame, &found.mask, truth);
    rgbd_io::write_png_rgb(&dir.join(format!("{}.png", frame.id)), &picture)?;
    Ok(())
}

/// A deterministic disturbance of up to `mm` and `deg` per axis.
fn disturbed(pose: Isometry3<f64>, mm: f64, deg: f64, index: usize) -> Isometry3<f64> {
    let wave = |k: usize| (index as f64 * 12.9898 + k as f64 * 78.233).sin();
    let shift = Vector3::new(wave(0), wave(1), wave(2)) * mm * 1e-3;
    let turn = Vector3::new(wave(3), wave(4), wave(5)) * deg.to_radians();
    let mut out = pose;
    out.append_translation_mut(&Translation3::from(shift));
    out.append_rotation_wrt_center_mut(&UnitQuaternion::from_scaled_axis(turn));
    out
}
