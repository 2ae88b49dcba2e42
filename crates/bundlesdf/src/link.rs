//! One worker thread, one job at a time: how the tracker and the field take turns.
//!
//! This file names no thread and no channel of its own; both come from `super::sync`. The program gives it those of
//! the standard library, `tests/protocol.rs` those of a model checker, so that what is checked is what runs.

use super::sync::{
    Arc, AtomicBool, JoinHandle, Ordering, Receiver, SyncSender, TryRecvError, recv_soon, spawn, sync_channel,
};

/// What the thread does with a job; it should end early when the flag becomes true.
pub(crate) type Work<Job, Reply> = dyn Fn(Job, &AtomicBool) -> Reply + Send + Sync;

/// The thread ended in the middle of a job, or could not be started.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Gone;

/// A thread and the two channels to it.
struct Lane<Job, Reply> {
    jobs: SyncSender<Job>,
    replies: Receiver<Reply>,
    thread: JoinHandle<()>,
}

/// The tracker's end. The thread is started with the first job, and again after one that ended it.
pub(crate) struct Link<Job, Reply> {
    work: Arc<Work<Job, Reply>>,
    stop: Arc<AtomicBool>,
    lane: Option<Lane<Job, Reply>>,
    busy: bool,
}

impl<Job, Reply> Link<Job, Reply> {
    /// Whether a job is under way or its reply not yet taken.
    pub(crate) fn is_busy(&self) -> bool {
        self.busy
    }

    fn close(&mut self) {
        self.busy = false;
        if let Some(Lane { jobs, replies, thread }) = self.lane.take() {
            drop(jobs);
            // There is room for the one reply that may be left, so the thread can't hang in sending it. That a job
            // panicked is told by its missing reply.
            let _ = thread.join();
            drop(replies);
        }
    }
}

impl<Job: Send + 'static, Reply: Send + 'static> Link<Job, Reply> {
    /// A link without a thread yet.
    pub(crate) fn new(work: Arc<Work<Job, Reply>>) -> Self {
        Self { work, stop: Arc::new(AtomicBool::new(false)), lane: None, busy: false }
    }

    /// Hands a job over; nothing happens while one is under way.
    pub(crate) fn submit(&mut self, mut job: Job) -> Result<(), Gone> {
        if self.busy {
            return Ok(());
        }
        self.stop.store(false, Ordering::SeqCst);
        // A second try, if the thread has ended since the last reply.
        for _ in 0..2 {
            let lane = match self.lane.take() {
                Some(lane) => lane,
                None => self.open()?,
            };
            let sent = lane.jobs.send(job);
            self.lane = Some(lane);
            match sent {
                Ok(()) => {
                    self.busy = true;
                    return Ok(());
                }
                Err(unsent) => job = unsent.0,
            }
            self.close();
        }
        Err(Gone)
    }

    /// The reply, if there is one by now.
    pub(crate) fn poll(&mut self) -> Option<Result<Reply, Gone>> {
        if !self.busy {
            return None;
        }
        let received = self.lane.as_ref().map_or(Err(TryRecvError::Disconnected), |l| l.replies.try_recv());
        self.received(received)
    }

    /// Waits for the reply; once `cancelled` says so, the job is asked to end early.
    pub(crate) fn wait(&mut self, cancelled: impl Fn() -> bool) -> Option<Result<Reply, Gone>> {
        while self.busy {
            let received =
                self.lane.as_ref().map_or(Err(TryRecvError::Disconnected), |l| recv_soon(&l.replies));
            if let Some(reply) = self.received(received) {
                return Some(reply);
            }
            if cancelled() {
                self.stop.store(true, Ordering::SeqCst);
            }
        }
        None
    }

    fn received(&mut self, received: Result<Reply, TryRecvError>) -> Option<Result<Reply, Gone>> {
        match received {
            Ok(reply) => {
                self.busy = false;
                Some(Ok(reply))
            }
            Err(TryRecvError::Empty) => None,
            Err(TryRecvError::Disconnected) => {
                self.close();
                Some(Err(Gone))
            }
        }
    }

    fn open(&self) -> Result<Lane<Job, Reply>, Gone> {
        let (jobs, inbox) = sync_channel::<Job>(1);
        let (outbox, replies) = sync_channel::<Reply>(1);
        let (work, stop) = (self.work.clone(), self.stop.clone());
        let body = move || {
            while let Ok(job) = inbox.recv() {
                if outbox.send(work(job, &stop)).is_err() {
                    break;
                }
            }
        };
        Ok(Lane { jobs, replies, thread: spawn(body).ok_or(Gone)? })
    }
}

impl<Job, Reply> Drop for Link<Job, Reply> {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::SeqCst);
        self.close();
    }
}
