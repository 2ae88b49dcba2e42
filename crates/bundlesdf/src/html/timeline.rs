//! Status, inliers, depth agreement and time of every frame, above one axis.

use maud::{Markup, PreEscaped, html};

use super::plot::{Scale, area_path, line_path, num, quantile, ticks};
use crate::report::{FrameReport, RunReport};
use crate::tracker::Status;

const WIDTH: f64 = 1000.0;
const LEFT: f64 = 46.0;
const RIGHT: f64 = 990.0;
const STRIP: f64 = 14.0;
const PANEL: f64 = 86.0;
const GAP: f64 = 34.0;
const TOP: f64 = 22.0;

/// The plot and the data that its read-out shows.
pub(super) fn timeline(report: &RunReport) -> Markup {
    let frames = &report.frames;
    let x = Scale { from: [0.0, frames.len().max(1) as f64], to: [LEFT, RIGHT] };
    let strip = TOP;
    let panels: [f64; 3] = std::array::from_fn(|i| strip + STRIP + 14.0 + GAP + i as f64 * (PANEL + GAP));
    let bottom = panels[2] + PANEL;
    let height = bottom + 34.0;
    html! {
        div.scroll {
            svg.plot #timeline viewBox=(format!("0 0 {WIDTH} {}", num(height))) role="img"
                data-left=(LEFT) data-right=(RIGHT)
                aria-label="Status, inliers, depth agreement and milliseconds of every frame" {
                (bands(frames, &x, panels[0], bottom))
                (status_strip(frames, &x, strip))
                (inliers(frames, &x, panels[0]))
                (agreement(frames, &x, panels[1]))
                (millis(frames, &x, panels[2]))
                @for tick in ticks(frames.len() as f64, 8) {
                    text.tick x=(num(x.at(tick + 0.5))) y=(num(bottom + 16.0)) text-anchor="middle" { (tick) }
                }
                text.tick x=(num((LEFT + RIGHT) / 2.0)) y=(num(bottom + 31.0)) text-anchor="middle" { "frame" }
                line #cursor x1="0" x2="0" y1=(num(strip)) y2=(num(bottom)) visibility="hidden" {}
            }
        }
        p.readout #readout { "Point at a frame to read its numbers." }
        script type="application/json" id="frames" { (PreEscaped(data(frames))) }
    }
}

/// Runs of frames with one status: `(status, first, one past the last)`.
pub(super) fn runs(frames: &[FrameReport]) -> Vec<(Status, usize, usize)> {
    let mut runs: Vec<(Status, usize, usize)> = Vec::new();
    for (i, frame) in frames.iter().enumerate() {
        match runs.last_mut() {
            Some((status, _, end)) if *status == frame.status => *end = i + 1,
            _ => runs.push((frame.status, i, i + 1)),
        }
    }
    runs
}

/// Pale columns through all panels where the object was lost.
fn bands(frames: &[FrameReport], x: &Scale, top: f64, bottom: f64) -> Markup {
    html! {
        @for (_, start, end) in runs(frames).into_iter().filter(|r| r.0 == Status::Lost) {
            rect.band x=(num(x.at(start as f64))) width=(num(x.at(end as f64) - x.at(start as f64)))
                y=(num(top)) height=(num(bottom - top)) {}
        }
    }
}

fn status_strip(frames: &[FrameReport], x: &Scale, y: f64) -> Markup {
    html! {
        text.title x=(LEFT) y=(num(y - 8.0)) { "status" }
        @for (status, start, end) in runs(frames) {
            rect class={ "s-" (status.as_str()) } x=(num(x.at(start as f64)))
                width=(num((x.at(end as f64) - x.at(start as f64)).max(0.5))) y=(num(y)) height=(STRIP) {
                title { (status.as_str()) ": frames " (start) " to " (end - 1) }
            }
        }
        @for (i, _) in frames.iter().enumerate().filter(|(_, f)| f.keyframe) {
            @let at = x.at(i as f64 + 0.5);
            path.key d=(format!("M{} {}l3 6h-6Z", num(at), num(y + STRIP + 3.0))) {}
        }
    }
}

