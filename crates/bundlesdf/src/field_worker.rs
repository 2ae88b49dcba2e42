//! The refiner's thread: takes snapshots of the memory pool, runs a round, answers with poses and the field.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, Mutex, OnceLock, PoisonError,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use nalgebra::Isometry3;
use neural_field::{Control, Device, FieldConfig, FieldError, TrainedField};
use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::{
    config::{FieldDevice, GraphConfig},
    global_graph,
    link::{Gone, Link},
    observation::Observation,
    pool::MemoryEdge,
};

/// What a round does.
pub(crate) enum Round {
    /// Trains a field, which refines the poses; then as [`Round::PoseGraph`], with the field's surface as one more
    /// term: the field sees the whole surface and knows nothing of matches.
    Field(Box<FieldConfig>),
    /// Solves one pose graph over all keyframes.
    PoseGraph,
}

/// An immutable snapshot of the pool.
pub(crate) struct FieldRequest {
    /// What to do.
    pub(crate) round: Round,
    /// Weights of the pose graph over all keyframes.
    pub(crate) graph: GraphConfig,
    /// Cached matches between keyframes by frame index, `(older, newer)`.
    pub(crate) edges: Vec<((usize, usize), MemoryEdge)>,
    /// Frame index, what was seen and current `obj_from_cam`; the first is the anchor.
    pub(crate) frames: Vec<(usize, Arc<Observation>, Isometry3<f64>)>,
}

/// The result of one round.
pub(crate) struct FieldUpdate {
    /// Refined `obj_from_cam` by frame index.
    pub(crate) poses: Vec<(usize, Isometry3<f64>)>,
    /// The trained field, if that was the task.
    pub(crate) field: Option<Arc<TrainedField>>,
    /// The device that trained it; empty without a field.
    pub(crate) device: String,
    /// Why it was not the device asked for.
    pub(crate) warning: Option<String>,
    /// Training steps of the round, or iterations of the pose graph.
    pub(crate) steps: usize,
    /// Time of the round.
    pub(crate) elapsed: Duration,
}

/// Why a round gave no update.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum RoundError {
    /// It was asked to end early.
    Stopped,
    /// It can't be done; the message says why.
    Failed(String),
}

/// A round's outcome.
pub(crate) type FieldReply = Result<FieldUpdate, RoundError>;

/// Called before each round with its number, from 0; what it does befalls the round: an error, a panic.
pub(crate) type RoundHook = Arc<dyn Fn(usize) -> Result<(), String> + Send + Sync>;

/// Owns the thread. One round at a time: [`FieldWorker::is_busy`] tells whether one is under way.
pub(crate) struct FieldWorker {
    link: Link<FieldRequest, FieldReply>,
}

impl FieldWorker {
    /// A worker whose thread starts with the first round.
    pub(crate) fn new(device: FieldDevice, hook: Option<RoundHook>) -> Self {
        let count = AtomicUsize::new(0);
        // One round at a time: nobody waits for the lock, and a device stays open between rounds and threads.
        let place = Mutex::new(Place::new(device));
        let threads = OnceLock::new();
        let work = move |request: FieldRequest, stop: &AtomicBool| {
            let number = count.fetch_add(1, Ordering::Relaxed);
            let mut place = place.lock().unwrap_or_else(PoisonError::into_inner);
            let place = &mut *place;
            let before = || hook.as_ref().map_or(Ok(()), |hook| hook(number));
            let mut round = || round(place, &request, stop, before);
            match threads.get_or_init(own_threads) {
                Some(threads) => threads.install(&mut round),
                None => round(),
            }
        };
        Self { link: Link::new(Arc::new(work)) }
    }

    /// Whether a round is under way or its reply not yet taken.
    pub(crate) fn is_busy(&self) -> bool {
        self.link.is_busy()
    }

    /// Starts a round; ignored while one is under way.
    pub(crate) fn submit(&mut self, request: FieldRequest) -> Result<(), RoundError> {
        self.link.submit(request).map_err(|Gone| {
            RoundError::Failed("the system gives the field no thread; end other programs".into())
        })
    }

    /// The reply of the round under way, if there is one by now.
    pub(crate) fn poll(&mut self) -> Option<FieldReply> {
        self.link.poll().map(flatten)
    }

    /// Waits for the reply of the round under way; `stop` ends it early.
    pub(crate) fn wait(&mut self, stop: &AtomicBool) -> Option<FieldReply> {
        self.link.wait(|| stop.load(Ordering::Relaxed)).map(flatten)
    }
}

/// As many threads as others share, for the field alone: on shared ones every loop of the tracker, tens a frame, would
/// wait until a piece of the field's work is done. `None` where the system gives no more threads.
fn own_threads() -> Option<ThreadPool> {
    let name = |i: usize| format!("field-{i}");
    let threads = ThreadPoolBuilder::new().num_threads(rayon::current_num_threads()).thread_name(name);
    threads.build().ok()
}

fn flatten(reply: Result<FieldReply, Gone>) -> FieldReply {
    reply.unwrap_or_else(|Gone| {
        Err(RoundError::Failed("the field's thread has ended; the next round starts another one".into()))
    })
}

/// Where fields are trained, opened by the first round that needs it.
pub(crate) struct Place {
    wanted: FieldDevice,
    opened: Option<Device>,
    /// Not yet reported.
    warning: Option<String>,
}

impl Place {
    pub(crate) fn new(wanted: FieldDevice) -> Self {
        Self { wanted, opened: None, warning: None }
    }

