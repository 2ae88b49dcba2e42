//! What happened, in words, and what to do about it.

use super::{gather::Results, timeline::runs};
use crate::{
    RunReport, VideoInput,
    config::{Refiner, Schedule},
    tracker::Status,
};

/// How the run went as a whole.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
    Good,
    Gaps,
    Poor,
}

impl Verdict {
    pub(super) fn word(self) -> &'static str {
        match self {
            Self::Good => "Good",
            Self::Gaps => "Usable, with gaps",
            Self::Poor => "Poor",
        }
    }

    pub(super) fn class(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::Gaps => "gaps",
            Self::Poor => "poor",
        }
    }
}

/// Something that went wrong and its remedy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Advice {
    pub(super) problem: String,
    pub(super) remedy: String,
}

/// The head of the page.
pub(super) struct Story {
    pub(super) verdict: Verdict,
    pub(super) sentences: Vec<String>,
    pub(super) advice: Vec<Advice>,
}

pub(super) fn story(results: &Results) -> Story {
    let report = &results.report;
    let total = report.frames.len();
    let share = |count: usize| if total == 0 { 0.0 } else { count as f64 / total as f64 };
    let (lost, weak) = (report.count(Status::Lost), report.count(Status::Weak));
    let has_mesh = report.mesh.faces > 0;
    let verdict = if total == 0 || share(lost) > 0.25 || (!has_mesh && wants_mesh(results)) {
        Verdict::Poor
    } else if share(lost) > 0.02
        || share(weak) > 0.2
        || (has_mesh && results.coverage() < 0.25)
        || report.interrupted
        || !report.warnings.is_empty()
        || !report.unreadable.is_empty()
    {
        Verdict::Gaps
    } else {
        Verdict::Good
    };
    Story { verdict, sentences: sentences(results), advice: advice(results) }
}

fn wants_mesh(results: &Results) -> bool {
    results.report.config.field.refiner == Refiner::Field
}

fn sentences(results: &Results) -> Vec<String> {
    let report = &results.report;
    let total = report.frames.len();
    if total == 0 {
        return vec!["No frame was tracked.".into()];
    }
    let found = report.count(Status::Tracked) + report.count(Status::Relocalised);
    let (weak, lost) = (report.count(Status::Weak), report.count(Status::Lost));
    let again = report.count(Status::Relocalised);
    let mut first = if lost == 0 && weak == 0 {
        format!("The object was tracked in all {total} frames")
    } else {
        let mut parts = vec![format!("The object was tracked in {found} of {total} frames")];
        if weak > 0 {
            parts.push(if weak == 1 { "one pose is weak".into() } else { format!("{weak} poses are weak") });
        }
        if lost > 0 {
            parts.push(format!("in {lost} it was lost"));
        }
        parts.join(", ")
    };
    if again > 0 {
        first += &format!("; it was found again after a loss {}", times(again));
    }
    let mut sentences = vec![first + "."];
    sentences.push(match (results.size_cm(), report.mesh.faces) {
        (Some([a, b, c]), faces) if faces > 0 => {
            let surface =
                if report.mesh.watertight { "closed (watertight)" } else { "open where nothing was seen" };
            format!(
                "From {} came a mesh of {} that is {surface}; the views cover {:.0} % of all directions.",
                plural(report.keyframes, "keyframe"),
                dimensions(a, b, c),
                results.coverage() * 100.0
            )
        }
        _ => format!("There is no mesh; the memory holds {}.", plural(report.keyframes, "keyframe")),
    });
    sentences
}

/// Centimetres for what one can hold.
fn dimensions(a: f64, b: f64, c: f64) -> String {
    // Not to be broken between lines.
    format!("{a:.1}\u{a0}\u{d7}\u{a0}{b:.1}\u{a0}\u{d7}\u{a0}{c:.1}\u{a0}cm")
}

/// A remedy as it stands in a message, made a sentence.
fn sentence(text: &str) -> String {
    let mut letters = text.chars();
    let first = letters.next().map(|c| c.to_uppercase().to_string()).unwrap_or_default();
    format!("{first}{}.", letters.as_str().trim_end_matches('.'))
}

fn times(count: usize) -> String {
    match count {
        1 => "once".into(),
        2 => "twice".into(),
        n => format!("{n} times"),
    }
}

