//! What goes to standard error: lines for people, coloured on a terminal, or JSON for programs.

use std::io::{IsTerminal, Write};

use bundlesdf::{
    FrameResult, OutputFolder, RoundReport, RunReport, Status, VideoInput, export::ExportReport,
    refine::Refined,
};
use serde_json::{Value, json};

/// Who reads standard error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Log {
    /// A person: warnings and errors only, beside the progress bar.
    Text,
    /// A program: one JSON object per line, told apart by `event`.
    Json,
}

/// Whether colours may go to `stream`: a terminal, and the user hasn't said no (NO_COLOR, CLICOLOR).
pub(super) fn colors_on(stream: &(impl IsTerminal + anstream::stream::RawStream)) -> bool {
    anstream::AutoStream::choice(stream) != anstream::ColorChoice::Never
}

impl Log {
    pub(super) fn start(self, frames: usize, input: &VideoInput, folder: &OutputFolder) {
        self.event(|| {
            json!({ "event": "start", "version": env!("CARGO_PKG_VERSION"), "frames": frames, "input": input,
                "out": folder.path() })
        });
    }

    pub(super) fn frame(self, result: &FrameResult, keyframes: usize) {
        self.event(|| {
            json!({ "event": "frame", "index": result.index, "id": result.id, "status": result.status,
                "inliers": result.inliers, "depth_agreement": rounded(result.depth_agreement),
                "keyframe": result.keyframe, "keyframes": keyframes,
                "ms": rounded(result.times.total.as_secs_f64() * 1e3) })
        });
    }

    pub(super) fn round(self, number: usize, round: &RoundReport) {
        self.event(|| {
            json!({ "event": "round", "round": number, "keyframes": round.keyframes, "steps": round.steps,
                "ms": rounded(round.ms), "loss": round.loss.last() })
        });
    }

    pub(super) fn finishing(self) {
        self.event(|| json!({ "event": "finishing" }));
    }

    pub(super) fn assets(self, report: &ExportReport, folder: &OutputFolder) {
        let s = &report.seconds;
        self.event(|| {
            json!({ "event": "assets", "files": report.files, "faces": report.faces,
                "ms": rounded((s.load + s.mesh + s.texture + s.write) * 1e3), "out": folder.path() })
        });
    }

    pub(super) fn refined(self, refined: &Refined, folder: &OutputFolder) {
        let measured = refined.frames.iter().filter(|f| f.measured).count();
        self.event(|| {
            json!({ "event": "refined", "frames": refined.frames.len(), "measured": measured,
                "keyframes": refined.keyframes.len(), "vertices": refined.mesh.vertices.len(),
                "faces": refined.mesh.triangles.len(), "ms": rounded(refined.wall.as_secs_f64() * 1e3),
                "out": folder.path() })
        });
    }

    pub(super) fn summary(self, report: &RunReport, folder: &OutputFolder) {
        let count = |status| report.count(status);
        self.event(|| {
            json!({ "event": "summary", "frames": report.frames.len(), "tracked": count(Status::Tracked),
                "relocalised": count(Status::Relocalised), "weak": count(Status::Weak), "lost": count(Status::Lost),
                "keyframes": report.keyframes, "rounds": report.field.rounds, "failures": report.field.failures,
                "tracking_hz_median": rounded(report.tracking_hz_median), "wall_s": rounded(report.wall_s),
                "mesh": report.mesh, "interrupted": report.interrupted, "out": folder.path() })
        });
    }

    /// Something worth knowing that is no trouble.
    pub(super) fn note(self, message: &str) {
        self.say("note", "\x1b[1m", message, &[]);
    }

    pub(super) fn warning(self, message: &str) {
        self.say("warning", "\x1b[1;33m", message, &[]);
    }

    pub(super) fn error(self, message: &str, exit_code: u8) {
        self.say("error", "\x1b[1;31m", message, &[("exit_code", exit_code.into())]);
    }

    fn say(self, kind: &str, style: &str, message: &str, more: &[(&str, Value)]) {
        let message = message.replace('\n', " ");
        if self == Self::Text {
            // A reader that has gone away is no error; colours are taken out where they don't belong.
            let _ = writeln!(anstream::stderr(), "{style}{kind}:\x1b[0m {message}");
            return;
        }
        self.event(|| {
            let mut event = json!({ "event": kind, "message": message });
            for (key, value) in more {
                event[key] = value.clone();
            }
            event
        });
    }

    fn event(self, event: impl FnOnce() -> Value) {
        if self == Self::Json {
            let _ = writeln!(std::io::stderr(), "{}", event());
        }
    }
}

/// To a thousandth: more digits only make the line longer.
fn rounded(value: f64) -> f64 {
    (value * 1e3).round() / 1e3
}
