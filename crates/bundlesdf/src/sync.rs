//! The threads and channels of [`crate::link`].

pub(crate) use std::sync::{
    Arc,
    atomic::{AtomicBool, Ordering},
    mpsc::{Receiver, SyncSender, TryRecvError, sync_channel},
};
pub(crate) use std::thread::JoinHandle;
use std::{sync::mpsc::RecvTimeoutError, time::Duration};

pub(crate) fn spawn(body: impl FnOnce() + Send + 'static) -> Option<JoinHandle<()>> {
    std::thread::Builder::new().name("field".into()).spawn(body).ok()
}

/// Waits a moment for a message.
pub(crate) fn recv_soon<T>(receiver: &Receiver<T>) -> Result<T, TryRecvError> {
    receiver.recv_timeout(Duration::from_millis(20)).map_err(|e| match e {
        RecvTimeoutError::Timeout => TryRecvError::Empty,
        RecvTimeoutError::Disconnected => TryRecvError::Disconnected,
    })
}
