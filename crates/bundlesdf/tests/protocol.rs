//! The protocol between tracker and field under a model checker: the very source file that runs, with the threads
//! and channels of `shuttle`, over many schedules.
#![allow(clippy::unwrap_used, dead_code, unreachable_pub)]

/// What `src/link.rs` asks for, from the model checker.
mod sync {
    pub(crate) use shuttle::sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
        mpsc::{Receiver, SyncSender, sync_channel},
    };
    pub(crate) use shuttle::thread::JoinHandle;
    pub(crate) use std::sync::mpsc::TryRecvError;

    pub(crate) fn spawn(body: impl FnOnce() + Send + 'static) -> Option<JoinHandle<()>> {
        Some(shuttle::thread::spawn(body))
    }

    /// Time does not pass in the model: a moment is any other thread's step.
    pub(crate) fn recv_soon<T>(receiver: &Receiver<T>) -> Result<T, TryRecvError> {
        shuttle::thread::yield_now();
        receiver.try_recv()
    }
}

#[path = "../src/link.rs"]
mod link;

use link::Link;
use shuttle::sync::{
    Arc,
    atomic::{AtomicBool, AtomicUsize, Ordering},
};

/// Schedules tried per test.
const SCHEDULES: usize = 2_000;

/// A link whose jobs answer their own number, and count how many run at once.
fn numbers() -> (Link<usize, usize>, Arc<AtomicUsize>) {
    let running = Arc::new(AtomicUsize::new(0));
    let inside = running.clone();
    let work = move |job: usize, _: &AtomicBool| {
        assert_eq!(inside.fetch_add(1, Ordering::SeqCst), 0, "two jobs at once");
        shuttle::thread::yield_now();
        inside.fetch_sub(1, Ordering::SeqCst);
        job
    };
    (Link::new(Arc::new(work)), running)
}

#[test]
fn a_tracker_that_polls_gets_every_reply_once_and_in_order() {
    shuttle::check_random(
        || {
            let (mut link, _) = numbers();
            let (mut sent, mut received) = (Vec::new(), Vec::new());
            for frame in 0..6 {
                if let Some(reply) = link.poll() {
                    received.push(reply.unwrap());
                }
                if !link.is_busy() {
                    link.submit(frame).unwrap();
                    sent.push(frame);
                }
                shuttle::thread::yield_now();
            }
            if let Some(reply) = link.wait(|| false) {
                received.push(reply.unwrap());
            }
            assert_eq!(sent, received);
            assert!(!link.is_busy() && link.poll().is_none());
        },
        SCHEDULES,
    );
}

#[test]
fn a_tracker_that_waits_never_hangs() {
    shuttle::check_random(
        || {
            let (mut link, _) = numbers();
            for frame in 0..4 {
                link.submit(frame).unwrap();
                // A job handed over while one is under way is ignored.
                link.submit(99).unwrap();
                assert_eq!(link.wait(|| false).unwrap(), Ok(frame));
                assert!(link.wait(|| false).is_none());
            }
        },
        SCHEDULES,
    );
}

#[test]
fn dropping_the_tracker_at_any_moment_ends_the_thread() {
    shuttle::check_random(
        || {
            let (mut link, running) = numbers();
            link.submit(1).unwrap();
            if shuttle::rand::Rng::gen_bool(&mut shuttle::rand::thread_rng(), 0.5) {
                shuttle::thread::yield_now();
                let _ = link.poll();
            }
            drop(link);
            // The thread was joined: nothing is running, and nothing will.
            assert_eq!(running.load(Ordering::SeqCst), 0);
        },
        SCHEDULES,
    );
}

#[test]
fn a_cancelled_job_ends_and_the_next_one_is_not_cancelled() {
    shuttle::check_random(
        || {
            // Runs until told to stop, unless it is the second job.
            let work = |job: usize, stop: &AtomicBool| {
                while job == 0 && !stop.load(Ordering::SeqCst) {
                    shuttle::thread::yield_now();
                }
                (job, stop.load(Ordering::SeqCst))
            };
            let mut link = Link::new(Arc::new(work));
            link.submit(0).unwrap();
            assert_eq!(link.wait(|| true).unwrap(), Ok((0, true)));
            link.submit(1).unwrap();
            assert_eq!(link.wait(|| false).unwrap(), Ok((1, false)));
        },
        500,
    );
}
