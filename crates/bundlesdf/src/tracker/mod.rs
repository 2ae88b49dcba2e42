//! The online tracker: one call per frame (paper figure 2).

mod coarse;
mod correspond;
mod graph;
mod memory;
mod motion;
pub(crate) mod offline;
mod result;
mod rounds;
mod save;
mod uncertainty;
mod verify;
mod wide;

use std::{
    sync::{Arc, atomic::AtomicBool},
    time::Instant,
};

use mask_tracker::{Prior, Propagate, Segmentation, SurfacePoint, VideoSegmenter};
use nalgebra::{Isometry3, Translation3};
use neural_field::TrainedField;
use rgbd_io::{Image, Mask, RgbdFrame};

use self::{
    coarse::{
        CoarsePose, Descriptors, Gates, Search, agreement_with_memory, coarse_from_matches,
        coarse_from_tracks, relocalise, within,
    },
    graph::{GraphProblem, GraphResult},
    motion::Motion,
    save::Provenance,
    wide::WideMatcher,
};
pub use self::{
    result::{FrameResult, StageTimes, Status},
    rounds::{FieldSummary, Reconstruction},
    uncertainty::{HeldMotion, MotionKind, Uncertainty},
};
use crate::{
    config::{Config, ConfigError, Refiner, Schedule},
    field_worker::FieldWorker,
    observation::Observation,
    pool::{Keyframe, MemoryEdge, MemoryPool},
    surface::fused_surface,
};

/// The last frame that was tracked: the reference of the next one.
struct Reference {
    index: usize,
    observation: Arc<Observation>,
    pose: Isometry3<f64>,
}

/// Tracks one object through a video and reconstructs it.
///
/// Feed frames in order with [`Tracker::track`]; the first one that has a mask defines the object and its frame.
/// Frames with a mask of their own use it; for all others the object is segmented from what is known so far.
pub struct Tracker {
    config: Config,
    schedule: Schedule,
    pool: MemoryPool,
    descriptors: Descriptors,
    segmenter: Box<dyn VideoSegmenter>,
    /// The last frame that came with its own mask: where segmentation starts when masks stop coming.
    given: Option<(RgbdFrame, Mask)>,
    surface: Vec<SurfacePoint>,
    /// The mask that the last frame was tracked with.
    mask: Option<Mask>,
    reference: Option<Reference>,
    motion: Motion,
    worker: Option<FieldWorker>,
    field: Option<Arc<TrainedField>>,
    summary: FieldSummary,
    new_keyframes: usize,
    next_index: usize,
    first_valid: usize,
    /// No match has tied the pose to memory since a frame without matches whose depth didn't fit everywhere: the pose
    /// may have slid over a symmetric part.
    adrift: bool,
    /// What a checkpoint needs to make the rest again.
    provenance: Provenance,
}

/// A pose and what supports it, before it is judged.
struct Estimate {
    pose: Isometry3<f64>,
    inliers: usize,
    /// Matches with keyframes among them.
    memory_matches: usize,
    relocalised: bool,
    edges: Vec<(usize, MemoryEdge)>,
    moved: Vec<(usize, Isometry3<f64>)>,
    uncertainty: Option<Uncertainty>,
}

impl Tracker {
    /// Confidence of a pose that the segmentation's prior is drawn with: from before a loss, extrapolated, measured.
    const STALE_POSE: f32 = 0.2;
    const PREDICTED_POSE: f32 = 0.8;
    const ESTIMATED_POSE: f32 = 1.0;

    /// A tracker that has seen nothing yet.
    ///
    /// # Errors
    /// When a value of the config is outside its range, or the weights of its matcher can't be read.
    pub fn new(config: Config, schedule: Schedule) -> Result<Self, ConfigError> {
        config.validate().map_err(|problem| ConfigError { path: "config".into(), problem })?;
        let descriptors = Descriptors::new(WideMatcher::load(&config.coarse.matcher)?);
        let worker =
            (config.field.refiner != Refiner::None).then(|| FieldWorker::new(config.field.device, None));
        Ok(Self {
            config,
            schedule,
            pool: MemoryPool::default(),
            descriptors,
            segmenter: Box::new(Propagate::default()),
            given: None,
            surface: Vec::new(),
            mask: None,
            reference: None,
            motion: Motion::default(),
            worker,
            field: None,
            summary: FieldSummary::default(),
            new_keyframes: 0,
            next_index: 0,
            first_valid: 0,
            adrift: false,
            provenance: Provenance::default(),
        })
    }

