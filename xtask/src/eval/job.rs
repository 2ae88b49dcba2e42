//! One job: a method on a sequence. What was asked lies beside the results, so that a finished job isn't run again.

use super::method::Method;
use super::score::{self, Score};
use super::track;
use super::video::{Masks, Place};
use anyhow::Context;
use bundlesdf::{Config, Schedule};
use rgbd_io::poses::write_atomic;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// What is asked for. Two jobs with the same one have the same results, up to the program that ran them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Asked {
    pub(super) method: Method,
    pub(super) place: Place,
    /// Counted from 0; added to the seed.
    pub(super) repeat: u64,
    pub(super) masks: Masks,
    /// Of our tracker; `None` for the baselines, which have numbers of their own.
    pub(super) schedule: Option<Schedule>,
    pub(super) config: Option<Config>,
    /// Python of a method that is written in it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) python: Option<PathBuf>,
}

/// The program that ran a job.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Build {
    pub(super) version: String,
    /// Of the working tree at the start; `None` outside a repository. Ends in `+` when files were changed.
    pub(super) commit: Option<String>,
}

/// How far a job has got.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum State {
    /// Asked for, under way, or killed.
    Open,
    Finished,
    Failed(String),
}

/// The content of `job.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Record {
    pub(super) asked: Asked,
    pub(super) build: Build,
    pub(super) state: State,
}

const RECORD: &str = "job.json";
const SCORE: &str = "score.json";

/// A job and the folder of its results.
#[derive(Clone, Debug)]
pub(super) struct Job {
    pub(super) asked: Asked,
    pub(super) folder: PathBuf,
}

impl Job {
    /// `out/<benchmark>/<method>/<sequence>`, with `/repeat-k` where there are several.
    pub(super) fn new(asked: Asked, out: &Path, repeats: u64) -> Self {
        let place = &asked.place;
        let mut folder = out.join(place.benchmark.name()).join(asked.method.name());
        folder.extend(place.name.split('/'));
        if repeats > 1 {
            folder.push(format!("repeat-{}", asked.repeat + 1));
        }
        Self { asked, folder }
    }

    /// Name for messages.
    pub(super) fn title(&self) -> String {
        let repeat =
            if self.asked.repeat > 0 { format!(" #{}", self.asked.repeat + 1) } else { String::new() };
        format!("{} on {}{repeat}", self.asked.method.name(), self.asked.place.name)
    }

    /// The record of a finished job that asked for the same.
    pub(super) fn finished(&self) -> Option<Record> {
        let record: Record = read_json(&self.folder.join(RECORD)).ok()?;
        (record.state == State::Finished && same(&record.asked, &self.asked)).then_some(record)
    }

    /// Whether the folder holds the results of a finished job that asked for something else.
    pub(super) fn replaces_others(&self) -> bool {
        let record: Option<Record> = read_json(&self.folder.join(RECORD)).ok();
        record.is_some_and(|r| r.state == State::Finished && !same(&r.asked, &self.asked))
    }

    pub(super) fn write(&self, build: &Build, state: State) -> anyhow::Result<()> {
        std::fs::create_dir_all(&self.folder).with_context(|| {
            format!("{} can't be created; choose another folder with --out", self.folder.display())
        })?;
        let record = Record { asked: self.asked.clone(), build: build.clone(), state };
        write_json(&self.folder.join(RECORD), &record)
    }

    pub(super) fn score(&self) -> anyhow::Result<Score> {
        read_json(&self.folder.join(SCORE))
    }

    /// Where its messages go.
    pub(super) fn log(&self) -> PathBuf {
        self.folder.join("log.txt")
    }
}

/// Runs (unless `only_score`) and scores the job that a folder's `job.json` asks for.
pub(super) fn work(folder: &Path, only_score: bool) -> anyhow::Result<()> {
    let record: Record = read_json(&folder.join(RECORD))?;
    if !only_score {
        let _ = std::fs::remove_file(folder.join(SCORE));
        track::track(&record.asked, folder)?;
    }
    write_json(&folder.join(SCORE), &score::score(&record.asked, folder)?)
}

/// By their text: numbers that went through JSON needn't be equal bit by bit.
fn same(a: &Asked, b: &Asked) -> bool {
    let text = |asked: &Asked| serde_json::to_string(asked).ok();
    text(a).is_some() && text(a) == text(b)
}

pub(super) fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> anyhow::Result<T> {
    let text = std::fs::read_to_string(path).with_context(|| format!("{} can't be read", path.display()))?;
    serde_json::from_str(&text).with_context(|| format!("{} isn't what this version writes", path.display()))
}

pub(super) fn write_json(path: &Path, value: &impl Serialize) -> anyhow::Result<()> {
    let text = serde_json::to_string_pretty(value)? + "\n";
    write_atomic(path, text.as_bytes()).map_err(Into::into)
}

#[cfg(test)]
mod tests {
    use super::super::benchmark::Benchmark;
    use super::*;

    fn asked() -> Asked {
        let place = Place {
            benchmark: Benchmark::Bop,
            root: "data".into(),
            name: "test/000001".into(),
            models: None,
            object: Some(3),
            stride: 2,
        };
        Asked {
            method: Method::Ours,
            place,
            repeat: 0,
            masks: Masks::First,
            schedule: Some(Schedule::Lockstep),
            config: Some(Config::default()),
            python: None,
        }
    }

    #[test]
    fn only_a_finished_job_that_asked_for_the_same_counts() {
        let dir = tempfile::tempdir().unwrap();
        let build = Build { version: "1".into(), commit: None };
        let job = Job::new(asked(), dir.path(), 1);
        assert!(job.folder.ends_with("bop/ours/test/000001"));
        assert!(job.finished().is_none() && !job.replaces_others());
        for state in [State::Open, State::Failed("no mask".into())] {
            job.write(&build, state).unwrap();
            assert!(job.finished().is_none() && !job.replaces_others());
        }
        job.write(&build, State::Finished).unwrap();
        assert_eq!(job.finished().unwrap().build, build);
        let mut config = Config::default();
        config.field.steps += 1;
        for other in [
            Asked { masks: Masks::Given, ..asked() },
            Asked { config: Some(config), ..asked() },
            Asked { repeat: 1, ..asked() },
            Asked { schedule: Some(Schedule::Realtime), ..asked() },
            Asked { place: Place { stride: 1, ..asked().place }, ..asked() },
        ] {
            let other = Job::new(other, dir.path(), 1);
            assert!(other.finished().is_none() && other.replaces_others());
        }
        // Repeats have folders of their own.
        assert!(Job::new(Asked { repeat: 1, ..asked() }, dir.path(), 2).folder.ends_with("000001/repeat-2"));
    }
}
