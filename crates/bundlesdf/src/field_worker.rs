//! The refiner's thread: takes snapshots of the memory pool, runs a round, answers with poses and the field.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use nalgebra::Isometry3;
use neural_field::{Control, FieldConfig, FieldError, TrainedField};

use crate::{
    config::GraphConfig,
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
    pub(crate) fn new(hook: Option<RoundHook>) -> Self {
        let count = AtomicUsize::new(0);
        let work = move |request: FieldRequest, stop: &AtomicBool| {
            let number = count.fetch_add(1, Ordering::Relaxed);
            round(&request, stop, || hook.as_ref().map_or(Ok(()), |hook| hook(number)))
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

fn flatten(reply: Result<FieldReply, Gone>) -> FieldReply {
    reply.unwrap_or_else(|Gone| {
        Err(RoundError::Failed("the field's thread has ended; the next round starts another one".into()))
    })
}

/// Runs one round; a panic inside becomes an error, so that tracking goes on.
fn round(
    request: &FieldRequest,
    stop: &AtomicBool,
    before: impl FnOnce() -> Result<(), String>,
) -> FieldReply {
    let _span = tracing::info_span!("field_round", keyframes = request.frames.len()).entered();
    let start = Instant::now();
    let outcome = catch_unwind(AssertUnwindSafe(|| {
        before().map_err(RoundError::Failed)?;
        match &request.round {
            Round::Field(config) => train(config, request, stop),
            Round::PoseGraph => {
                let poses: Vec<_> = request.frames.iter().map(|(_, _, pose)| *pose).collect();
                let poses = global_graph::optimise(request, &poses, None)
                    .ok_or_else(|| RoundError::Failed("the global pose graph could not be solved".into()))?;
                Ok((poses, None, request.graph.iterations))
            }
        }
    }));
    let (poses, field, steps) = outcome.map_err(|panic| {
        let text = panic.downcast_ref::<&str>().copied();
        let text = text.or_else(|| panic.downcast_ref::<String>().map(String::as_str));
        RoundError::Failed(format!(
            "the round failed unexpectedly (a panic inside: {})",
            text.unwrap_or("no message")
        ))
    })??;
    let poses = request.frames.iter().map(|(index, _, _)| *index).zip(poses).collect();
    Ok(FieldUpdate { poses, field, steps, elapsed: start.elapsed() })
}

type Outcome = (Vec<Isometry3<f64>>, Option<Arc<TrainedField>>, usize);

fn train(config: &FieldConfig, request: &FieldRequest, stop: &AtomicBool) -> Result<Outcome, RoundError> {
    let trained = train_field(config, &request.frames, stop)?;
    let joint = global_graph::optimise(request, trained.poses(), Some(&trained));
    let poses = joint.unwrap_or_else(|| trained.poses().to_vec());
    Ok((poses, Some(Arc::new(trained)), config.steps))
}

/// The field of a round: the same bits whenever it is trained from the same frames.
pub(crate) fn train_field(
    config: &FieldConfig,
    frames: &[(usize, Arc<Observation>, Isometry3<f64>)],
    stop: &AtomicBool,
) -> Result<TrainedField, RoundError> {
    let images: Vec<_> = frames.iter().map(|(_, seen, _)| seen.images.clone()).collect();
    let poses: Vec<_> = frames.iter().map(|(_, _, pose)| *pose).collect();
    let control = Control { stop: Some(stop), progress: None };
    neural_field::train(config, &images, &poses, &control).map_err(|e| match e {
        FieldError::Stopped => RoundError::Stopped,
        e => RoundError::Failed(e.to_string()),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

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