    /// The same tracker with another segmenter than the built-in one; for a tracker that has seen nothing yet.
    #[must_use]
    pub fn with_segmenter(mut self, segmenter: Box<dyn VideoSegmenter>) -> Self {
        self.segmenter = segmenter;
        self
    }

    /// The memory pool.
    pub fn pool(&self) -> &MemoryPool {
        &self.pool
    }

    /// The mask that the last frame was tracked with, at the frame's size; `None` when the frame could not be read.
    pub fn mask(&self) -> Option<&Mask> {
        self.mask.as_ref()
    }

    /// What the field has done so far.
    pub fn field_summary(&self) -> &FieldSummary {
        &self.summary
    }

    /// Whether a round of the field is under way beside the tracker.
    pub fn is_field_busy(&self) -> bool {
        self.worker.as_ref().is_some_and(FieldWorker::is_busy)
    }

    /// The newest trained field, once there is one.
    pub fn field(&self) -> Option<&Arc<TrainedField>> {
        self.field.as_ref()
    }

    /// Takes the next frame and answers its pose. Never fails: what can't be tracked has the status
    /// [`Status::Lost`] and the last good pose.
    pub fn track(&mut self, frame: &RgbdFrame) -> FrameResult {
        let index = self.next_index;
        self.next_index += 1;
        let span = tracing::info_span!("frame", index, id = frame.id);
        let _entered = span.enter();
        self.poll_field();
        let start = Instant::now();
        // On a thread of the pool: a loop that starts outside of it waits until one of its threads wakes, tens of times a
        // frame.
        let mut result = rayon::scope(|_| span.in_scope(|| self.track_in_stages(index, frame)));
        result.times.total = start.elapsed();
        if self.round_is_due() {
            self.start_round();
            if self.schedule == Schedule::Lockstep {
                self.wait_for_field(&AtomicBool::new(false));
                if result.keyframe
                    && let Some(keyframe) = self.pool.get(index)
                {
                    result.cam_from_obj = keyframe.obj_from_cam.inverse();
                }
            }
        }
        result
    }

    /// Takes a frame that could not be read: it counts, and its pose is the last good one.
    pub fn skip(&mut self, id: &str) -> FrameResult {
        let index = self.next_index;
        self.next_index += 1;
        self.mask = None;
        self.lost(index, id)
    }

    fn track_in_stages(&mut self, index: usize, frame: &RgbdFrame) -> FrameResult {
        let start = Instant::now();
        let mut times = StageTimes::default();
        let masked = self.segment(frame);
        self.mask = Some(masked.mask().clone());
        times.segment = start.elapsed();
        let result = self.track_masked(index, frame, masked, &mut times);
        FrameResult { times, ..result }
    }

    fn track_masked(
        &mut self,
        index: usize,
        frame: &RgbdFrame,
        masked: Masked,
        times: &mut StageTimes,
    ) -> FrameResult {
        let begin = Instant::now();
        let observation = match Observation::new(index, frame, masked.mask(), &self.config) {
            Ok(observation) => observation,
            Err(reason) => {
                tracing::debug!(%reason, "lost");
                times.matching = begin.elapsed();
                return self.lost(index, &frame.id);
            }
        };
        if self.pool.keyframes().is_empty() {
            times.matching = begin.elapsed();
            return self.initialise(frame, observation);
        }
        if observation.valid * 40 < self.first_valid {
            times.matching = begin.elapsed();
            return self.lost(index, &frame.id);
        }
        let (coarse, relocalised) =
            self.coarse(&observation).map_or((None, false), |(c, far)| (Some(c), far));
        times.matching = begin.elapsed();
        let begin = Instant::now();
        let observation = self.clean_up(frame, masked, coarse.as_ref(), observation);
        times.segment += begin.elapsed();
        let begin = Instant::now();
        let estimate = self.optimise(&observation, coarse, relocalised);
        let result = self.judge(index, frame, observation, estimate);
        times.posegraph = begin.elapsed();
        result
    }

