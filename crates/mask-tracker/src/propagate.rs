//! The training-free segmenter: what it remembers and the order of its steps.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rgbd_io::{Image, Mask, RgbdFrame};

use crate::appearance::{Appearance, Band, bin};
use crate::cut::cut;
use crate::energy::{Cues, KNOWN, Unaries, keep_connected, unaries};
use crate::grid::{Bounds, Camera, Grid, Window};
use crate::math::Rigid;
use crate::memory::{
    Memory, band, center, frame_colors, lift, mask_bounds, mask_cells, object_depth, still_hidden,
    trim_outline,
};
use crate::redetect;
use crate::stages::{Clock, Stage, StageTimes};
use crate::surface::Surface;
use crate::upsample::{update, upsample};
use crate::view::{Moved, View};
use crate::volume::Volume;
use crate::warp::{Sample, align, bounds, moved, trimmed_bounds};
use crate::{Prior, Segmentation, VideoSegmenter};

/// A place found by searching the whole image is the object's if its points disagree less with it on average: half of
/// what [`align`] gives to a point that falls outside the image.
const MISMATCH: f32 = 0.4;

/// Settings of [`Propagate`]; the defaults suit consumer depth cameras and objects of 3 cm to 50 cm.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Cells of the working grid at most (fewer than 64 count as 64); more follow finer detail, and time is
    /// proportional to them.
    pub max_cells: usize,
    /// Weight of the boundary length against the per-cell preferences.
    pub smoothness: f32,
    /// A pixel nearer than the object's surface by more than this (metres) belongs to an occluder.
    pub in_front: f32,
    /// A pixel farther than the object's surface by more than this (metres) belongs to the background.
    pub behind: f32,
    /// Share of the colour models replaced by each confident frame.
    pub learning_rate: f32,
    /// Colours are learnt from frames with at least this confidence.
    pub learn_confidence: f32,
    /// Below this confidence the object counts as gone.
    pub min_confidence: f32,
    /// Frames for which an occluded part of the object is remembered.
    pub memory_frames: u16,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            max_cells: 12_000,
            smoothness: 2.5,
            in_front: 0.008,
            behind: 0.02,
            learning_rate: 0.04,
            learn_confidence: 0.7,
            min_confidence: 0.3,
            memory_frames: 150,
        }
    }
}

/// Propagates the first mask through a video by minimising one energy per frame (see the crate's documentation).
///
/// Deterministic; one thread; a few milliseconds per frame at 640x480.
pub struct Propagate {
    pub(crate) options: Options,
    pub(crate) appearance: Appearance,
    pub(crate) memory: Option<Memory>,
    work: Option<Work>,
    clock: Clock,
}

/// The current frame between `next` and `refine`.
struct Work {
    view: View,
    motion: Isometry3<f32>,
    /// How badly the moved samples agree with the image, about 0..1.
    mismatch: f32,
    found: Found,
    camera: Camera,
    size: (usize, usize),
}

/// Outcome of one minimisation.
struct Found {
    labels: Vec<bool>,
    evidence: Vec<f32>,
    /// Weighted colour log-likelihood ratio.
    color: Vec<f32>,
    confidence: f32,
    /// Object cells over visible predicted cells.
    coverage: f32,
}

impl Default for Propagate {
    fn default() -> Self {
        Self::new(Options::default())
    }
}

impl Propagate {
    /// A segmenter that waits for [`VideoSegmenter::start`].
    pub fn new(options: Options) -> Self {
        Self { options, appearance: Appearance::empty(), memory: None, work: None, clock: Clock::default() }
    }

    /// Where the time went so far.
    pub fn stage_times(&self) -> StageTimes {
        self.clock.times()
    }

    /// Motion of the object's points since the last frame, before looking at the new one.
    fn predicted_motion(memory: &Memory, prior: &Prior<'_>) -> Isometry3<f32> {
        if let (Some(now), Some(then)) = (prior.cam_from_obj, memory.cam_from_obj) {
            let motion: Isometry3<f32> = (now * then.inverse()).cast();
            if motion.to_homogeneous().iter().all(|v| v.is_finite()) {
                return motion;
            }
        }
        Self::steady_motion(memory)
    }

    /// The last step again, slowed down.
    fn steady_motion(memory: &Memory) -> Isometry3<f32> {
        let velocity = if memory.missing == 0 { memory.velocity * 0.7 } else { Vector3::zeros() };
        Isometry3::from_parts(Translation3::from(velocity), UnitQuaternion::identity())
    }

