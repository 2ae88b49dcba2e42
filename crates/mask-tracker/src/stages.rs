//! Where the time goes.

use std::cell::Cell;
use std::time::{Duration, Instant};

/// A part of the work on a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Stage {
    Grid,
    Align,
    Search,
    Cues,
    Cut,
    Upsample,
    Learn,
}

const NAMES: [&str; 7] = ["grid", "align", "search", "cues", "cut", "upsample", "learn"];

/// Wall-clock time that [`crate::Propagate`] has spent since it was made, by stage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StageTimes([Duration; NAMES.len()]);

impl StageTimes {
    /// Name and time of every stage, in the order of the work: sampling the working grid, aligning the last frame
    /// with it, searching the whole image for a lost object, weighing the cues, the graph cut, bringing the mask
    /// to full resolution, and learning.
    pub fn named(&self) -> [(&'static str, Duration); NAMES.len()] {
        std::array::from_fn(|k| (NAMES[k], self.0[k]))
    }
}

/// Adds up stage times; shared by methods that only read the segmenter.
#[derive(Debug, Default)]
pub(crate) struct Clock(Cell<StageTimes>);

impl Clock {
    pub(crate) fn time<T>(&self, stage: Stage, work: impl FnOnce() -> T) -> T {
        let begin = Instant::now();
        let result = work();
        let mut times = self.0.get();
        times.0[stage as usize] += begin.elapsed();
        self.0.set(times);
        result
    }

    pub(crate) fn times(&self) -> StageTimes {
        self.0.get()
    }
}
