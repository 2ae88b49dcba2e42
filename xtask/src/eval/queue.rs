//! Runs jobs in processes of their own, so that one that crashes takes nothing else along.

use super::job::{Build, Job, State};
use anyhow::Context;
use std::fs::File;
use std::io::Read;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// What became of a job.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Outcome {
    /// Its score is on disk; by another build where one is named.
    Done(Option<Build>),
    Failed(String),
    /// The command was stopped before it.
    Stopped,
}

pub(super) struct Queue {
    /// Jobs at a time.
    pub(super) parallel: usize,
    /// Also those that are finished.
    pub(super) force: bool,
    /// Only score what is there.
    pub(super) only_score: bool,
    pub(super) build: Build,
}

impl Queue {
    /// Does all jobs that aren't done; the outcomes in their order. An interrupt ends what is under way.
    pub(super) fn run(&self, jobs: &[Job]) -> anyhow::Result<Vec<Outcome>> {
        let stop = stop_flag()?;
        let (next, started) = (AtomicUsize::new(0), Instant::now());
        let outcomes: Mutex<Vec<Outcome>> = Mutex::new(vec![Outcome::Stopped; jobs.len()]);
        let worker = || {
            loop {
                let index = next.fetch_add(1, Ordering::Relaxed);
                let Some(job) = jobs.get(index).filter(|_| !stop.load(Ordering::Relaxed)) else { return };
                let begin = Instant::now();
                let outcome = self.one(job, &stop);
                let line = summary(job, &outcome, begin.elapsed());
                eprintln!("[{}/{}, {} s] {line}", index + 1, jobs.len(), started.elapsed().as_secs());
                if let Ok(mut all) = outcomes.lock() {
                    all[index] = outcome;
                }
            }
        };
        std::thread::scope(|scope| {
            (0..self.parallel.max(1)).for_each(|_| {
                scope.spawn(worker);
            });
        });
        outcomes.into_inner().ok().context("a thread that waits for jobs has panicked")
    }

    fn one(&self, job: &Job, stop: &AtomicBool) -> Outcome {
        if !self.force
            && !self.only_score
            && let Some(record) = job.finished()
            && job.score().is_ok()
        {
            return Outcome::Done(Some(record.build).filter(|b| *b != self.build));
        }
        if !self.only_score && job.replaces_others() {
            eprintln!("replacing the results in {}, which were asked for otherwise", job.folder.display());
        }
        let attempt = || -> anyhow::Result<Outcome> {
            if !self.only_score {
                job.write(&self.build, State::Open)?;
            }
            let status = self.wait(self.start(job)?, stop)?;
            Ok(match status {
                None => Outcome::Stopped,
                Some(status) if status.success() => Outcome::Done(None),
                Some(status) => Outcome::Failed(last_message(&job.log(), status)),
            })
        };
        let outcome = attempt().unwrap_or_else(|error| Outcome::Failed(format!("{error:#}")));
        let state = match &outcome {
            Outcome::Done(_) => State::Finished,
            Outcome::Failed(error) => State::Failed(error.clone()),
            Outcome::Stopped => State::Open,
        };
        if self.only_score {
            return outcome;
        }
        match job.write(&self.build, state) {
            Ok(()) => outcome,
            Err(error) => Outcome::Failed(format!("{error:#}")),
        }
    }

    fn start(&self, job: &Job) -> anyhow::Result<Child> {
        let log = job.log();
        let file = File::create(&log).with_context(|| format!("{} can't be written", log.display()))?;
        // The running program, even when a newer one has been built in its place.
        let itself = Path::new("/proc/self/exe");
        let program = if itself.exists() { itself.to_owned() } else { std::env::current_exe()? };
        let cores = std::thread::available_parallelism().map_or(1, |n| n.get());
        let mut command = Command::new(program);
        command.args(["eval", "job"]).arg(&job.folder);
        if self.only_score {
            command.arg("--no-run");
        }
        command
            .env("RAYON_NUM_THREADS", (cores / self.parallel.max(1)).max(1).to_string())
            .stdin(Stdio::piped())
            .stdout(file.try_clone()?)
            .stderr(file)
            .spawn()
            .context("the job can't be started")
    }

    /// Waits until the job ends, or ends it; `None` when it was ended.
    fn wait(&self, mut child: Child, stop: &AtomicBool) -> anyhow::Result<Option<ExitStatus>> {
        loop {
            if let Some(status) = child.try_wait()? {
                // The terminal's interrupt may reach the job first.
                std::thread::sleep(Duration::from_millis(20));
                return Ok((status.success() || !stop.load(Ordering::Relaxed)).then_some(status));
            }
            if stop.load(Ordering::Relaxed) {
                let _ = child.kill();
                child.wait()?;
                return Ok(None);
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}

/// Ends this process when the one that started it is gone: its end of the pipe closes then.
pub(super) fn end_with_parent() {
    std::thread::spawn(|| {
        let mut nothing = [0; 1];
        while std::io::stdin().read(&mut nothing).is_ok_and(|n| n > 0) {}
        std::process::exit(1);
    });
}

fn stop_flag() -> anyhow::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = stop.clone();
    ctrlc::set_handler(move || flag.store(true, Ordering::Relaxed)).context("interrupts can't be caught")?;
    Ok(stop)
}

fn summary(job: &Job, outcome: &Outcome, took: Duration) -> String {
    let title = job.title();
    match outcome {
        Outcome::Stopped => format!("{title}: stopped"),
        Outcome::Failed(error) => format!("{title}: failed: {error}"),
        Outcome::Done(_) => match job.score() {
            Err(error) => format!("{title}: {error:#}"),
            Ok(score) => {
                let cd = score.cd_cm.map_or_else(|| "-".into(), |cd| format!("{cd:.2} cm"));
                let numbers = format!("ADD {:.2}, ADD-S {:.2}, CD {cd}", score.add, score.add_s);
                format!("{title}: {numbers} ({:.0} s)", took.as_secs_f64())
            }
        },
    }
}

/// The last line that the job has written, and how it ended.
fn last_message(log: &Path, status: ExitStatus) -> String {
    let text = std::fs::read_to_string(log).unwrap_or_default();
    // A panic ends with a hint.
    let says_something = |l: &&str| !l.is_empty() && !l.starts_with("note: ");
    let last = text.lines().rev().map(str::trim).find(says_something).unwrap_or("no message");
    format!("{last} ({status}, see {})", log.display())
}