    /// Labels the frame with the last one's samples moved by `motion`, or by a better alternative.
    fn try_motion(
        &self,
        frame: &RgbdFrame,
        prior: &Prior<'_>,
        motion: Isometry3<f32>,
        alternatives: bool,
    ) -> Option<Work> {
        let memory = self.memory.as_ref()?;
        let size = frame.color.size();
        let camera = Camera::new(&frame.intrinsics, size);
        let mut region = bounds(&memory.samples, &motion, &camera)?;
        if prior.confidence > 0.3 {
            extend_by_model(&mut region, prior, &camera);
        }
        let margin = 12.0 + 0.3 * (region[2] - region[0]).max(region[3] - region[1]).min(400.0);
        let window = Window::around(region, margin, size, self.options.max_cells)?;
        let grid = self.clock.time(Stage::Grid, || Grid::new(frame, window));
        let bins: Vec<_> = grid.colors().map(bin).collect();
        let log_ratio: Vec<f32> = bins.iter().map(|&c| self.appearance.log_ratio_anywhere(c)).collect();
        let reach = (margin / window.step as f32) as i32;
        let posed = prior.cam_from_obj.is_some() && memory.cam_from_obj.is_some();
        let radius = if posed { reach / 2 } else { reach }.clamp(3, 28);
        let fit = |motion: &Isometry3<f32>, radius| {
            self.clock
                .time(Stage::Align, || align(&grid, &log_ratio, &memory.samples, motion, &camera, radius))
        };
        let (shift, mut lowest) = fit(&motion, radius);
        let mut best = shift * motion;
        // A prediction that explains the image worse than none is not used. Standing still wins a tie against the
        // last step repeated, which would otherwise creep by fractions of a cell.
        let still = (Isometry3::identity(), 2, if posed { 0.02 } else { -0.004 });
        let steady = (Self::steady_motion(memory), radius, 0.02);
        let count = if alternatives { 1 + usize::from(posed) } else { 0 };
        for (other, radius, handicap) in [still, steady].into_iter().take(count) {
            let (shift, cost) = fit(&other, radius);
            if cost + handicap < lowest {
                lowest = cost + handicap;
                best = shift * other;
            }
        }
        let motion = best;
        let pose = match (prior.cam_from_obj, memory.cam_from_obj) {
            (Some(_), Some(then)) => Some(motion * then.cast::<f32>()),
            (now, _) => now.map(|pose| shift * pose.cast::<f32>()),
        };
        let view = self.clock.time(Stage::Cues, || {
            // Samples from a coarser grid cover several cells of this one.
            let footprint = memory.step.div_ceil(window.step).min(8) as i32;
            let last = Moved { samples: &memory.samples, motion: &motion, camera: &camera, footprint };
            View::new(grid, bins, &last, &self.appearance, &self.options)
        });
        let found = self.minimise(&view, pose, prior, &camera, false)?;
        Some(Work { view, motion, mismatch: lowest, found, camera, size })
    }

    fn minimise(
        &self,
        view: &View,
        cam_from_obj: Option<Isometry3<f32>>,
        prior: &Prior<'_>,
        camera: &Camera,
        refined: bool,
    ) -> Option<Found> {
        let memory = self.memory.as_ref()?;
        let (grid, window) = (&view.grid, &view.grid.window);
        let Unaries { total, evidence, color, predicted } = self.clock.time(Stage::Cues, || {
            let surface = cam_from_obj.and_then(|pose| {
                let mut surface = Surface::draw(prior.model, &pose, camera, window, prior.confidence)?;
                surface.weigh(grid, |i| view.object.depth[i] > 0.0);
                Some(surface)
            });
            let space = cam_from_obj.zip(memory.volume.as_ref()).map(|(pose, volume)| {
                let mut space = volume.testimony(grid, camera, &pose);
                weigh_space(&mut space, |i| view.in_view[i]);
                space
            });
            let confidence = if prior.confidence.is_nan() { 0.0 } else { prior.confidence.clamp(0.0, 1.0) };
            let cues = Cues { view, surface: surface.as_ref(), space: space.as_deref(), confidence, refined };
            unaries(&cues, &self.options, 0.5 * (camera.fx + camera.fy))
        });
        let labels = self.clock.time(Stage::Cut, || {
            let mut labels = cut(&view.edges, &total);
            keep_connected(&mut labels, &predicted, window.w, window.h);
            labels
        });
        let (mut area, mut verified, mut visible, mut everything) = (0, 0, 0, 0);
        for i in 0..window.len() {
            area += usize::from(labels[i]);
            verified += usize::from(labels[i] && evidence[i] > 0.0);
            visible += usize::from(view.in_view[i]);
            everything += usize::from(view.object.depth[i] > 0.0);
        }
        let seen = area as f32 / everything.max(1) as f32;
        let coverage = area as f32 / visible.max(1) as f32;
        // All of it may come back into view at once, but not much more than that.
        let confidence = verified as f32 / area.max(1) as f32
            * ((seen - 0.02) / 0.2).clamp(0.0, 1.0)
            * (2.0 / seen.max(1e-3)).min(1.0);
        Some(Found { labels, evidence, color, confidence, coverage })
    }