    /// The first usable frame defines the object's frame: axes of the camera, origin in the middle of the cloud.
    fn initialise(&mut self, frame: &RgbdFrame, observation: Observation) -> FrameResult {
        let centre = observation.centre();
        let obj_from_cam = Isometry3::from_parts(Translation3::from(-centre.coords), Default::default());
        self.first_valid = observation.valid;
        let index = observation.index;
        let inliers = observation.corners(self.config.coarse.max_corners).len();
        let observation = Arc::new(observation);
        self.reference = Some(Reference { index, observation: observation.clone(), pose: obj_from_cam });
        self.note_observation(&observation);
        self.motion.observe(index, &obj_from_cam);
        self.remember(new_keyframe(frame, index, obj_from_cam, observation), Vec::new(), None);
        FrameResult {
            index,
            id: frame.id.clone(),
            cam_from_obj: obj_from_cam.inverse(),
            status: Status::Tracked,
            inliers,
            depth_agreement: 1.0,
            uncertainty: None,
            keyframe: true,
            times: StageTimes::default(),
        }
    }

    /// Pose from the previous frame, or else from memory; the flag tells that it came from memory.
    fn coarse(&self, observation: &Observation) -> Option<(CoarsePose, bool)> {
        let reference = self.reference.as_ref()?;
        let c = &self.config.coarse;
        let seed = self.config.seed ^ ((observation.index as u64) << 20);
        let gap = observation.index - reference.index;
        let near = (&*reference.observation, &reference.pose);
        let mut guesses = vec![self.motion.predict(observation.index).unwrap_or(reference.pose)];
        if guesses[0] != reference.pose {
            guesses.push(reference.pose);
        }
        let gates = Gates::between(c, gap);
        let search = Search {
            config: c,
            gates,
            min_inliers: c.min_inliers,
            focal: observation.intrinsics.fx,
            swing: Search::ANY_SWING,
            seed,
        };
        let tracked = coarse_from_tracks(near, observation, &guesses, &search);
        let enough = |p: &CoarsePose| p.matches.len() >= 2 * c.min_inliers;
        if self.adrift
            && let Some(found) = relocalise(&self.pool, observation, &self.descriptors, &self.config)
        {
            return Some((found, true));
        }
        if gap <= 3 && tracked.as_ref().is_some_and(enough) {
            return tracked.map(|p| (p, false));
        }
        let matches = self.descriptors.with_reference(near, observation, &guesses[0]);
        let matched = coarse_from_matches(matches, &reference.pose, &reference.pose, &search);
        let best = [tracked, matched].into_iter().flatten().max_by_key(|p| p.matches.len());
        if gap <= 1 && best.is_some() {
            return best.map(|p| (p, false));
        }
        let found = relocalise(&self.pool, observation, &self.descriptors, &self.config);
        match (best, found) {
            (Some(near), Some(far)) if near.matches.len() >= far.matches.len() => Some((near, false)),
            (_, Some(far)) => Some((far, true)),
            (near, None) => near.map(|p| (p, false)),
        }
    }

    /// Pose graph over the new frame and memory, starting from the coarse pose or, without one, from the last good one.
    fn optimise(&self, observation: &Observation, coarse: Option<CoarsePose>, relocalised: bool) -> Estimate {
        let fallback = self.reference.as_ref().map_or_else(Isometry3::identity, |r| r.pose);
        let guess = coarse.as_ref().map_or(fallback, |c| c.pose);
        if !self.config.memory.enabled {
            let inliers = coarse.map_or(0, |c| c.matches.len());
            return Estimate {
                pose: guess,
                inliers,
                memory_matches: inliers,
                relocalised,
                edges: Vec::new(),
                moved: Vec::new(),
                uncertainty: None,
            };
        }
        let selected = self.pool.select(&guess, &self.config.memory);
        let (guess, edges) = self.memory_edges(observation, guess, coarse.as_ref(), &selected);
        let matched: usize = edges.iter().map(|(_, e)| e.older.len()).sum();
        let coarse_edge = coarse.as_ref().map(|c| MemoryEdge::from_matches(&c.matches));
        // Memory alone holds the pose when it can; the previous frame would only add its own drift.
        let alone =
            self.reference.as_ref().filter(|_| !relocalised && matched < 3 * self.config.coarse.min_inliers);
        let previous = alone.zip(coarse_edge.as_ref()).map(|(r, edge)| (&*r.observation, r.pose, edge));
        let problem = GraphProblem {
            observation,
            guess,
            // What depth doesn't show, matches decide; without enough of them the pose stands still.
            prediction: alone.map(|r| r.pose),
            pool: &self.pool,
            selected: &selected,
            edges: &edges,
            previous,
            // The keyframes hold what the field knows. Its surface itself repeats their errors, and where hardly anything is
            // seen of the object its unevenness turns the frame along a symmetric part.
            field: None,
            config: &self.config.graph,
        };
        let inliers = matched.max(coarse.as_ref().map_or(0, |c| c.matches.len()));
        // A graph that leaves its guess for where the object was expected anyway hasn't run away: the guess was wrong.
        let expected = self.motion.predict(observation.index).filter(|_| !relocalised);
        let sound = |pose: &Isometry3<f64>| {
            [Some(guess), expected].iter().flatten().any(|near| within(Gates::CORRECTION, near, pose))
        };
        match problem.solve() {
            Some(GraphResult { pose, moved, uncertainty }) if sound(&pose) => {
                Estimate { pose, inliers, memory_matches: matched, relocalised, edges, moved, uncertainty }
            }
            _ => Estimate {
                pose: guess,
                inliers,
                memory_matches: matched,
                relocalised,
                edges,
                moved: Vec::new(),
                uncertainty: None,
            },
        }
    }

