//! The refiner's thread: takes snapshots of the memory pool, runs a round, answers with poses and the field.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use crossbeam_channel::{Receiver, Sender, bounded};
use nalgebra::Isometry3;
use neural_field::{Control, FieldConfig, TrainedField};

use crate::{config::GraphConfig, global_graph, observation::Observation, pool::MemoryEdge};

/// What a round does.
pub(crate) enum Round {
    /// Trains a field, which refines the poses; then as [`Round::PoseGraph`], with the field's surface as one more
    /// term: the field sees the whole surface and knows nothing of matches.
    Field(FieldConfig),
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
    /// Training steps of the round, or iterations of the pose graph.
    pub(crate) steps: usize,
    /// Time of the round.
    pub(crate) elapsed: Duration,
}

/// A round's outcome; the message says why there is no update.
pub(crate) type FieldReply = Result<FieldUpdate, String>;

/// Owns the thread. One round at a time: [`FieldWorker::is_busy`] tells whether one is under way.
pub(crate) struct FieldWorker {
    requests: Option<Sender<FieldRequest>>,
    replies: Receiver<FieldReply>,
    stop: Arc<AtomicBool>,
    busy: bool,
    thread: Option<JoinHandle<()>>,
}

impl FieldWorker {
    /// Starts the thread; `None` when the system gives no thread.
    pub(crate) fn start() -> Option<Self> {
        let (requests, inbox) = bounded::<FieldRequest>(1);
        let (outbox, replies) = bounded::<FieldReply>(1);
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = stop.clone();
        let body = move || {
            for request in inbox {
                if outbox.send(round(&request, &stopped)).is_err() {
                    break;
                }
            }
        };
        let thread = std::thread::Builder::new().name("field".into()).spawn(body).ok()?;
        Some(Self { requests: Some(requests), replies, stop, busy: false, thread: Some(thread) })
    }

    /// Whether a round is under way or its reply not yet taken.
    pub(crate) fn is_busy(&self) -> bool {
        self.busy
    }

    /// Starts a round; ignored while one is under way.
    pub(crate) fn submit(&mut self, request: FieldRequest) {
        if !self.busy
            && let Some(requests) = &self.requests
        {
            self.busy = requests.send(request).is_ok();
        }
    }

    /// The reply of the round under way: at once if there is one, or after waiting for it.
    pub(crate) fn take(&mut self, wait: bool) -> Option<FieldReply> {
        if !self.busy {
            return None;
        }
        let reply = if wait {
            self.replies.recv().unwrap_or_else(|_| Err("the field's thread has ended".into()))
        } else {
            match self.replies.try_recv() {
                Ok(reply) => reply,
                Err(crossbeam_channel::TryRecvError::Empty) => return None,
                Err(crossbeam_channel::TryRecvError::Disconnected) => {
                    Err("the field's thread has ended".into())
                }
            }
        };
        self.busy = false;
        Some(reply)
    }
}

impl Drop for FieldWorker {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.requests = None;
        if let Some(thread) = self.thread.take() {
            // The thread catches its own panics, so there is nothing to report from the join.
            let _ = thread.join();
        }
    }
}

/// Runs one round; a panic inside becomes an error, so that tracking goes on.
fn round(request: &FieldRequest, stop: &AtomicBool) -> FieldReply {
    let _span = tracing::info_span!("field_round", keyframes = request.frames.len()).entered();
    let start = Instant::now();
    let outcome = catch_unwind(AssertUnwindSafe(|| match &request.round {
        Round::Field(config) => train(config, request, stop),
        Round::PoseGraph => {
            let poses: Vec<_> = request.frames.iter().map(|(_, _, pose)| *pose).collect();
            let poses = global_graph::optimise(request, &poses, None)
                .ok_or("the global pose graph could not be solved")?;
            Ok((poses, None, request.graph.iterations))
        }
    }));
    let (poses, field, steps) =
        outcome.map_err(|_| "the round failed unexpectedly (a panic inside)".to_owned())??;
    let poses = request.frames.iter().map(|(index, _, _)| *index).zip(poses).collect();
    Ok(FieldUpdate { poses, field, steps, elapsed: start.elapsed() })
}

type Outcome = (Vec<Isometry3<f64>>, Option<Arc<TrainedField>>, usize);

fn train(config: &FieldConfig, request: &FieldRequest, stop: &AtomicBool) -> Result<Outcome, String> {
    let images: Vec<_> = request.frames.iter().map(|(_, seen, _)| seen.images.clone()).collect();
    let poses: Vec<_> = request.frames.iter().map(|(_, _, pose)| *pose).collect();
    let control = Control { stop: Some(stop), progress: None };
    let trained = neural_field::train(config, &images, &poses, &control).map_err(|e| e.to_string())?;
    let joint = global_graph::optimise(request, trained.poses(), Some(&trained));
    let poses = joint.unwrap_or_else(|| trained.poses().to_vec());
    Ok((poses, Some(Arc::new(trained)), config.steps))
}
