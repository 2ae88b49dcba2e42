//! Where a step's time goes. Without the feature `bench` a clock is nothing and costs nothing.

/// The kernels of a step.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Stage {
    Sample,
    Encode,
    Geometry,
    Color,
    Eikonal,
    /// Poses' gradients.
    Pose,
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
    last: Option<f64>,
    #[cfg(feature = "bench")]
    seconds: [f64; STAGES],
    /// Lanes of which the work depends on the data.
    #[cfg(feature = "bench")]
    lanes: [usize; STAGES],
}

#[cfg(feature = "bench")]
impl Clock {
    pub(crate) fn start(&mut self) {
        self.last = Some(thread_seconds());
    }

    /// The time since the last call belongs to `stage`.
    pub(crate) fn lap(&mut self, stage: Stage) {
        let now = thread_seconds();
        if let Some(last) = self.last.replace(now) {
            self.seconds[stage as usize] += now - last;
        }
    }

    /// A stage did what it does not do for all lanes.
    #[inline(always)]
    pub(crate) fn count(&mut self, stage: Stage, lanes: usize) {
        self.lanes[stage as usize] += lanes;
    }

    pub(crate) fn seconds(&self) -> [f64; STAGES] {
        self.seconds
    }

    pub(crate) fn lanes(&self) -> [usize; STAGES] {
        self.lanes
    }
}

/// Processor time of this thread, seconds; elsewhere than on Unix the time of day.
#[cfg(feature = "bench")]
pub(crate) fn thread_seconds() -> f64 {
    #[cfg(unix)]
    {
        let t = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
        t.tv_sec as f64 + 1e-9 * t.tv_nsec as f64
    }
    #[cfg(not(unix))]
    {
        static START: std::sync::OnceLock<std::time::Instant> = std::sync::OnceLock::new();
        START.get_or_init(std::time::Instant::now).elapsed().as_secs_f64()
    }
}

#[cfg(not(feature = "bench"))]
impl Clock {
    #[inline(always)]
    pub(crate) fn start(&mut self) {}

    #[inline(always)]
    pub(crate) fn lap(&mut self, _: Stage) {}

    #[inline(always)]
    pub(crate) fn count(&mut self, _: Stage, _: usize) {}
}