    /// Decides the frame's status and, with it, what is kept of the frame.
    fn judge(
        &mut self,
        index: usize,
        frame: &RgbdFrame,
        observation: Observation,
        estimate: Estimate,
    ) -> FrameResult {
        /// Less depth agreement than this contradicts the pose.
        const CONTRADICTED: f64 = 0.3;
        const CONVINCING: f64 = 0.5;
        /// With as much depth agreement as this a pose needs no match to be believed.
        const UNDISPUTED: f64 = 0.9;
        let agreement = agreement_with_memory(&self.pool, &observation, &estimate.pose);
        let enough = estimate.inliers >= self.config.coarse.min_inliers;
        let share = agreement.known_share().unwrap_or(CONTRADICTED);
        let status = match (enough, share) {
            (true, s) if s >= CONVINCING && estimate.relocalised => Status::Relocalised,
            (true, s) if s >= CONVINCING => Status::Tracked,
            (true, s) if s >= CONTRADICTED => Status::Weak,
            (false, s) if s >= CONVINCING => Status::Weak,
            _ => return FrameResult { depth_agreement: share, ..self.lost(index, &frame.id) },
        };
        tracing::debug!(status = status.as_str(), inliers = estimate.inliers, agreement = share, "judged");
        for (position, pose) in &estimate.moved {
            if let Some(keyframe) = self.pool.keyframes_mut().get_mut(*position) {
                keyframe.obj_from_cam = *pose;
            }
        }
        let tied = estimate.relocalised || estimate.memory_matches >= 2 * self.config.coarse.min_inliers;
        self.adrift = !tied && (self.adrift || (!enough && share < UNDISPUTED));
        let observation = Arc::new(observation);
        let pose = estimate.pose;
        self.reference = Some(Reference { index, observation: observation.clone(), pose });
        self.note_observation(&observation);
        self.motion.observe(index, &pose);
        let believed = status == Status::Tracked || (status == Status::Weak && share >= UNDISPUTED);
        let memory = &self.config.memory;
        let useful = memory.enabled
            && believed
            && !self.adrift
            && observation.valid as f64 >= memory.min_valid_share * self.first_valid as f64;
        let is_new = useful && self.pool.is_new_view(&pose, memory);
        let certain = useful && !is_new && tied && status == Status::Tracked;
        let worse = certain.then(|| self.pool.worse_view(&observation, &pose, memory)).flatten();
        let keyframe = is_new || worse.is_some();
        let result = FrameResult {
            index,
            id: frame.id.clone(),
            cam_from_obj: pose.inverse(),
            status,
            inliers: estimate.inliers,
            depth_agreement: share,
            uncertainty: estimate.uncertainty,
            keyframe,
            times: StageTimes::default(),
        };
        if keyframe {
            self.remember(new_keyframe(frame, index, pose, observation), estimate.edges, worse);
        } else if !self.config.memory.enabled {
            self.pool.replace_all(new_keyframe(frame, index, pose, observation));
            self.surface = fused_surface(&self.pool);
        }
        result
    }