/// Title, grid lines and tick labels of a panel.
fn frame_of(title: &str, y: &Scale, marks: &[f64], label: impl Fn(f64) -> String) -> Markup {
    html! {
        text.title x=(LEFT) y=(num(y.to[1] - 9.0)) { (title) }
        @for mark in marks {
            line.grid x1=(LEFT) x2=(RIGHT) y1=(num(y.at(*mark))) y2=(num(y.at(*mark))) {}
            text.tick x=(num(LEFT - 7.0)) y=(num(y.at(*mark) + 3.5)) text-anchor="end" { (label(*mark)) }
        }
    }
}

fn middles(
    frames: &[FrameReport],
    x: &Scale,
    y: &Scale,
    value: impl Fn(&FrameReport) -> f64,
) -> Vec<[f64; 2]> {
    frames.iter().enumerate().map(|(i, f)| [x.at(i as f64 + 0.5), y.at(value(f))]).collect()
}

fn inliers(frames: &[FrameReport], x: &Scale, top: f64) -> Markup {
    let most = frames.iter().map(|f| f.inliers).max().unwrap_or(0) as f64;
    let y = Scale { from: [0.0, (most * 1.05).max(1.0)], to: [top + PANEL, top] };
    let line = middles(frames, x, &y, |f| f.inliers as f64);
    let floor: Vec<_> = line.iter().map(|p| [p[0], top + PANEL]).collect();
    html! {
        (frame_of("inliers: matches that agree with the pose", &y, &ticks(most, 3), |v| format!("{v}")))
        path.area d=(area_path(&line, &floor)) {}
        path.line d=(line_path(line)) {}
    }
}

fn agreement(frames: &[FrameReport], x: &Scale, top: f64) -> Markup {
    let y = Scale { from: [0.0, 1.0], to: [top + PANEL, top] };
    let line = middles(frames, x, &y, |f| f.depth_agreement);
    let percent = |v: f64| format!("{} %", (v * 100.0).round());
    html! {
        (frame_of("depth agreement: share of the compared depth that fits the pose", &y, &[0.0, 0.5, 1.0], percent))
        path.line.second d=(line_path(line)) {}
    }
}

/// Stages on top of each other, so that the upper line is the whole frame.
fn millis(frames: &[FrameReport], x: &Scale, top: f64) -> Markup {
    // A few slow frames would flatten all others: the axis ends a little above what most of them take.
    let most = quantile(frames.iter().map(|f| f.ms.total), 0.9) * 1.5;
    let y = Scale { from: [0.0, most.max(1.0)], to: [top + PANEL, top] };
    let sums: [fn(&FrameReport) -> f64; 5] = [
        |_| 0.0,
        |f| f.ms.segment,
        |f| f.ms.segment + f.ms.matching,
        |f| f.ms.segment + f.ms.matching + f.ms.posegraph,
        |f| f.ms.total.max(f.ms.segment + f.ms.matching + f.ms.posegraph),
    ];
    let lines = sums.map(|sum| middles(frames, x, &y, sum));
    let stages = ["segmentation", "matching", "pose graph", "rest"];
    html! {
        (frame_of("milliseconds per frame", &y, &ticks(most, 3), |v| format!("{v}")))
        @for (i, pair) in lines.windows(2).enumerate() {
            path class={ "stage-" (i) } d=(area_path(&pair[1], &pair[0])) {}
        }
        @for (i, name) in stages.into_iter().enumerate() {
            @let at = RIGHT - 335.0 + [0.0, 105.0, 183.0, 272.0][i];
            rect class={ "stage-" (i) } x=(num(at)) y=(num(top - 18.0)) width="10" height="10" rx="2" {}
            text.tick x=(num(at + 15.0)) y=(num(top - 9.0)) { (name) }
        }
    }
}

/// One array per frame, for the page's script.
fn data(frames: &[FrameReport]) -> String {
    let rows: Vec<_> = frames
        .iter()
        .map(|f| {
            let t =
                [f.ms.segment, f.ms.matching, f.ms.posegraph, f.ms.total].map(|v| (v * 10.0).round() / 10.0);
            serde_json::json!([f.id, f.status.as_str(), f.inliers, f.depth_agreement, f.keyframe, t])
        })
        .collect();
    // Inside <script> only this character could end it.
    serde_json::Value::from(rows).to_string().replace('<', "\\u003c")
}