fn advice(results: &Results) -> Vec<Advice> {
    let report = &results.report;
    let about_run = [lost(results), weak(report), no_mesh(report), unseen(results), slow(report)];
    let mut list: Vec<Advice> = about_run.into_iter().flatten().collect();
    for failure in &report.field.failures {
        let remedy = "Tracking went on without it; poses may drift more.";
        list.push(Advice::new(format!("A round of the field failed: {failure}."), remedy));
    }
    for warning in &report.warnings {
        list.push(Advice::new(
            format!("From frame {} on: {}.", warning.frame, warning.message),
            sentence(&warning.remedy),
        ));
    }
    for warning in report.unreadable.iter().chain(&results.problems) {
        list.push(Advice::new(format!("{warning}."), "A frame that could not be read counts as lost."));
    }
    if report.interrupted {
        let remedy = "What is here ends with the last frame tracked.";
        list.push(Advice::new("The run was stopped before the last frame.", remedy));
    }
    list
}

impl Advice {
    fn new(problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { problem: problem.into(), remedy: remedy.into() }
    }
}

fn lost(results: &Results) -> Option<Advice> {
    let problem = losses(results)?;
    let stride = match stride(&results.report) {
        1 => String::new(),
        n => format!("Only one frame in {n} was used: without --stride the object moves less in between. "),
    };
    let look = "Look at these frames: is the object hidden, out of the picture, closer than the camera measures, or \
                blurred? If it is visible, compare its masks (bundlesdf draw OUT --what mask) and give better ones \
                with --masks FOLDER. The pose of a lost frame is the last good one: don't use it.";
    Some(Advice::new(problem, stride + look))
}

fn weak(report: &RunReport) -> Option<Advice> {
    let (weak, total) = (report.count(Status::Weak), report.frames.len());
    (weak * 5 > total).then(|| {
        Advice::new(
            format!("{} % of the poses are weak.", weak * 100 / total),
            "There is little texture or shape to hold on to, or the depth is noisy. Come closer (the object should \
             fill a third of the picture), move more slowly, and avoid shiny surfaces.",
        )
    })
}

fn no_mesh(report: &RunReport) -> Option<Advice> {
    if report.mesh.faces > 0 || report.frames.len() < 2 {
        return None;
    }
    let needed = report.config.field.first_round_keyframes;
    Some(match report.config.field.refiner {
        Refiner::Field if report.keyframes < needed => Advice::new(
            format!("No mesh, with only {} in memory.", plural(report.keyframes, "keyframe")),
            "Turn the object, or move around it: a keyframe is kept for every few degrees of a new view.",
        ),
        Refiner::Field => Advice::new(
            "No mesh: the field was never trained to the end.",
            "See the other points here; run again without an interruption.",
        ),
        Refiner::PoseGraph | Refiner::None => Advice::new(
            "No mesh: the Neural Object Field is switched off in the config.",
            "Leave out --ablate, or set field.refiner to \"field\".",
        ),
    })
}

fn unseen(results: &Results) -> Option<Advice> {
    let coverage = results.coverage();
    (results.report.mesh.faces > 0 && coverage < 0.5).then(|| {
        Advice::new(
            format!("Only {:.0} % of the directions were seen.", coverage * 100.0),
            "The unseen sides of the mesh are missing or guessed. Turn the object so that every side faces the \
             camera.",
        )
    })
}

fn slow(report: &RunReport) -> Option<Advice> {
    let rate = report.tracking_hz_median;
    (report.schedule == Schedule::Realtime && rate > 0.0 && rate < 15.0).then(|| {
        Advice::new(
            format!("Tracking ran at {rate:.1} frames per second."),
            "For a live camera, reduce the picture (preprocess.working_side) or use every second frame (--stride 2).",
        )
    })
}

/// Where the object was lost; `None` when it never was.
fn losses(results: &Results) -> Option<String> {
    let frames = &results.report.frames;
    let lost: Vec<_> = runs(frames).into_iter().filter(|r| r.0 == Status::Lost).collect();
    let (_, start, end) = *lost.iter().max_by_key(|r| r.2 - r.1)?;
    let name = |i: usize| frames.get(i).map_or("", |f| f.id.as_str());
    let longest = if end - start == 1 {
        format!("frame {}", name(start))
    } else {
        format!("frames {} to {} ({} of them)", name(start), name(end - 1), end - start)
    };
    Some(match lost.len() {
        1 => format!("Lost in {longest}."),
        n => format!("Lost {}, longest in {longest}.", times(n)),
    })
}

/// Every how many frames of the video one was used.
fn stride(report: &RunReport) -> usize {
    match &report.input {
        Some(VideoInput::Folder { stride, .. } | VideoInput::Dataset { stride, .. }) => *stride,
        Some(VideoInput::Synthetic { .. }) | None => 1,
    }
}

fn plural(count: usize, thing: &str) -> String {
    if count == 1 { format!("one {thing}") } else { format!("{count} {thing}s") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn remedies_become_sentences() {
        assert_eq!(sentence("move it more slowly; check the focus"), "Move it more slowly; check the focus.");
        assert_eq!(sentence("Turn it."), "Turn it.");
        assert_eq!(sentence(""), ".");
    }
}
