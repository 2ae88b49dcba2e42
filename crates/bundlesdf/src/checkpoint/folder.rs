//! The `state/` folder of an output folder: manifest, frame journal and the two newest checkpoints of a run that is
//! not done yet.

use std::{
    fs::{self, File, OpenOptions, TryLockError},
    io::{Seek, SeekFrom, Write},
    path::{Path, PathBuf},
    time::Duration,
};

use mask_tracker::VideoSegmenter;
use rgbd_io::{Error, FrameSource, poses::write_atomic};
use serde::{Deserialize, Serialize};

use super::{PoseBits, bits, pose};
use crate::{
    config::{Config, Schedule},
    input::VideoInput,
    segmenter::SegmenterChoice,
    tracker::{FrameResult, StageTimes, Status, Uncertainty},
    video::RunSoFar,
};

const FOLDER: &str = "state";
const MANIFEST: &str = "manifest.json";
const JOURNAL: &str = "frames.bin";
/// The newest checkpoint, then the one before it.
const CHECKPOINTS: [&str; 2] = ["checkpoint.bin", "checkpoint.1.bin"];
const LOCK: &str = "lock";

/// What a run was started with: all that is needed to go on with it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Version of this crate.
    pub version: String,
    /// Where the frames come from.
    pub input: VideoInput,
    /// The config, defaults included.
    pub config: Config,
    /// How the tracker and the field take turns.
    pub schedule: Schedule,
    /// Where masks come from that the video doesn't have.
    pub segmenter: SegmenterChoice,
    /// Number of frames of the video.
    pub frames: usize,
    /// Checksum of the frames' names.
    pub names: u32,
}

impl Manifest {
    /// The manifest of a new run.
    #[must_use]
    pub fn new(
        input: &VideoInput,
        (config, schedule, segmenter): (&Config, Schedule, &SegmenterChoice),
        source: &dyn FrameSource,
    ) -> Self {
        Self {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            input: input.clone(),
            config: config.clone(),
            schedule,
            segmenter: segmenter.clone(),
            frames: source.len(),
            names: names(source),
        }
    }

    /// Opens the video again.
    ///
    /// # Errors
    /// When it can't be opened, or isn't the video that the run began with.
    pub fn open_input(&self) -> Result<std::sync::Arc<dyn FrameSource>, Error> {
        let source = self.input.open()?;
        if source.len() == self.frames && names(&source) == self.names {
            return Ok(source);
        }
        let problem = format!(
            "has {} frames and had {} when the run began, or they have other names",
            source.len(),
            self.frames
        );
        Err(Error::new(self.input.name(), problem, "put the frames back, or start again with `run --force`"))
    }
}

fn names(source: &dyn FrameSource) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    for index in 0..source.len() {
        hasher.update(source.id(index).as_bytes());
        hasher.update(b"\n");
    }
    hasher.finalize()
}

/// How far an earlier run came.
#[derive(Debug, Default)]
pub struct Earlier {
    /// Where to go on; `None` when nothing usable was saved.
    pub run: Option<RunSoFar>,
    /// Why newer checkpoints, if there are any, could not be used.
    pub unusable: Vec<String>,
}

/// The folder `state/` of a run under way. It is locked for as long as this lives.
#[derive(Debug)]
pub struct StateFolder {
    root: PathBuf,
    journal: File,
    _lock: File,
}

impl StateFolder {
    /// Starts the state of a new run in the output folder `out`.
    ///
    /// # Errors
    /// When it can't be written, or another process is writing to the folder.
    pub fn create(out: &Path, manifest: &Manifest) -> Result<Self, Error> {
        let root = out.join(FOLDER);
        fs::create_dir_all(&root).map_err(|e| failed(&root, &e))?;
        let lock = lock(&root)?;
        let mut text = serde_json::to_vec_pretty(manifest).map_err(|e| {
            Error::new(&root, format!("can't be put into JSON ({e})"), "report this as a bug")
        })?;
        text.push(b'\n');
        write_atomic(&root.join(MANIFEST), &text)?;
        let path = root.join(JOURNAL);
        let journal = File::create(&path).map_err(|e| failed(&path, &e))?;
        Ok(Self { root, journal, _lock: lock })
    }

