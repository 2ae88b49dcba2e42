//! The progress bar, and an observer that writes each pose and mask as it is made.

use std::{io::IsTerminal, time::Duration};

use bundlesdf::{FrameResult, Observer, OutputFolder, Status, Tracker};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use super::log::Log;

/// Shows (or logs) frames, rate, keyframes and the latest status while poses go to disk.
pub(super) struct Progress<'a> {
    bar: ProgressBar,
    folder: &'a OutputFolder,
    log: Log,
    lost: usize,
    rounds: usize,
}

impl<'a> Progress<'a> {
    pub(super) fn new(frames: usize, folder: &'a OutputFolder, log: Log) -> Self {
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
        Self { bar, folder, log, lost: 0, rounds: 0 }
    }

    /// Takes the bar off the screen.
    pub(super) fn close(&self) {
        self.bar.finish_and_clear();
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
        self.folder.write_pose(&result.id, &result.cam_from_obj)
    }

    fn unreadable(&mut self, error: &rgbd_io::Error) {
        self.bar.suspend(|| self.log.warning(&format!("{error}; the frame counts as lost")));
    }

    fn finishing(&mut self) {
        self.log.finishing();
        self.bar.set_message("final round and mesh");
        self.bar.enable_steady_tick(Duration::from_millis(200));
    }
}
