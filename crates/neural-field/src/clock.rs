//! Where a step's time goes. Without the feature `bench` a clock is nothing and costs nothing.

/// The kernels of a step.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Stage {
    Sample,
    Encode,
    Geometry,
    Color,
    Backward,
    Eikonal,
    Scatter,
    Adam,
}

/// Number of stages.
#[cfg(feature = "bench")]
pub(crate) const STAGES: usize = 8;

/// Adds up the time between laps of one worker, by stage.
#[derive(Clone, Debug, Default)]
pub(crate) struct Clock {
    #[cfg(feature = "bench")]
    last: Option<std::time::Instant>,
    #[cfg(feature = "bench")]
    seconds: [f64; STAGES],
}

#[cfg(feature = "bench")]
impl Clock {
    pub(crate) fn start(&mut self) {
        self.last = Some(std::time::Instant::now());
    }

    /// The time since the last call belongs to `stage`.
    pub(crate) fn lap(&mut self, stage: Stage) {
        let now = std::time::Instant::now();
        if let Some(last) = self.last.replace(now) {
            self.seconds[stage as usize] += (now - last).as_secs_f64();
        }
    }

    pub(crate) fn seconds(&self) -> [f64; STAGES] {
        self.seconds
    }
}

#[cfg(not(feature = "bench"))]
impl Clock {
    #[inline(always)]
    pub(crate) fn start(&mut self) {}

    #[inline(always)]
    pub(crate) fn lap(&mut self, _: Stage) {}
}