    /// Adds a keyframe with its matches by position in the pool, in the place of the one at `worse` if there is one.
    fn remember(&mut self, keyframe: Keyframe, edges: Vec<(usize, MemoryEdge)>, worse: Option<usize>) {
        let by_index: Vec<_> = edges
            .into_iter()
            .filter_map(|(position, edge)| Some((self.pool.keyframes().get(position)?.index, edge)))
            .collect();
        match worse {
            None => self.pool.add(keyframe, by_index, &self.config.memory),
            Some(position) => self.pool.replace(position, keyframe, by_index),
        }
        self.new_keyframes += 1;
        self.surface = fused_surface(&self.pool);
    }

    fn lost(&mut self, index: usize, id: &str) -> FrameResult {
        self.motion.forget();
        let pose = self.reference.as_ref().map_or_else(Isometry3::identity, |r| r.pose);
        FrameResult {
            index,
            id: id.to_owned(),
            cam_from_obj: pose.inverse(),
            status: Status::Lost,
            inliers: 0,
            depth_agreement: 0.0,
            uncertainty: None,
            keyframe: false,
            times: StageTimes::default(),
        }
    }

    /// The mask to use for `frame`: its own, or the propagated one.
    fn segment(&mut self, frame: &RgbdFrame) -> Masked {
        if let Some(mask) = frame.mask.as_ref().filter(|m| m.size() == frame.color.size()) {
            self.given = Some((RgbdFrame { mask: None, ..frame.clone() }, mask.clone()));
            self.provenance.given = Some(self.next_index - 1);
            return Masked::Given(mask.clone());
        }
        self.provenance.given = None;
        if let Some((given, mask)) = self.given.take() {
            self.start_segmentation(&given, mask);
        }
        if self.pool.keyframes().is_empty() {
            return Masked::Given(Image::filled(frame.color.width(), frame.color.height(), 0));
        }
        let index = self.next_index - 1;
        let pose = self.motion.predict(index).or_else(|| self.reference.as_ref().map(|r| r.pose));
        let lost = self.reference.as_ref().is_none_or(|r| r.index + 1 < index);
        let prior = Prior {
            cam_from_obj: pose.map(|p| p.inverse()),
            model: &self.surface,
            confidence: if lost { Self::STALE_POSE } else { Self::PREDICTED_POSE },
        };
        Masked::Propagated(self.segmenter.next(frame, &prior))
    }

    /// Starts propagation at the last frame that had a mask of its own, with the pose it was tracked at.
    fn start_segmentation(&mut self, frame: &RgbdFrame, mask: Mask) {
        self.segmenter.start(frame, &mask);
        let prior = Prior {
            cam_from_obj: self.reference.as_ref().map(|r| r.pose.inverse()),
            model: &self.surface,
            confidence: Self::ESTIMATED_POSE,
        };
        self.segmenter.refine(frame, Segmentation::new(mask, 1.0), &prior);
    }

    /// Second pass of a propagated mask, now with the coarse pose: what the pose graph, the pool and the field see.
    fn clean_up(
        &mut self,
        frame: &RgbdFrame,
        masked: Masked,
        coarse: Option<&CoarsePose>,
        observation: Observation,
    ) -> Observation {
        let Masked::Propagated(segmentation) = masked else { return observation };
        let prior = Prior {
            cam_from_obj: coarse.map(|c| c.pose.inverse()),
            model: &self.surface,
            confidence: if coarse.is_some() { Self::ESTIMATED_POSE } else { Self::STALE_POSE },
        };
        let refined = self.segmenter.refine(frame, segmentation, &prior);
        match Observation::new(observation.index, frame, &refined.mask, &self.config) {
            Ok(cleaned) => {
                self.mask = Some(refined.mask);
                cleaned
            }
            Err(_) => observation,
        }
    }
}

fn new_keyframe(
    frame: &RgbdFrame,
    index: usize,
    obj_from_cam: Isometry3<f64>,
    observation: Arc<Observation>,
) -> Keyframe {
    Keyframe { index, id: frame.id.clone(), obj_from_cam, refined_by_field: false, observation }
}

/// A frame's mask and where it comes from.
enum Masked {
    /// It came with the frame.
    Given(Mask),
    /// It was propagated, and can be improved once the pose is known.
    Propagated(Segmentation),
}

impl Masked {
    fn mask(&self) -> &Mask {
        match self {
            Self::Given(mask) => mask,
            Self::Propagated(segmentation) => &segmentation.mask,
        }
    }
}