    /// The device that was asked for, or the CPU with a warning.
    fn device(&mut self) -> &mut Device {
        let wanted = self.wanted;
        let warning = &mut self.warning;
        self.opened.get_or_insert_with(|| {
            let opened = catch_unwind(|| match wanted {
                FieldDevice::Auto => Ok(Device::best()),
                FieldDevice::Cpu => Ok(Device::Cpu),
                FieldDevice::Gpu => Device::gpu(),
            });
            match opened {
                Ok(Ok(device)) => return device,
                Ok(Err(e)) => *warning = Some(format!("{e}; the field is trained on the CPU")),
                Err(_) => *warning = Some("the GPU's driver failed; the field is trained on the CPU".into()),
            }
            Device::Cpu
        })
    }
}

/// Runs one round; a panic inside becomes an error, so that tracking goes on.
fn round(
    place: &mut Place,
    request: &FieldRequest,
    stop: &AtomicBool,
    before: impl FnOnce() -> Result<(), String>,
) -> FieldReply {
    let _span = tracing::info_span!("field_round", keyframes = request.frames.len()).entered();
    let start = Instant::now();
    let outcome = catch_unwind(AssertUnwindSafe(|| {
        before().map_err(RoundError::Failed)?;
        match &request.round {
            Round::Field(config) => train(place, config, request, stop),
            Round::PoseGraph => {
                let poses: Vec<_> = request.frames.iter().map(|(_, _, pose)| *pose).collect();
                let poses = global_graph::optimise(request, &poses, None)
                    .ok_or_else(|| RoundError::Failed("the global pose graph could not be solved".into()))?;
                Ok(Outcome {
                    poses,
                    field: None,
                    steps: request.graph.iterations,
                    device: String::new(),
                    warning: None,
                })
            }
        }
    }));
    let Outcome { poses, field, steps, device, warning } = outcome.map_err(|panic| {
        // A driver that fails once fails again: from now on the CPU.
        place.opened = Some(Device::Cpu);
        let text = panic.downcast_ref::<&str>().copied();
        let text = text.or_else(|| panic.downcast_ref::<String>().map(String::as_str));
        RoundError::Failed(format!(
            "the round failed unexpectedly (a panic inside: {})",
            text.unwrap_or("no message")
        ))
    })??;
    let poses = request.frames.iter().map(|(index, _, _)| *index).zip(poses).collect();
    Ok(FieldUpdate { poses, field, device, warning, steps, elapsed: start.elapsed() })
}

struct Outcome {
    poses: Vec<Isometry3<f64>>,
    field: Option<Arc<TrainedField>>,
    steps: usize,
    device: String,
    warning: Option<String>,
}

fn train(
    place: &mut Place,
    config: &FieldConfig,
    request: &FieldRequest,
    stop: &AtomicBool,
) -> Result<Outcome, RoundError> {
    let (field, device, warning) = train_field(place, config, &request.frames, stop)?;
    let joint = global_graph::optimise(request, field.poses(), Some(&field));
    let poses = joint.unwrap_or_else(|| field.poses().to_vec());
    let warning = place.warning.take().or(warning);
    Ok(Outcome { poses, field: Some(field), steps: config.steps, device, warning })
}

/// The field of a round, the device that trained it, and why it wasn't the one asked for. On the CPU it is the same
/// bits whenever it is trained from the same frames.
pub(crate) fn train_field(
    place: &mut Place,
    config: &FieldConfig,
    frames: &[(usize, Arc<Observation>, Isometry3<f64>)],
    stop: &AtomicBool,
) -> Result<(Arc<TrainedField>, String, Option<String>), RoundError> {
    let images: Vec<_> = frames.iter().map(|(_, seen, _)| seen.images.clone()).collect();
    let poses: Vec<_> = frames.iter().map(|(_, _, pose)| *pose).collect();
    let control = Control { stop: Some(stop), progress: None };
    let trained = place.device().train(config, &images, &poses, &control).map_err(|e| match e {
        FieldError::Stopped => RoundError::Stopped,
        e => RoundError::Failed(e.to_string()),
    })?;
    Ok((trained.field, trained.device, trained.warning))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounds_have_threads_of_their_own() {
        let name = Arc::new(Mutex::new(None));
        let seen = name.clone();
        let hook: RoundHook = Arc::new(move |_| {
            *seen.lock().unwrap() =
                rayon::current_thread_index().and(std::thread::current().name().map(String::from));
            Err("enough".into())
        });
        let mut worker = FieldWorker::new(FieldDevice::Cpu, Some(hook));
        let (graph, round) = (GraphConfig::default(), Round::PoseGraph);
        worker.submit(FieldRequest { round, graph, edges: Vec::new(), frames: Vec::new() }).unwrap();
        assert!(worker.wait(&AtomicBool::new(false)).unwrap().is_err());
        assert!(name.lock().unwrap().as_ref().is_some_and(|n| n.starts_with("field-")));
    }

    #[test]
    fn a_thread_that_ended_is_reported_and_the_next_job_starts_another() {
        let work = |job: usize, _: &AtomicBool| {
            assert_ne!(job, 1, "ends the thread");
            job
        };
        let mut link = Link::new(Arc::new(work));
        for (job, reply) in [(0, Ok(0)), (1, Err(Gone)), (2, Ok(2)), (3, Ok(3))] {
            link.submit(job).unwrap();
            assert_eq!(link.wait(|| false), Some(reply));
            assert!(!link.is_busy());
        }
        link.submit(1).unwrap();
        let polled = loop {
            if let Some(reply) = link.poll() {
                break reply;
            }
        };
        assert_eq!(polled, Err(Gone));
        link.submit(4).unwrap();
        assert_eq!(link.wait(|| false), Some(Ok(4)));
    }
}
