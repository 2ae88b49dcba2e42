//! The training-free segmenter: what it remembers and the order of its steps.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rgbd_io::{Image, Mask, RgbdFrame};

use crate::appearance::{Appearance, Histogram};
use crate::distance::nearest;
use crate::energy::{Cues, Unaries, cut, edges, keep_connected, unaries};
use crate::grid::{Bounds, Camera, EMPTY_BOUNDS, Grid, Window, include};
use crate::redetect;
use crate::surface::Surface;
use crate::upsample::upsample;
use crate::warp::{Layer, Sample, align, bounds, moved};
use crate::{Prior, Segmentation, VideoSegmenter};

/// Settings of [`Propagate`]; the defaults suit consumer depth cameras and objects of 3 cm to 50 cm.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Cells on the longer side of the working grid; more follow finer detail and cost time quadratically.
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
            max_cells: 140,
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
}

/// The object as last seen.
pub(crate) struct Memory {
    pub(crate) samples: Vec<Sample>,
    pub(crate) cam_from_obj: Option<Isometry3<f64>>,
    /// Camera-frame translation of the last step, metres.
    pub(crate) velocity: Vector3<f32>,
    /// Frames since the object was last seen.
    pub(crate) missing: u32,
    /// No frame has followed the first one yet.
    pub(crate) fresh: bool,
}

/// The current frame between `next` and `refine`.
struct Work {
    grid: Grid,
    edges: Vec<[i32; 8]>,
    log_ratio: Vec<f32>,
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
    object: Layer,
    evidence: Vec<f32>,
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
        Self { options, appearance: Appearance::empty(), memory: None, work: None }
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