    /// Opens the state of a run that was stopped.
    ///
    /// # Errors
    /// When there is none, it is of another version, or another process is writing to the folder.
    pub fn open(out: &Path) -> Result<(Self, Manifest), Error> {
        let root = out.join(FOLDER);
        let path = root.join(MANIFEST);
        let again = "start the run again with `bundlesdf run --force`";
        let text = fs::read_to_string(&path)
            .map_err(|e| Error::new(&path, format!("tells of no run to go on with ({e})"), again))?;
        let manifest: Manifest = serde_json::from_str(&text)
            .map_err(|e| Error::new(&path, format!("isn't what this version writes ({e})"), again))?;
        if manifest.version != env!("CARGO_PKG_VERSION") {
            let problem = format!("was written by version {}", manifest.version);
            return Err(Error::new(&path, problem, format!("go on with that version, or {again}")));
        }
        let lock = lock(&root)?;
        let path = root.join(JOURNAL);
        let journal = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&path);
        let journal = journal.map_err(|e| failed(&path, &e))?;
        Ok((Self { root, journal, _lock: lock }, manifest))
    }

    /// Adds the result of a frame to the journal; `unreadable` tells why its files could not be read.
    ///
    /// # Errors
    /// When the disk is full or the folder gone.
    pub fn append(&mut self, result: &FrameResult, unreadable: Option<&Error>) -> Result<(), Error> {
        let path = self.root.join(JOURNAL);
        let payload = postcard::to_stdvec(&SavedFrame::of(result, unreadable))
            .map_err(|e| Error::new(&path, format!("can't be put together ({e})"), "report this as a bug"))?;
        let mut record = Vec::with_capacity(8 + payload.len());
        record.extend_from_slice(&(payload.len() as u32).to_le_bytes());
        record.extend_from_slice(&crc32fast::hash(&payload).to_le_bytes());
        record.extend_from_slice(&payload);
        // One call, so that a process that is killed leaves a whole record or a torn last one.
        self.journal.write_all(&record).map_err(|e| failed(&path, &e))?;
        // A folder that was taken away takes writes to an open file all the same.
        if path.exists() {
            return Ok(());
        }
        Err(Error::new(path, "was removed during the run", "leave the output folder alone, and start again"))
    }

    /// Writes a checkpoint; the one before it is kept.
    ///
    /// # Errors
    /// When the disk is full or the folder gone.
    pub fn write(&self, checkpoint: &[u8]) -> Result<(), Error> {
        let [newest, before] = CHECKPOINTS.map(|name| self.root.join(name));
        // The new one is complete beside the old one before anything is moved.
        let fresh = self.root.join("checkpoint.new.bin");
        write_atomic(&fresh, checkpoint)?;
        if newest.exists() {
            fs::rename(&newest, &before).map_err(|e| failed(&newest, &e))?;
        }
        fs::rename(&fresh, &newest).map_err(|e| failed(&newest, &e))
    }

    /// How far the run came: from the newest checkpoint that is whole. The journal goes on from there. `segmenter`
    /// makes one like the run began with.
    ///
    /// # Errors
    /// When the journal can't be cut back to the checkpoint.
    pub fn earlier(
        &mut self,
        manifest: &Manifest,
        source: &dyn FrameSource,
        segmenter: &dyn Fn() -> Result<Box<dyn VideoSegmenter>, Error>,
    ) -> Result<Earlier, Error> {
        let path = self.root.join(JOURNAL);
        let records = read_journal(&fs::read(&path).map_err(|e| failed(&path, &e))?);
        let mut earlier = Earlier::default();
        for name in CHECKPOINTS {
            let Ok(bytes) = fs::read(self.root.join(name)) else { continue };
            match self.run_from(&bytes, &records, manifest, source, segmenter()?) {
                Ok(run) => {
                    earlier.run = Some(run);
                    break;
                }
                Err(reason) => {
                    earlier.unusable.push(format!("{}/{FOLDER}/{name}: {reason}", out_name(&self.root)))
                }
            }
        }
        let kept = earlier.run.as_ref().map_or(0, |run| run.frames.len());
        let end = kept.checked_sub(1).and_then(|last| records.get(last)).map_or(0, |(end, _)| *end);
        let cut = self.journal.set_len(end).and_then(|()| self.journal.seek(SeekFrom::End(0)));
        cut.map_err(|e| failed(&path, &e))?;
        Ok(earlier)
    }

    fn run_from(
        &self,
        bytes: &[u8],
        records: &[(u64, SavedFrame)],
        manifest: &Manifest,
        source: &dyn FrameSource,
        segmenter: Box<dyn VideoSegmenter>,
    ) -> Result<RunSoFar, String> {
        let mut run = RunSoFar::restore(&manifest.config, manifest.schedule, bytes, source, segmenter)
            .map_err(|e| e.to_string())?;
        let count = run.tracker.frames();
        let records = records.get(..count).ok_or("the journal has fewer frames than the checkpoint")?;
        for (_, record) in records {
            run.frames.push(record.result());
            run.unreadable.extend(record.error());
        }
        Ok(run)
    }

    /// Removes the state: the run is done.
    ///
    /// # Errors
    /// When a file can't be removed.
    pub fn remove(self) -> Result<(), Error> {
        let root = self.root.clone();
        drop(self);
        remove_state(&root).map_err(|e| failed(&root, &e))
    }
}