    fn lost(&mut self, size: (usize, usize), confidence: f32) -> Segmentation {
        self.work = None;
        if let Some(memory) = &mut self.memory {
            memory.missing = memory.missing.saturating_add(1);
        }
        Segmentation::new(Image::filled(size.0, size.1, 0), confidence.min(self.options.min_confidence))
    }

    fn present(&self, work: &Work, threshold: f32) -> bool {
        let step = work.view.grid.window.step;
        let area = work.found.labels.iter().filter(|&&l| l).count() * step * step;
        work.found.confidence >= threshold && area >= 16
    }

    /// Remembers the frame: its cells become the samples of the next, colour models learn if it is trusted.
    pub(crate) fn commit(&mut self, cam_from_obj: Option<Isometry3<f64>>) {
        let clock = std::mem::take(&mut self.clock);
        clock.time(Stage::Learn, || self.learn(cam_from_obj));
        self.clock = clock;
    }

    fn learn(&mut self, cam_from_obj: Option<Isometry3<f64>>) {
        let Some(Work { view, found, motion, camera, .. }) = self.work.take() else { return };
        let Some(memory) = &mut self.memory else { return };
        let (grid, labels) = (&view.grid, &found.labels);
        let old_center = center(&memory.samples);
        let reference = object_depth(grid, labels);
        let is_far = |i: usize| grid.depth[i] > 0.0 && band(grid.depth[i], reference[i]) == Band::Far;
        let mut samples = lift(grid, &camera, labels, &reference);
        for (i, s) in samples.iter_mut().enumerate() {
            let before = view.object.sample(&memory.samples, i).map_or(0.3, |s| s.trust);
            let color = found.color[i];
            // What hasn't long been object and looks like what surrounds it was taken for object by mistake.
            let doubtful = before < 0.6 && color < -1.0;
            let change = if found.evidence[i] > 0.0 && !doubtful { 0.1 } else { -0.2 };
            // Background that looks like the object may be a part of it that was missed: it must not hold on to
            // its label by its looks alone.
            let doubt = (0.5 + 0.4 * color).clamp(0.0, 1.0);
            let held = view.habit[i].held.max(if is_far(i) { 1.0 } else { 0.2 })
                + if color < -0.3 { 0.1 } else { 0.0 };
            s.trust = if s.object { (before + change).clamp(0.1, 1.0) } else { held.min(1.0 - doubt) };
        }
        // One hidden sample per cell is enough; the flicker of outlines would pile them up.
        let mut taken = vec![false; grid.window.len()];
        let place = (grid, &camera, labels.as_slice());
        let moved_by = Rigid::new(&motion);
        for s in memory.samples.iter().filter(|s| s.object && s.hidden < self.options.memory_frames) {
            if let Some((kept, i)) = still_hidden(s, &moved_by, place, self.options.in_front)
                && !taken[i]
            {
                taken[i] = true;
                samples.push(kept);
            }
        }
        if memory.missing == 0
            && let (Some(a), Some(p)) = (old_center, old_center.map(|c| moved(c, &motion)))
        {
            memory.velocity = Vector3::new(p[0] - a[0], p[1] - a[1], p[2] - a[2]);
        } else {
            memory.velocity = Vector3::zeros();
        }
        memory.samples = samples;
        memory.step = grid.window.step;
        memory.cam_from_obj = cam_from_obj;
        memory.missing = 0;
        let trusted =
            found.confidence >= self.options.learn_confidence && (0.6..1.5).contains(&found.coverage);
        if trusted {
            // What looks like the object may be a part of it that was missed, and new things are uncertain: only
            // what has long been background, or is far from the object, teaches how that looks.
            let background = |i: usize| view.habit[i].held > KNOWN || is_far(i);
            let known = |i: usize| if labels[i] { found.evidence[i] > 0.0 } else { background(i) };
            let colors = frame_colors(grid, &view.bins, labels, &reference, known);
            self.appearance.grade(&view.bins, labels, |i| band(grid.depth[i], reference[i]), 0.1);
            self.appearance.learn(&colors, self.options.learning_rate);
            if let Some(pose) = cam_from_obj {
                learn_space(memory, &view, &found, &camera, &pose.cast());
            }
        }
    }
}

