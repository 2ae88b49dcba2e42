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
use neural_field::{Control, Device, FieldConfig, TrainedField};

use crate::{
    config::{FieldDevice, GraphConfig},
    global_graph,
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
    pub(crate) fn start(device: FieldDevice) -> Option<Self> {
        let (requests, inbox) = bounded::<FieldRequest>(1);
        let (outbox, replies) = bounded::<FieldReply>(1);
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = stop.clone();
        let body = move || {
            let mut place = Place { wanted: device, opened: None, warning: None };
            for request in inbox {
                if outbox.send(round(&mut place, &request, &stopped)).is_err() {
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

/// Where fields are trained, opened by the first round that needs it.
struct Place {
    wanted: FieldDevice,
    opened: Option<Device>,
    /// Not yet reported.
    warning: Option<String>,
}

impl Place {
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
fn round(place: &mut Place, request: &FieldRequest, stop: &AtomicBool) -> FieldReply {
    let _span = tracing::info_span!("field_round", keyframes = request.frames.len()).entered();
    let start = Instant::now();
    let outcome = catch_unwind(AssertUnwindSafe(|| match &request.round {
        Round::Field(config) => train(place, config, request, stop),
        Round::PoseGraph => {
            let poses: Vec<_> = request.frames.iter().map(|(_, _, pose)| *pose).collect();
            let poses = global_graph::optimise(request, &poses, None)
                .ok_or("the global pose graph could not be solved")?;
            Ok(Outcome {
                poses,
                field: None,
                steps: request.graph.iterations,
                device: String::new(),
                warning: None,
            })
        }
    }));
    let Outcome { poses, field, steps, device, warning } = outcome.map_err(|_| {
        // A driver that fails once fails again: from now on the CPU.
        place.opened = Some(Device::Cpu);
        "the round failed unexpectedly (a panic inside)".to_owned()
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
) -> Result<Outcome, String> {
    let images: Vec<_> = request.frames.iter().map(|(_, seen, _)| seen.images.clone()).collect();
    let poses: Vec<_> = request.frames.iter().map(|(_, _, pose)| *pose).collect();
    let control = Control { stop: Some(stop), progress: None };
    let trained = place.device().train(config, &images, &poses, &control).map_err(|e| e.to_string())?;
    let field = trained.field;
    let joint = global_graph::optimise(request, field.poses(), Some(&field));
    let poses = joint.unwrap_or_else(|| field.poses().to_vec());
    let warning = place.warning.take().or(trained.warning);
    Ok(Outcome { poses, field: Some(field), steps: config.steps, device: trained.device, warning })
}
