//! The progress bar, and an observer that writes each pose and mask as it is made.

use std::{io::IsTerminal, time::Duration};

use bundlesdf::{FrameResult, Observer, OutputFolder, RunSoFar, StateFolder, Status, Tracker, Warning};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use super::log::Log;

/// Shows (or logs) frames, rate, keyframes and the latest status while poses go to disk.
pub(super) struct Progress<'a> {
    bar: ProgressBar,
    folder: &'a OutputFolder,
    state: StateFolder,
    log: Log,
    lost: usize,
    rounds: usize,
    /// Why the frame that comes next could not be read.
    unreadable: Option<rgbd_io::Error>,
}

impl<'a> Progress<'a> {
    pub(super) fn new(
        run: &RunSoFar,
        frames: usize,
        folder: &'a OutputFolder,
        state: StateFolder,
        log: Log,
    ) -> Self {
        let target = if log == Log::Text && std::io::stderr().is_terminal() {
            ProgressDrawTarget::stderr()
        } else {
            ProgressDrawTarget::hidden()
        };
        let bar = ProgressBar::with_draw_target(Some(frames as u64), target);
        let template = "{spinner} {pos}/{len} frames [{wide_bar}] {per_sec} eta {eta} | {msg}";
        if let Ok(style) = ProgressStyle::with_template(template) {
            bar.set_style(style.progress_chars("=> "));
        }
        bar.set_position(run.frames.len() as u64);
        let lost = run.frames.iter().filter(|f| f.status == Status::Lost).count();
        let rounds = run.tracker.field_summary().history.len();
        Self { bar, folder, state, log, lost, rounds, unreadable: None }
    }

    /// Takes the bar off the screen.
    pub(super) fn close(self) -> StateFolder {
        self.bar.finish_and_clear();
        self.state
    }
}

impl Observer for Progress<'_> {
    fn frame(&mut self, result: &FrameResult, tracker: &Tracker) -> Result<(), rgbd_io::Error> {
        self.lost += usize::from(result.status == Status::Lost);
        let keyframes = tracker.pool().keyframes().len();
        self.bar.set_message(format!(
            "{}, {keyframes} keyframes, {} lost",
            result.status.as_str(),
            self.lost
        ));
        self.bar.inc(1);
        self.log.frame(result, keyframes);
        let history = &tracker.field_summary().history;
        for (round, report) in history.iter().enumerate().skip(self.rounds) {
            self.log.round(round + 1, report);
        }
        self.rounds = history.len();
        if let Some(mask) = tracker.mask() {
            self.folder.write_mask(&result.id, mask)?;
        }
        self.folder.write_pose(&result.id, &result.cam_from_obj)?;
        self.state.append(result, self.unreadable.take().as_ref())
    }

    fn unreadable(&mut self, error: &rgbd_io::Error) {
        self.bar.suspend(|| self.log.warning(&format!("{error}; the frame counts as lost")));
        self.unreadable = Some(error.clone());
    }

    fn warning(&mut self, warning: &Warning) {
        self.bar.suspend(|| self.log.warning(&warning.to_string()));
    }

    fn keeps_checkpoints(&self) -> bool {
        true
    }

    fn checkpoint(&mut self, saved: &[u8]) -> Result<(), rgbd_io::Error> {
        self.state.write(saved)
    }

    fn finishing(&mut self) {
        self.log.finishing();
        self.bar.set_message("final round and mesh");
        self.bar.enable_steady_tick(Duration::from_millis(200));
    }
}