impl VideoSegmenter for Propagate {
    fn start(&mut self, frame: &RgbdFrame, mask: &Mask) {
        self.memory = None;
        self.work = None;
        self.appearance = Appearance::empty();
        let size = frame.color.size();
        if mask.size() != size {
            return;
        }
        let Some(region) = mask_bounds(mask) else { return };
        let camera = Camera::new(&frame.intrinsics, size);
        let margin = 12.0 + 0.4 * (region[2] - region[0]).max(region[3] - region[1]).min(400.0);
        let Some(window) = Window::around(region, margin, size, self.options.max_cells) else { return };
        let grid = Grid::new(frame, window);
        let mut labels = mask_cells(mask, &window);
        trim_outline(&grid, &mut labels);
        let reference = object_depth(&grid, &labels);
        let bins: Vec<_> = grid.colors().map(bin).collect();
        self.appearance = Appearance::start(frame_colors(&grid, &bins, &labels, &reference, |_| true));
        self.appearance.grade(&bins, &labels, |i| band(grid.depth[i], reference[i]), 1.0);
        let samples = lift(&grid, &camera, &labels, &reference);
        self.memory = Some(Memory {
            samples,
            step: window.step,
            volume: None,
            cam_from_obj: None,
            velocity: Vector3::zeros(),
            missing: 0,
            fresh: true,
        });
    }

    fn next(&mut self, frame: &RgbdFrame, prior: &Prior<'_>) -> Segmentation {
        self.commit(None);
        if let Some(memory) = &mut self.memory {
            memory.fresh = false;
        }
        let size = frame.color.size();
        let Some(memory) = &self.memory else { return self.lost(size, 0.0) };
        let missing = memory.missing > 0;
        let motion = Self::predicted_motion(memory, prior);
        // A lost object must be more certain to be taken back than one in view has to be to be kept.
        let threshold = if missing { 0.6 } else { self.options.min_confidence };
        let mut work = self.try_motion(frame, prior, motion, true);
        // Not seen, or only a poor match where it was expected: is there a better one anywhere else?
        let seen = work.as_ref().filter(|w| self.present(w, threshold));
        let mismatch = seen.map_or(f32::INFINITY, |w| w.mismatch);
        if mismatch > 0.3 {
            let camera = Camera::new(&frame.intrinsics, size);
            let elsewhere = self
                .memory
                .as_ref()
                .and_then(|m| {
                    self.clock.time(Stage::Search, || {
                        redetect::search(frame, &self.appearance, &m.samples, &motion, &camera)
                    })
                })
                // No alternatives: an object that has come nearer since would lie before all of them, which speaks
                // neither for nor against them.
                .and_then(|shift| self.try_motion(frame, &Prior::default(), shift * motion, false));
            if let Some(again) = elsewhere
                && self.present(&again, 0.6)
                && again.found.coverage > 0.3
                && again.mismatch < MISMATCH.min(mismatch - 0.05)
            {
                work = Some(again);
            }
        }
        match work {
            Some(work) if self.present(&work, threshold) => {
                let mask =
                    self.clock.time(Stage::Upsample, || upsample(frame, &work.view.grid, &work.found.labels));
                let confidence = work.found.confidence;
                self.work = Some(work);
                Segmentation::new(mask, confidence)
            }
            other => self.lost(size, other.map_or(0.0, |w| w.found.confidence)),
        }
    }

