//! Masks from another program.

use std::io::{BufReader, BufWriter};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use mask_tracker::pipe::{PipeError, Reply, Request, read_reply, write_request};
use mask_tracker::{Prior, Propagate, Segmentation, VideoSegmenter, resample};
use rgbd_io::{Error, Mask, RgbdFrame};

use super::OnTrouble;

/// How long the program may take for an answer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Patience {
    /// For the first one, which includes loading a model.
    pub start: Duration,
    /// For each further one.
    pub frame: Duration,
}

impl Default for Patience {
    fn default() -> Self {
        Self { start: Duration::from_secs(180), frame: Duration::from_secs(30) }
    }
}

/// Asks a program that speaks [`mask_tracker::pipe`] for every mask.
///
/// If the program ends, takes too long or answers something else, it is stopped, the built-in segmenter goes on from
/// the last good mask, and the tracker never notices. The program's standard error is passed through.
pub struct CommandSegmenter {
    program: Option<Program>,
    name: String,
    patience: Patience,
    on_trouble: OnTrouble,
    builtin: Propagate,
    /// The last frame that the program gave a mask for.
    last: Option<(RgbdFrame, Mask)>,
}

impl CommandSegmenter {
    /// Starts the program `words[0]` with the arguments that follow.
    ///
    /// # Errors
    /// When it can't be started.
    pub fn spawn(words: &[String], patience: Patience, on_trouble: OnTrouble) -> Result<Self, Error> {
        let (name, arguments) = words.split_first().map_or((String::new(), &[][..]), |(n, a)| (n.clone(), a));
        let program = Program::spawn(&name, arguments).map_err(|error| {
            let remedy = "give --segmenter command: a program that is installed, with its path if need be";
            Error::new(&name, format!("can't be started ({error})"), remedy)
        })?;
        let builtin = Propagate::default();
        Ok(Self { program: Some(program), name, patience, on_trouble, builtin, last: None })
    }

    /// The program's mask, or `None` once it has failed.
    fn ask(&mut self, request: Request, patience: Duration) -> Option<Segmentation> {
        let frame = match &request {
            Request::Start(frame, _) | Request::Frame(frame) => frame.clone(),
        };
        match self.program.as_ref()?.ask(request, patience) {
            Ok(reply) => {
                let found = Segmentation::new(resample(&reply.mask, frame.color.size()), reply.confidence);
                self.last = Some((frame, found.mask.clone()));
                Some(found)
            }
            Err(problem) => {
                (self.on_trouble)(&format!(
                    "segmenter {}, frame {}: {problem}; the built-in segmenter goes on",
                    self.name, frame.id
                ));
                self.program = None;
                if let Some((frame, mask)) = self.last.take() {
                    self.builtin.start(&frame, &mask);
                }
                None
            }
        }
    }
}

impl VideoSegmenter for CommandSegmenter {
    fn start(&mut self, frame: &RgbdFrame, mask: &Mask) {
        self.last = Some((frame.clone(), mask.clone()));
        if self.program.is_none() {
            self.builtin.start(frame, mask);
            return;
        }
        self.ask(Request::Start(frame.clone(), mask.clone()), self.patience.start);
    }

    fn next(&mut self, frame: &RgbdFrame, prior: &Prior<'_>) -> Segmentation {
        match self.ask(Request::Frame(frame.clone()), self.patience.frame) {
            Some(found) => found,
            None => self.builtin.next(frame, prior),
        }
    }

    fn refine(&mut self, frame: &RgbdFrame, found: Segmentation, prior: &Prior<'_>) -> Segmentation {
        if self.program.is_some() { found } else { self.builtin.refine(frame, found, prior) }
    }
}

/// A running program and the thread that talks to it: reading and writing may block for as long as it likes.
struct Program {
    child: Child,
    requests: Option<Sender<Request>>,
    replies: Receiver<Result<Reply, PipeError>>,
}

impl Program {
    fn spawn(name: &str, arguments: &[String]) -> std::io::Result<Self> {
        let mut child =
            Command::new(name).args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let (Some(to), Some(from)) = (child.stdin.take(), child.stdout.take()) else {
            return Err(std::io::ErrorKind::BrokenPipe.into());
        };
        let (requests, inbox) = bounded::<Request>(1);
        let (outbox, replies) = bounded(1);
        std::thread::Builder::new().name("segmenter".into()).spawn(move || {
            let (mut to, mut from) = (BufWriter::new(to), BufReader::new(from));
            for request in inbox {
                // A program that has died breaks the stream in both directions; what it said last comes first.
                let written = write_request(&mut to, &request);
                let reply = match read_reply(&mut from) {
                    Err(PipeError::Ended) if written.is_err() => Err(PipeError::Ended),
                    reply => reply.and_then(|reply| written.map(|()| reply)),
                };
                let failed = reply.is_err();
                if outbox.send(reply).is_err() || failed {
                    return;
                }
            }
        })?;
        Ok(Self { child, requests: Some(requests), replies })
    }

    fn ask(&self, request: Request, patience: Duration) -> Result<Reply, String> {
        let gone = || "the program has ended".to_owned();
        self.requests.as_ref().ok_or_else(gone)?.send(request).map_err(|_| gone())?;
        match self.replies.recv_timeout(patience) {
            Ok(reply) => reply.map_err(|error| error.to_string()),
            Err(RecvTimeoutError::Timeout) => Err(format!("no answer within {} s", patience.as_secs_f64())),
            Err(RecvTimeoutError::Disconnected) => Err(gone()),
        }
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // No more requests ends a well-behaved program; it gets a moment before it is stopped.
        self.requests = None;
        for _ in 0..50 {
            if !matches!(self.child.try_wait(), Ok(None)) {
                return;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        // Both fail only if it has just ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