    fn try_motion(&self, frame: &RgbdFrame, prior: &Prior<'_>, motion: Isometry3<f32>) -> Option<Work> {
        let memory = self.memory.as_ref()?;
        let size = frame.color.size();
        let camera = Camera::new(&frame.intrinsics, size);
        let mut region = bounds(&memory.samples, &motion, &camera)?;
        if prior.confidence > 0.3 {
            extend_by_model(&mut region, prior, &camera);
        }
        let margin = 12.0 + 0.3 * (region[2] - region[0]).max(region[3] - region[1]).min(400.0);
        let window = Window::around(region, margin, size, self.options.max_cells)?;
        let grid = Grid::new(frame, window);
        let log_ratio: Vec<f32> = grid.color.iter().map(|&c| self.appearance.log_ratio(c)).collect();
        let reach = (margin / window.step as f32) as i32;
        let posed = prior.cam_from_obj.is_some() && memory.cam_from_obj.is_some();
        let radius = if posed { reach / 2 } else { reach }.clamp(3, 28);
        let (shift, mut lowest) = align(&grid, &log_ratio, &memory.samples, &motion, &camera, radius);
        let mut best = shift * motion;
        // A prediction that explains the image worse than none is not used. Standing still wins a tie against the
        // last step repeated, which would otherwise creep by fractions of a cell.
        let still = (Isometry3::identity(), 2, if posed { 0.02 } else { -0.004 });
        let steady = (Self::steady_motion(memory), radius, 0.02);
        for (other, radius, handicap) in [still, steady].into_iter().take(if posed { 2 } else { 1 }) {
            let (shift, cost) = align(&grid, &log_ratio, &memory.samples, &other, &camera, radius);
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
        let edges = edges(&grid, self.options.smoothness);
        let found = self.minimise(&grid, &edges, &log_ratio, &motion, pose, prior, &camera, false)?;
        Some(Work { grid, edges, log_ratio, motion, mismatch: lowest, found, camera, size })
    }

    #[allow(clippy::too_many_arguments)]
    fn minimise(
        &self,
        grid: &Grid,
        edges: &[[i32; 8]],
        log_ratio: &[f32],
        motion: &Isometry3<f32>,
        cam_from_obj: Option<Isometry3<f32>>,
        prior: &Prior<'_>,
        camera: &Camera,
        refined: bool,
    ) -> Option<Found> {
        let memory = self.memory.as_ref()?;
        let (samples, window) = (&memory.samples, &grid.window);
        let object = Layer::draw(samples, |s| s.object, motion, camera, window);
        let carried = Layer::draw(samples, |s| !s.object, motion, camera, window);
        let still = Layer::draw(samples, |s| !s.object, &Isometry3::identity(), camera, window);
        let surface = cam_from_obj.and_then(|pose| {
            let mut surface = Surface::draw(prior.model, &pose, camera, window, prior.confidence)?;
            surface.weigh(grid, |i| object.depth[i] > 0.0);
            Some(surface)
        });
        let cues = Cues {
            grid,
            log_ratio,
            color_weight: 0.35 + 0.65 * self.appearance.reliability(),
            object: &object,
            carried: &carried,
            still: &still,
            surface: surface.as_ref(),
            refined,
        };
        let Unaries { total, evidence, predicted } =
            unaries(&cues, &self.options, 0.5 * (camera.fx + camera.fy));
        let mut labels = cut(grid, edges, &total);
        keep_connected(&mut labels, &predicted, window.w, window.h);
        let area = labels.iter().filter(|&&l| l).count();
        let visible = (0..window.len()).filter(|&i| object.depth[i] > 0.0 && object.hidden[i] == 0).count();
        let everything = object.depth.iter().filter(|&&z| z > 0.0).count();
        let verified = (0..window.len()).filter(|&i| labels[i] && evidence[i] > 0.0).count();
        let seen = area as f32 / everything.max(1) as f32;
        let coverage = area as f32 / visible.max(1) as f32;
        let confidence = verified as f32 / area.max(1) as f32
            * ((seen - 0.02) / 0.2).clamp(0.0, 1.0)
            * (2.0 / coverage.max(1e-3)).min(1.0);
        Some(Found { labels, object, evidence, confidence, coverage })
    }

    fn lost(&mut self, size: (usize, usize), confidence: f32) -> Segmentation {
        self.work = None;
        if let Some(memory) = &mut self.memory {
            memory.missing = memory.missing.saturating_add(1);
        }
        Segmentation::new(Image::filled(size.0, size.1, 0), confidence.min(self.options.min_confidence))
    }

    fn present(&self, work: &Work, threshold: f32) -> bool {
        let cell = work.grid.window.step * work.grid.window.step;
        let area = work.found.labels.iter().filter(|&&l| l).count() * cell;
        work.found.confidence >= threshold && area >= 16
    }

    /// Remembers the frame: its cells become the samples of the next, colour models learn if it is trusted.
    pub(crate) fn commit(&mut self, cam_from_obj: Option<Isometry3<f64>>) {
        let Some(work) = self.work.take() else { return };
        let Some(memory) = &mut self.memory else { return };
        let old_center = center(&memory.samples);
        let mut samples = lift(&work.grid, &work.camera, &work.found.labels);
        for (s, i) in &mut samples {
            let before = if work.found.object.depth[*i] > 0.0 { work.found.object.trust[*i] } else { 0.3 };
            let change = if work.found.evidence[*i] > 0.0 { 0.1 } else { -0.1 };
            // Background that looks like the object may be a part of it that was missed: it must not hold on to
            // its label by its looks alone.
            let doubt = self.appearance.reliability() * (0.5 + 0.4 * work.log_ratio[*i]).clamp(0.0, 1.0);
            s.trust = if s.object { (before + change).clamp(0.1, 1.0) } else { 1.0 - doubt };
        }
        let mut samples: Vec<Sample> = samples.into_iter().map(|(s, _)| s).collect();
        // One hidden sample per cell is enough; the flicker of outlines would pile them up.
        let mut taken = vec![false; work.grid.window.len()];
        for s in memory.samples.iter().filter(|s| s.object && s.hidden < self.options.memory_frames) {
            if let Some((kept, i)) = still_hidden(s, &work, &self.options)
                && !taken[i]
            {
                taken[i] = true;
                samples.push(kept);
            }
        }
        if memory.missing == 0
            && let (Some(a), Some(p)) = (old_center, old_center.map(|c| moved(c, &work.motion)))
        {
            memory.velocity = Vector3::new(p[0] - a[0], p[1] - a[1], p[2] - a[2]);
        } else {
            memory.velocity = Vector3::zeros();
        }
        memory.samples = samples;
        memory.cam_from_obj = cam_from_obj;
        memory.missing = 0;
        let trusted = work.found.confidence >= self.options.learn_confidence
            && (0.6..1.5).contains(&work.found.coverage);
        if trusted {
            let (object, background) = histograms(&work.grid, &work.found.labels, Some(&work.log_ratio));
            self.appearance.grade(&work.log_ratio, &work.found.labels, 0.1);
            self.appearance.learn(&object, &background, self.options.learning_rate);
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
        let labels = mask_cells(mask, &window);
        let (object, background) = histograms(&grid, &labels, None);
        self.appearance = Appearance::start(object, background);
        let log_ratio: Vec<f32> = grid.color.iter().map(|&c| self.appearance.log_ratio(c)).collect();
        self.appearance.grade(&log_ratio, &labels, 1.0);
        let samples = lift(&grid, &camera, &labels).into_iter().map(|(s, _)| s).collect();
        self.memory =
            Some(Memory { samples, cam_from_obj: None, velocity: Vector3::zeros(), missing: 0, fresh: true });
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
        let mut work = self.try_motion(frame, prior, motion);
        // Not seen, or only a poor match where it was expected: is there a better one anywhere else?
        let seen = work.as_ref().filter(|w| self.present(w, threshold));
        let mismatch = seen.map_or(f32::INFINITY, |w| w.mismatch);
        if mismatch > 0.3 {
            let camera = Camera::new(&frame.intrinsics, size);
            let elsewhere = self
                .memory
                .as_ref()
                .and_then(|m| redetect::search(frame, &self.appearance, &m.samples, &motion, &camera))
                .and_then(|shift| self.try_motion(frame, &Prior::default(), shift * motion));
            if let Some(again) = elsewhere
                && self.present(&again, 0.6)
                && again.found.coverage > 0.3
                && again.mismatch < mismatch - 0.05
            {
                work = Some(again);
            }
        }
        match work {
            Some(work) if self.present(&work, threshold) => {
                let mask = upsample(frame, &work.grid, &work.found.labels);
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
        let again = self.minimise(
            &work.grid,
            &work.edges,
            &work.log_ratio,
            &work.motion,
            pose,
            prior,
            &work.camera,
            true,
        );
        let Some(again) = again else { return found };
        let work = Work { found: again, ..work };
        if !self.present(&work, self.options.min_confidence) {
            return self.lost(size, work.found.confidence);
        }
        let mask = upsample(frame, &work.grid, &work.found.labels);
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

fn extend_by_model(region: &mut Bounds, prior: &Prior<'_>, camera: &Camera) {
    let Some(pose) = prior.cam_from_obj else { return };
    let pose: Isometry3<f32> = pose.cast();
    let stride = (prior.model.len() / 400).max(1);
    let mut model = EMPTY_BOUNDS;
    for point in prior.model.iter().step_by(stride) {
        if let Some([u, v]) = camera.project(moved(point.position, &pose)) {
            include(&mut model, u, v);
        }
    }
    // A model far from the last mask is a wrong pose: it must not stretch the window over the image.
    let size = (region[2] - region[0]).max(region[3] - region[1]).max(20.0);
    let apart = (0..4).any(|k| (model[k] - region[k]).abs() > 1.5 * size);
    if model[0] <= model[2] && !apart {
        *region = [
            region[0].min(model[0]),
            region[1].min(model[1]),
            region[2].max(model[2]),
            region[3].max(model[3]),
        ];
    }
}

fn mask_bounds(mask: &Mask) -> Option<Bounds> {
    let mut b = EMPTY_BOUNDS;
    for y in 0..mask.height() {
        for (x, _) in mask.row(y).iter().enumerate().filter(|(_, m)| **m != 0) {
            include(&mut b, x as f32, y as f32);
        }
    }
    (b[0] <= b[2]).then_some(b)
}

/// Cells of which at least half is mask.
fn mask_cells(mask: &Mask, window: &Window) -> Vec<bool> {
    let mut labels = Vec::with_capacity(window.len());
    for cy in 0..window.h {
        for cx in 0..window.w {
            let (mut inside, mut count) = (0, 0);
            for y in 0..window.step {
                for x in 0..window.step {
                    if let Some(&m) =
                        mask.get(window.x0 + cx * window.step + x, window.y0 + cy * window.step + y)
                    {
                        count += 1;
                        inside += usize::from(m != 0);
                    }
                }
            }
            labels.push(2 * inside >= count && inside > 0);
        }
    }
    labels
}

/// Colours of the object and of what surrounds it; cells at the outline are mixed and teach neither.
fn histograms(grid: &Grid, labels: &[bool], doubted: Option<&[f32]>) -> (Histogram, Histogram) {
    let to_object = nearest(grid.window.w, grid.window.h, |i| labels[i]);
    let to_outside = nearest(grid.window.w, grid.window.h, |i| !labels[i]);
    let object = Histogram::from_colors(
        (0..labels.len()).filter(|&i| labels[i] && to_outside.distance[i] > 1.2).map(|i| grid.color[i]),
    );
    // Around the object, what looks like it may be a part that was missed: the background must not learn that.
    let teaches = |i: usize| {
        let d = to_object.distance[i];
        d > 15.0 || (d > 1.2 && doubted.is_none_or(|log_ratio| log_ratio[i] < 0.0))
    };
    let background = (0..labels.len()).filter(|&i| teaches(i)).map(|i| grid.color[i]);
    (object, Histogram::from_colors(background))
}

/// Lifts every cell to 3-D; one without depth borrows it from the nearest cell of its side that has one.
fn lift(grid: &Grid, camera: &Camera, labels: &[bool]) -> Vec<(Sample, usize)> {
    let (w, h) = (grid.window.w, grid.window.h);
    let object = nearest(w, h, |i| labels[i] && grid.depth[i] > 0.0);
    let background = nearest(w, h, |i| !labels[i] && grid.depth[i] > 0.0);
    (0..labels.len())
        .map(|i| {
            let measured = grid.depth[i] > 0.0;
            let seed = if labels[i] { object.seed[i] } else { background.seed[i] };
            let z = grid.depth.get(seed as usize).copied().unwrap_or(1.0);
            let (u, v) = grid.window.center(i);
            let sample = Sample {
                point: camera.unproject(u, v, z),
                color: grid.color[i],
                object: labels[i],
                measured,
                hidden: 0,
                trust: 1.0,
            };
            (sample, i)
        })
        .collect()
}

/// The moved sample and its cell, if something in front of it keeps it out of view.
fn still_hidden(s: &Sample, work: &Work, options: &Options) -> Option<(Sample, usize)> {
    let p = moved(s.point, &work.motion);
    let [u, v] = work.camera.project(p)?;
    let i = work.grid.window.index(work.grid.window.cell(u, v))?;
    let z = work.grid.depth[i];
    let covered = z > 0.0 && s.measured && z < p[2] - options.in_front;
    let unknown = z <= 0.0 && s.hidden > 0;
    let kept = Sample { point: p, hidden: s.hidden.saturating_add(1), ..*s };
    (!work.found.labels[i] && (covered || unknown)).then_some((kept, i))
}

fn center(samples: &[Sample]) -> Option<[f32; 3]> {
    let mut sum = [0.0f32; 3];
    let mut count = 0;
    for s in samples.iter().filter(|s| s.object) {
        (0..3).for_each(|k| sum[k] += s.point[k]);
        count += 1;
    }
    (count > 0).then(|| sum.map(|v| v / count as f32))
}