/// Whether another process is writing to the output folder `out`.
pub(crate) fn is_in_use(out: &Path) -> bool {
    let root = out.join(FOLDER);
    root.join(LOCK).is_file() && lock(&root).is_err()
}

/// Removes what a run left in the `state/` folder of `out`, nothing else.
pub(crate) fn remove_from(out: &Path) -> std::io::Result<()> {
    remove_state(&out.join(FOLDER))
}

fn remove_state(root: &Path) -> std::io::Result<()> {
    if !root.is_dir() {
        return Ok(());
    }
    // The manifest last: without it the rest can't be used, with it alone a run starts over.
    for name in [CHECKPOINTS[0], CHECKPOINTS[1], "checkpoint.new.bin", JOURNAL, LOCK, MANIFEST] {
        match fs::remove_file(root.join(name)) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(e),
            _ => {}
        }
    }
    // Somebody's own file in it keeps the folder.
    let _ = fs::remove_dir(root);
    Ok(())
}

fn lock(root: &Path) -> Result<File, Error> {
    let path = root.join(LOCK);
    let file = File::create(&path).map_err(|e| failed(&path, &e))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => {
            Err(Error::new(path, "is held by another run", "wait for it, end it, or give another folder"))
        }
        // A file system without locks: go on without.
        Err(TryLockError::Error(_)) => Ok(file),
    }
}

fn out_name(root: &Path) -> String {
    root.parent().unwrap_or(root).display().to_string()
}

fn failed(path: &Path, error: &std::io::Error) -> Error {
    let remedy = "check the disk, the folder and its permissions, and go on with `bundlesdf run --resume`";
    Error::new(path, format!("can't be written ({error})"), remedy)
}

/// A frame's result in the journal.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct SavedFrame {
    index: usize,
    id: String,
    cam_from_obj: PoseBits,
    status: Status,
    inliers: usize,
    depth_agreement: f64,
    uncertainty: Option<Uncertainty>,
    keyframe: bool,
    times: [Duration; 4],
    /// Path, problem and remedy, when the frame's files could not be read.
    unreadable: Option<(PathBuf, String, String)>,
}

impl SavedFrame {
    fn of(r: &FrameResult, unreadable: Option<&Error>) -> Self {
        let t = &r.times;
        Self {
            index: r.index,
            id: r.id.clone(),
            cam_from_obj: bits(&r.cam_from_obj),
            status: r.status,
            inliers: r.inliers,
            depth_agreement: r.depth_agreement,
            uncertainty: r.uncertainty.clone(),
            keyframe: r.keyframe,
            times: [t.segment, t.matching, t.posegraph, t.total],
            unreadable: unreadable.map(|e| (e.path.clone(), e.problem.clone(), e.remedy.clone())),
        }
    }

    fn result(&self) -> FrameResult {
        let [segment, matching, posegraph, total] = self.times;
        FrameResult {
            index: self.index,
            id: self.id.clone(),
            cam_from_obj: pose(self.cam_from_obj),
            status: self.status,
            inliers: self.inliers,
            depth_agreement: self.depth_agreement,
            uncertainty: self.uncertainty.clone(),
            keyframe: self.keyframe,
            times: StageTimes { segment, matching, posegraph, total },
        }
    }

    fn error(&self) -> Option<Error> {
        self.unreadable.clone().map(|(path, problem, remedy)| Error::new(path, problem, remedy))
    }
}

/// The whole records from the start, each with where it ends; what follows a torn one is left out.
fn read_journal(bytes: &[u8]) -> Vec<(u64, SavedFrame)> {
    let mut records = Vec::new();
    let mut rest = bytes;
    while let Some((length, after)) = rest.split_first_chunk::<4>()
        && let Some((checksum, after)) = after.split_first_chunk::<4>()
        && let Some(payload) = after.get(..u32::from_le_bytes(*length) as usize)
        && crc32fast::hash(payload) == u32::from_le_bytes(*checksum)
        && let Ok(frame) = postcard::from_bytes::<SavedFrame>(payload)
        && frame.index == records.len()
    {
        rest = after.get(payload.len()..).unwrap_or_default();
        records.push(((bytes.len() - rest.len()) as u64, frame));
    }
    records
}
