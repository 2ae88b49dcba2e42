//! Decoding ahead of the caller.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};

use crate::{Error, FrameSource, RgbdFrame};

/// Reads frames of a source in a given order, on a thread of its own that stays up to `ahead` frames in front.
///
/// An iterator over `(index, frame)`, one item for each index asked for, in their order. A frame that can't be
/// read is an `Err` item and doesn't end the sequence; neither does a panic in the source, which becomes one.
///
/// Dropping it never waits: the thread notices at its next frame that nobody listens, and ends.
#[derive(Debug)]
pub struct ReadAhead<S: ?Sized> {
    source: Arc<S>,
    indices: std::vec::IntoIter<usize>,
    frames: Option<Receiver<Result<RgbdFrame, Error>>>,
}

impl<S: FrameSource + ?Sized + 'static> ReadAhead<S> {
    /// Starts reading the frames `indices` of `source`; at most `ahead` (at least one) decoded frames wait, and
    /// one more is being decoded.
    pub fn new(source: Arc<S>, indices: impl IntoIterator<Item = usize>, ahead: usize) -> Self {
        let indices: Vec<usize> = indices.into_iter().collect();
        let (sender, receiver) = sync_channel(ahead.max(1));
        let (worker_source, worker_indices) = (Arc::clone(&source), indices.clone());
        let worker = std::thread::Builder::new().name("read-ahead".into()).spawn(move || {
            for index in worker_indices {
                // Fails when the receiver is gone, also while waiting for a free slot.
                if sender.send(guarded(&*worker_source, index)).is_err() {
                    return;
                }
            }
        });
        // Without a thread the frames are read when they are asked for.
        let frames = worker.is_ok().then_some(receiver);
        Self { source, indices: indices.into_iter(), frames }
    }
}

impl<S: FrameSource + ?Sized + 'static> Iterator for ReadAhead<S> {
    type Item = (usize, Result<RgbdFrame, Error>);

    fn next(&mut self) -> Option<Self::Item> {
        let index = self.indices.next()?;
        let received = self.frames.as_ref().and_then(|frames| frames.recv().ok());
        Some((index, received.unwrap_or_else(|| guarded(&*self.source, index))))
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        self.indices.size_hint()
    }
}

impl<S: FrameSource + ?Sized + 'static> ExactSizeIterator for ReadAhead<S> {}

/// Reads one frame; a panic on the way becomes an error.
fn guarded<S: FrameSource + ?Sized>(source: &S, index: usize) -> Result<RgbdFrame, Error> {
    // The source is only read, and a frame under construction is dropped: nothing half-changed is seen later.
    catch_unwind(AssertUnwindSafe(|| source.frame(index))).unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<&str>().copied();
        let text =
            text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("no message");
        Err(Error::new(
            format!("frame {index}"),
            format!("its decoder panicked ({text})"),
            "export this frame's files again, or leave the frame out",
        ))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Image, Intrinsics};
    use std::sync::atomic::{AtomicUsize, Ordering};

    struct Source {
        panics_at: usize,
        reads: AtomicUsize,
    }

    impl FrameSource for Source {
        fn len(&self) -> usize {
            50
        }

        fn id(&self, _: usize) -> &str {
            "x"
        }

        fn frame(&self, index: usize) -> Result<RgbdFrame, Error> {
            self.reads.fetch_add(1, Ordering::SeqCst);
            assert_ne!(index, self.panics_at, "boom");
            if index == 7 {
                return Err(Error::new("7.png", "is missing", "export it"));
            }
            Ok(RgbdFrame {
                id: index.to_string(),
                color: Image::default(),
                depth: Image::default(),
                mask: None,
                intrinsics: Intrinsics { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 },
            })
        }
    }

    fn source(panics_at: usize) -> Arc<Source> {
        Arc::new(Source { panics_at, reads: AtomicUsize::new(0) })
    }

    #[test]
    fn keeps_the_order_and_survives_errors_and_panics() {
        for ahead in [0, 1, 3, 1000] {
            let order = [3, 1, 7, 9, 9, 49, 0];
            let read = ReadAhead::new(source(9), order, ahead);
            assert_eq!(read.len(), order.len());
            let read: Vec<_> = read.collect();
            assert_eq!(read.iter().map(|r| r.0).collect::<Vec<_>>(), order);
            for (index, frame) in read {
                match index {
                    7 => assert_eq!(frame.unwrap_err().to_string(), "7.png: is missing; export it"),
                    9 => assert!(frame.unwrap_err().to_string().contains("boom")),
                    _ => assert_eq!(frame.unwrap().id, index.to_string()),
                }
            }
        }
    }

    #[test]
    fn reads_no_further_than_asked() {
        let source = source(usize::MAX);
        let mut read = ReadAhead::new(Arc::clone(&source), 0..50, 2);
        assert_eq!(read.next().unwrap().0, 0);
        assert_eq!(read.next().unwrap().0, 1);
        // Two taken, two waiting, one in the hand of the thread.
        std::thread::sleep(std::time::Duration::from_millis(50));
        assert!(source.reads.load(Ordering::SeqCst) <= 5);
    }

    #[test]
    fn dropping_early_ends_the_thread() {
        for taken in 0..4 {
            let source = source(2);
            let mut read = ReadAhead::new(Arc::clone(&source) as Arc<dyn FrameSource>, 0..50, 1);
            for _ in 0..taken {
                read.next();
            }
            drop(read);
            let start = std::time::Instant::now();
            while Arc::strong_count(&source) > 1 && start.elapsed().as_secs() < 60 {
                std::thread::yield_now();
            }
            assert_eq!(Arc::strong_count(&source), 1, "the thread still holds the source");
        }
    }
}