    fn refine(&mut self, frame: &RgbdFrame, found: Segmentation, prior: &Prior<'_>) -> Segmentation {
        let size = frame.color.size();
        if self.work.as_ref().is_none_or(|w| w.size != size) {
            // Straight after `start`: the first frame's pose anchors the motion of the second.
            if let Some(memory) = self.memory.as_mut().filter(|m| m.fresh) {
                memory.cam_from_obj = prior.cam_from_obj;
                memory.volume = prior.cam_from_obj.and_then(|pose| anchored(&memory.samples, &pose.cast()));
            }
            return found;
        }
        let usable = prior.cam_from_obj.is_some() && !prior.model.is_empty() && prior.confidence > 0.0;
        if !usable {
            self.commit(prior.cam_from_obj);
            return found;
        }
        let Some(work) = self.work.take() else { return found };
        let pose = prior.cam_from_obj.map(|pose| pose.cast());
        let again = self.minimise(&work.view, pose, prior, &work.camera, true);
        let Some(again) = again else { return found };
        let before = work.found.labels;
        let work = Work { found: again, ..work };
        if !self.present(&work, self.options.min_confidence) {
            return self.lost(size, work.found.confidence);
        }
        let (grid, labels) = (&work.view.grid, &work.found.labels);
        let mut mask = found.mask;
        self.clock.time(Stage::Upsample, || match mask.size() == size {
            true => update(frame, grid, &before, labels, &mut mask),
            false => mask = upsample(frame, grid, labels),
        });
        let confidence = work.found.confidence;
        self.work = Some(work);
        self.commit(prior.cam_from_obj);
        Segmentation::new(mask, confidence)
    }

    fn save(&mut self) -> Option<Vec<u8>> {
        self.saved()
    }

    fn restore(&mut self, saved: &[u8]) -> bool {
        self.go_on_from(saved)
    }
}

/// Carves the space around the object and counts what was seen in it; made with the first trusted pose.
fn learn_space(
    memory: &mut Memory,
    view: &View,
    found: &Found,
    camera: &Camera,
    cam_from_obj: &Isometry3<f32>,
) {
    if memory.volume.is_none() {
        let obj_from_cam = cam_from_obj.inverse();
        let points = memory.samples.iter().filter(|s| s.object && s.measured);
        memory.volume =
            Volume::around(points.map(|s| moved(s.point, &obj_from_cam)), moved([0.0; 3], &obj_from_cam));
    }
    if let Some(volume) = &mut memory.volume {
        let Found { labels, evidence, color, .. } = found;
        let sure = |i: usize| {
            if labels[i] { evidence[i] > 0.0 && color[i] > -1.0 } else { view.habit[i].held > KNOWN }
        };
        volume.learn(&view.grid, camera, cam_from_obj, labels, sure);
    }
}

/// The space around the object as the first frame shows it.
fn anchored(samples: &[Sample], cam_from_obj: &Isometry3<f32>) -> Option<Volume> {
    let obj_from_cam = Rigid::new(&cam_from_obj.inverse());
    let measured = || samples.iter().filter(|s| s.measured).map(|s| (obj_from_cam.apply(s.point), s.object));
    let object = measured().filter(|(_, object)| *object).map(|(p, _)| p);
    let mut volume = Volume::around(object, obj_from_cam.apply([0.0; 3]))?;
    volume.anchor(measured());
    Some(volume)
}

/// A wrong pose puts the object itself into empty space: the more of it that happens to, the less the space says.
fn weigh_space(space: &mut [f32], is_object: impl Fn(usize) -> bool) {
    let (mut empty, mut all) = (0u32, 0u32);
    for i in (0..space.len()).filter(|&i| is_object(i)) {
        all += 1;
        empty += u32::from(space[i] < -0.5);
    }
    let share = empty as f32 / all.max(1) as f32;
    let weight = ((0.4 - share) / 0.2).clamp(0.0, 1.0);
    space.iter_mut().for_each(|s| *s *= weight);
}

fn extend_by_model(region: &mut Bounds, prior: &Prior<'_>, camera: &Camera) {
    let Some(pose) = prior.cam_from_obj else { return };
    let pose: Isometry3<f32> = pose.cast();
    let stride = (prior.model.len() / 400).max(1);
    let projected =
        prior.model.iter().step_by(stride).filter_map(|p| camera.project(moved(p.position, &pose)));
    let Some(model) = trimmed_bounds(projected) else { return };
    // A model far from the last mask is a wrong pose: it must not stretch the window over the image.
    let size = (region[2] - region[0]).max(region[3] - region[1]).max(20.0);
    let apart = (0..4).any(|k| (model[k] - region[k]).abs() > 1.5 * size);
    if !apart {
        *region = [
            region[0].min(model[0]),
            region[1].min(model[1]),
            region[2].max(model[2]),
            region[3].max(model[3]),
        ];
    }
}
